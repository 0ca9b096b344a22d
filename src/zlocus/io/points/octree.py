"""Points sorted into the nodes of an octree, out of core: memory holds a bucket of points at a time.

The code of a point (Morton 1966) interleaves the bits of its three coordinates: the points of a cube follow each other
in the order of the codes, and the code of a cube is that of its points without their last bits.

As in the octrees of EPT and COPC, a node holds a thinned sample of the points in its cube, and its children hold those
that it leaves: a node takes one point from each of its 128 x 128 x 128 cells, or all points where few are left.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

Records = NDArray[Any]  # (n,) points of a LAS file: structured, with X, Y and Z in int32
Batches = Callable[[], Iterator[Records]]

# Three coordinates of this many bits fit into a code of 63 bits.
MAX_BITS = 21
# A node has 2**7 cells on each side.
CELL_BITS = 7
# A node with no more points left takes all of them.
NODE_POINTS = 100_000
# Points that are sorted in memory at a time, and levels by which points are sorted into buckets on disk at a time.
BUCKET_POINTS, SPLIT_LEVELS = 1_000_000, 6
# Spreads the choice of points over their cells (the golden ratio, as in Fibonacci hashing).
SPREAD = np.uint64(0x9E3779B97F4A7C15)
# (shift, mask) pairs, which put two zero bits between the bits of a coordinate.
INTERLEAVE = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip


@dataclass(frozen=True)
class Steps:
    """How coordinates are stored. scale : length of a step, m, on all axes; offset : (3,) m, of step 0."""

    scale: float
    offset: NDArray[np.float64]

    def metres(self, xyz: NDArray[np.int64]) -> NDArray[np.float64]:
        """Coordinates (..., 3) in metres, rounded as readers of the file round them."""
        return np.asarray(xyz * self.scale + self.offset)


@dataclass(frozen=True)
class Octree:
    """A cube around points, which is cut into eight again and again.

    The cube begins at the lowest coordinates and is as wide as the points on their longest axis: there are readers that
    take the cube from the bounds of a file. steps : of the coordinates; low : (3,) int64, smallest X, Y and Z; side,
    side_m : of the cube, in steps and in metres; bits : the codes have 2**bits cells on each side.
    """

    steps: Steps
    low: NDArray[np.int64]
    side: int
    side_m: float
    bits: int

    @classmethod
    def around(cls, steps: Steps, low: NDArray[np.int64], high: NDArray[np.int64]) -> Octree:
        """The octree of points between two corners, (3,) in steps, both of which some point reaches on each axis."""
        side = max(int((high - low).max()), 1)
        side_m = float((steps.metres(high) - steps.metres(low)).max()) or steps.scale
        return cls(steps, low, side, side_m, min(side.bit_length(), MAX_BITS))

    @property
    def corner(self) -> NDArray[np.float64]:
        """Lowest corner of the cube, (3,) m, as the bounds of the file have it."""
        return self.steps.metres(self.low)

    @property
    def spacing_m(self) -> float:
        """Side of a cell of the root node, m."""
        return self.side_m / (1 << CELL_BITS)

    @property
    def deepest(self) -> int:
        """The level whose cells are those of the codes: its nodes take all points that are left."""
        return max(self.bits - CELL_BITS, 0)

    def codes(self, records: Records) -> NDArray[np.int64]:
        """Code of each point, (n,) int64."""
        codes, n_cells = np.zeros(len(records), np.int64), 2**self.bits
        for axis, name in enumerate(("X", "Y", "Z")):
            steps = records[name].astype(np.int64)
            away = steps - self.low[axis]
            assert not ((away < 0) | (away > self.side)).any(), f"{name} outside of the cube"
            cells = np.minimum((away << self.bits) // self.side, n_cells - 1)
            # Points on the border of two cells lie where readers see them, who reckon in metres.
            place_m = steps * self.steps.scale + self.steps.offset[axis]
            cells -= place_m < cells * (self.side_m / n_cells) + self.corner[axis]
            for shift, mask in INTERLEAVE:
                cells = (cells | (cells << shift)) & mask
            codes |= cells << axis
        return codes

    def cubes(self, codes: NDArray[np.int64], level: int) -> NDArray[np.int64]:
        """Code of the cube of a level, or of a cell below the deepest one, that holds each point."""
        return codes >> (3 * (self.bits - level))


def position(code: int) -> tuple[int, int, int]:
    """Place of a cube among those of its level along x, y and z, from its code."""
    bits = f"{code:063b}"
    return int(bits[2::3], 2), int(bits[1::3], 2), int(bits[0::3], 2)


@dataclass(frozen=True)
class Bucket:
    """All points of a cube. level, code : of the cube; records : (n,) in the order in which they came; order : (n,)
    their places in the order of their codes; codes : (n,) ascending."""

    level: int
    code: int
    records: Records
    order: NDArray[np.int64]
    codes: NDArray[np.int64]

    def points(self, members: NDArray[np.int64]) -> Records:
        """Points in the order in which they came, which compresses better than that of their codes. members : (n,)
        places in the order of codes."""
        return self.records[np.sort(self.order[members])]


@dataclass(frozen=True)
class Node:
    """A node of the octree. level, code : of its cube; records : (n,) its points."""

    level: int
    code: int
    records: Records


def buckets(octree: Octree, batches: Batches, folder: Path, level: int = 0, code: int = 0) -> Iterator[Bucket]:
    """Yield the points of a cube in buckets, in the order of their codes; points with equal codes keep their order.

    batches : gives the points each time that it is called, the same in the same order; folder : where points that are
    more than a bucket holds lie meanwhile, in a file without a name; level, code : of the cube.

    Raises
    ------
    OSError
        The folder has no room.
    """
    step = min(SPLIT_LEVELS, octree.deepest - level)
    counts = np.zeros(8**step, np.int64)
    for records in batches():
        counts += np.bincount(_inner_cubes(octree, records, level + step, code << 3 * step), minlength=len(counts))
    n_points = int(counts.sum())
    if n_points and (n_points <= BUCKET_POINTS or not step):
        yield _bucket(octree, np.concatenate(list(batches())), level, code)
    elif n_points:
        levels, numbers = _parts(counts, step)
        sizes = np.bincount(numbers, counts).astype(np.int64)
        first = np.flatnonzero(np.diff(numbers, prepend=-1))
        with tempfile.TemporaryFile(dir=folder) as file:
            spill = _Spill(file, sizes)
            for records in batches():
                spill.put(numbers[_inner_cubes(octree, records, level + step, code << 3 * step)], records)
            for number in np.flatnonzero(sizes).tolist():
                below = int(levels[first[number]])
                inner = (code << 3 * below) + int(first[number] >> 3 * (step - below))
                part = spill.part(number)
                if sizes[number] <= BUCKET_POINTS:
                    yield _bucket(octree, np.concatenate(list(part())), level + below, inner)
                else:
                    yield from buckets(octree, part, folder, level + below, inner)


def nodes(octree: Octree, sorted_buckets: Iterator[Bucket]) -> Iterator[Node]:
    """Yield the nodes of an octree, each when all buckets in its cube were seen, so that few are open at a time.

    sorted_buckets : in the order of their codes.
    """
    opened: dict[int, tuple[int, list[Records]]] = {}  # code and points of nodes above the buckets, by level
    sampling = _Sampling(octree)
    for bucket in sorted_buckets:
        for level in sorted(opened, reverse=True):
            if level >= bucket.level or opened[level][0] != bucket.code >> 3 * (bucket.level - level):
                code, parts = opened.pop(level)
                yield Node(level, code, np.concatenate(parts))
        levels = sampling.levels(bucket)
        order = np.argsort(levels, kind="stable")
        for level, chosen in _runs(levels[order], order):
            if level < bucket.level:
                code = bucket.code >> 3 * (bucket.level - level)
                opened.setdefault(level, (code, []))[1].append(bucket.points(chosen))
            else:
                for code, members in _runs(octree.cubes(bucket.codes[chosen], level), chosen):
                    yield Node(level, code, bucket.points(members))
    for level in sorted(opened, reverse=True):
        yield Node(level, opened[level][0], np.concatenate(opened[level][1]))


class _Sampling:
    """Chooses the level of each point, bucket after bucket.

    Cells of the uppermost levels may hold several buckets; the first of these with a point that is left gives it.
    """

    def __init__(self, octree: Octree) -> None:
        self._octree = octree
        self._last_cell: dict[int, int] = {}  # of the levels whose cells may hold several buckets

    def levels(self, bucket: Bucket) -> NDArray[np.int64]:
        """Level of the node that holds each point, (n,) int64."""
        octree = self._octree
        levels = np.full(len(bucket.codes), octree.deepest)
        left = np.arange(len(bucket.codes))
        for level in range(octree.deepest):
            if not len(left):
                break
            codes = bucket.codes[left]
            is_chosen = self._samples(codes, level, bucket.level)
            if level >= bucket.level:
                cubes = octree.cubes(codes, level)
                first = np.flatnonzero(np.diff(cubes, prepend=-1))
                lengths = np.diff(first, append=len(cubes))
                is_chosen |= np.repeat(lengths <= NODE_POINTS, lengths)
            levels[left[is_chosen]] = level
            left = left[~is_chosen]
        return levels

    def _samples(self, codes: NDArray[np.int64], level: int, bucket_level: int) -> NDArray[np.bool_]:
        """One point of each cell of a level, (n,) bool. codes : (n,) of the points that are left, ascending."""
        cells = self._octree.cubes(codes, level + CELL_BITS)
        is_chosen = np.zeros(len(codes), np.bool_)
        if level + CELL_BITS < bucket_level:
            if self._last_cell.get(level) == cells[0]:
                return is_chosen
            self._last_cell[level] = int(cells[0])
        first = np.flatnonzero(np.diff(cells, prepend=-1))
        lengths = np.diff(first, append=len(cells))
        hashed = (cells[first].astype(np.uint64) * SPREAD) >> np.uint64(33)
        is_chosen[first + (hashed % lengths.astype(np.uint64)).astype(np.int64)] = True
        return is_chosen


class _Spill:
    """Points in a file, part after part. Part number k has sizes[k] points."""

    def __init__(self, file: BinaryIO, sizes: NDArray[np.int64]) -> None:
        self._file, self._sizes = file, sizes
        self._first = np.cumsum(sizes) - sizes
        self._next = self._first.copy()
        self._dtype = np.dtype(np.void)

    def put(self, numbers: NDArray[np.int64], records: Records) -> None:
        """Append points to their parts. numbers : (n,), of the part of each point."""
        if not len(records):
            return
        if self._dtype != records.dtype:
            self._dtype = records.dtype
            if hasattr(os, "posix_fallocate"):  # a disk without room is told now
                os.posix_fallocate(self._file.fileno(), 0, int(self._sizes.sum()) * records.dtype.itemsize)
        order = np.argsort(numbers, kind="stable")
        for number, members in _runs(numbers[order], order):
            self._file.seek(int(self._next[number]) * records.dtype.itemsize)
            self._file.write(records[members].view(np.uint8).data)
            self._next[number] += len(members)

    def part(self, number: int) -> Batches:
        """The points of a part, in the order in which they came."""
        begin, end = int(self._first[number]), int(self._next[number])

        def batches() -> Iterator[Records]:
            for row in range(begin, end, BUCKET_POINTS):
                records = np.empty(min(BUCKET_POINTS, end - row), self._dtype)
                self._file.seek(row * self._dtype.itemsize)
                self._file.readinto(records.view(np.uint8).data)  # type: ignore[attr-defined]
                yield records

        return batches


def _inner_cubes(octree: Octree, records: Records, level: int, first: int) -> NDArray[np.int64]:
    """Place of each point's cube of a level among those of the cube that is worked on, whose first one is given."""
    return octree.cubes(octree.codes(records), level) - first


def _bucket(octree: Octree, records: Records, level: int, code: int) -> Bucket:
    codes = octree.codes(records)
    order = np.argsort(codes, kind="stable")
    return Bucket(level, code, records, order, codes[order])


def _parts(counts: NDArray[np.int64], step: int) -> tuple[NDArray[np.int8], NDArray[np.int64]]:
    """Divide a cube into the largest cubes with few points. counts : (8**step,) of the points in its smallest cubes.

    Returns for each of these the level of its part, counted from the cube, and the number of the part.
    """
    levels, sums = np.full(len(counts), step, np.int8), counts
    for level in range(step - 1, -1, -1):
        sums = sums.reshape(-1, 8).sum(axis=1)
        levels[np.repeat(sums <= BUCKET_POINTS, 8 ** (step - level))] = level
    begins = np.arange(len(counts)) % 8 ** (step - levels.astype(np.int64)) == 0
    return levels, np.cumsum(begins) - 1


def _runs(values: NDArray[np.int64], members: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield each value of an ascending array, and the members at its places."""
    edges = [*np.flatnonzero(np.diff(values, prepend=-1)).tolist(), len(values)]
    for begin, end in pairwise(edges):
        yield int(values[begin]), members[begin:end]
