"""Cloud-optimised point clouds: COPC 1.0, a LAZ 1.4 file whose chunks are the nodes of an octree.

Source: Hobu, Inc. (2021), Cloud Optimized Point Cloud Specification 1.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import laspy
import lazrs
import numpy as np
from laspy.errors import LaspyException
from laspy.vlrs.known import LasZipVlr
from laspy.vlrs.vlr import VLR
from numpy.typing import NDArray

from zlocus.core.errors import OutputError
from zlocus.io.atomic_write import atomic_file
from zlocus.io.points.octree import Batches, Node, Octree, Steps, buckets, nodes, position

# Points that are compressed at a time, node by node, by all cores.
PENDING_POINTS = 500_000
# Larger hierarchies are cut into pages of this many levels, of which a reader fetches those that it needs.
PAGE_NODES, PAGE_LEVELS = 4096, 5
# center x, y, z, half of the side, spacing, offset and size of the root page, GPS times, reserved
INFO = struct.Struct("<5d2Q2d88x")
ENTRY = struct.Struct("<4iQ2i")  # level, x, y, z, offset, size in bytes, number of points
EVLR_HEAD = struct.Struct("<H16sHQ32s")  # reserved, user, number, size in bytes, description
USER, INFO_ID, HIERARCHY_ID = "copc", 1, 1000
# In place of the number of points: the entry is that of a page.
PAGE = -1

Key = tuple[int, int]  # level and code of a node


@dataclass(frozen=True)
class StepBounds:
    """Bounds of points in whole steps of their file: their lowest and highest X, Y and Z, (3,) int64 each."""

    low: NDArray[np.int64]
    high: NDArray[np.int64]


class _Chunk(NamedTuple):
    """A node in the file: where its points begin, their size in bytes, and their number."""

    offset: int
    size: int
    n_points: int


def write_copc(path: Path, header: laspy.LasHeader, bounds: StepBounds, batches: Batches) -> int:
    """Write points as COPC, and return their number. The same points in the same order give the same bytes.

    Memory does not grow with their number: where they are more than a million, all of them lie meanwhile in a file
    without a name beside the result.

    header : LAS 1.4, point format 6, 7 or 8, with the same scale on all axes, the CRS and the extra dimensions;
    bounds : of the points; batches : yields the points, (n,) structured as the header says, and again the same each
    time that it is called.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    try:
        with atomic_file(path) as part, part.open("wb+") as file:
            return _CopcFile(file, header, bounds).write(batches, path.parent)
    except (OSError, LaspyException, lazrs.LazrsError) as error:
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
        raise OutputError(f"{path} cannot be written: {reason}. Check the folder and the space left.") from error


class _CopcFile:
    """A COPC file that is being written."""

    def __init__(self, file: BinaryIO, header: laspy.LasHeader, bounds: StepBounds) -> None:
        steps = Steps(float(header.scales[0]), np.asarray(header.offsets, np.float64))
        self._file, self._octree = file, Octree.around(steps, bounds.low, bounds.high)
        self._header = deepcopy(header)
        self._header.partial_reset()
        self._header.are_points_compressed = True
        point_format = self._header.point_format
        self._laz_vlr = lazrs.LazVlr.new_for_compression(point_format.id, point_format.num_extra_bytes, True)
        self._info = VLR(USER, INFO_ID, "COPC info VLR", bytes(INFO.size))
        # The record of COPC comes first: readers look for it at byte 375.
        others = [vlr for vlr in self._header.vlrs if not isinstance(vlr, LasZipVlr)]
        self._header.vlrs = [self._info, *others, LasZipVlr(self._laz_vlr.record_data())]

    def write(self, batches: Batches, folder: Path) -> int:
        """Write the whole file, and return the number of points. folder : for what memory has no room for."""
        file, header = self._file, self._header
        header.write_to(file)
        keys = self._write_chunks(nodes(self._octree, buckets(self._octree, batches, folder)))
        file.seek(header.offset_to_point_data)
        chunks, offset = {}, header.offset_to_point_data + 8  # behind the offset of the table of chunks
        for key, (n_points, size) in zip(keys, lazrs.read_chunk_table(file, self._laz_vlr), strict=True):
            chunks[key] = _Chunk(offset, size, n_points)
            offset += size
        header.start_of_first_evlr, header.number_of_evlrs = file.seek(0, 2), 1
        pages = _pages(chunks, header.start_of_first_evlr + EVLR_HEAD.size)
        hierarchy = b"".join(pages)
        file.write(EVLR_HEAD.pack(0, USER.encode(), HIERARCHY_ID, len(hierarchy), b"EPT Hierarchy"))
        file.write(hierarchy)
        self._info.record_data = self._info_record(len(pages[0]))
        if not header.point_count:
            header.mins = header.maxs = np.zeros(3)
        file.seek(0)
        header.write_to(file, ensure_same_size=True)
        return int(header.point_count)

    def _write_chunks(self, written_nodes: Iterator[Node]) -> list[Key]:
        """Compress the nodes, each as a chunk; returns which they are."""
        compressor = lazrs.ParLasZipCompressor(self._file, self._laz_vlr)
        compressor.reserve_offset_to_chunk_table()
        keys: list[Key] = []
        pending: list[NDArray[np.uint8]] = []
        n_pending = 0
        for node in written_nodes:
            self._header.grow(laspy.PackedPointRecord(node.records, self._header.point_format))
            keys.append((node.level, node.code))
            pending.append(node.records.view(np.uint8))
            n_pending += len(node.records)
            if n_pending >= PENDING_POINTS:
                compressor.compress_chunks(pending)
                pending, n_pending = [], 0
        if pending:
            compressor.compress_chunks(pending)
        compressor.done()
        return keys

    def _info_record(self, root_page_bytes: int) -> bytes:
        """What the file says of its octree."""
        octree, root_page = self._octree, self._header.start_of_first_evlr + EVLR_HEAD.size
        half = octree.side_m / 2
        return INFO.pack(*(octree.corner + half), half, octree.spacing_m, root_page, root_page_bytes, 0.0, 0.0)


def _pages(chunks: dict[Key, _Chunk], offset: int) -> list[bytes]:
    """The pages of the hierarchy, the root page first. offset : of the first page in the file."""
    if not chunks:
        return [ENTRY.pack(0, 0, 0, 0, 0, 0, 0)]
    levels = PAGE_LEVELS if len(chunks) > PAGE_NODES else 64
    roots: list[Key] = [(0, 0)]
    contents: list[tuple[list[Key], list[Key]]] = []  # of each page: its nodes, and the roots of pages below it
    for root in roots:  # grows meanwhile
        inner, outer = [], [root]
        for _ in range(levels):
            inner += outer
            outer = [child for level, code in outer for child in _children(level, code) if child in chunks]
        contents.append((inner, outer))
        roots += outer
    sizes = [ENTRY.size * (len(inner) + len(outer)) for inner, outer in contents]
    ends = np.cumsum(sizes).tolist()
    page_of = {
        root: _Chunk(offset + end - size, size, PAGE) for root, end, size in zip(roots, ends, sizes, strict=True)
    }
    return [
        b"".join(
            ENTRY.pack(level, *position(code), *table[level, code])
            for table, keys in ((chunks, inner), (page_of, outer))
            for level, code in keys
        )
        for inner, outer in contents
    ]


def _children(level: int, code: int) -> Iterator[Key]:
    return ((level + 1, (code << 3) + k) for k in range(8))
