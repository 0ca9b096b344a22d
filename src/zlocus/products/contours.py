"""contours.gpkg: lines of equal height."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from affine import Affine

from zlocus.core.errors import ConfigError
from zlocus.core.options import ProductOptions
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import local_frame
from zlocus.io.row_strips import STRIP_ROWS, BandReader, strips_of
from zlocus.products.tie_layers import Batch, write_features

# By default so many contours at most within two standard deviations of the mean height, and no nearer than this.
WANTED, CLOSEST_M = 25, 0.1
MOST_LEVELS = 20000
# Lines run so much above their height: none then goes exactly through a cell's centre, where its way is ambiguous, for
# no float32 below 10 km is this number away from a multiple of a useful interval.
ABOVE_M = 1.234567e-6
# Coordinates keep so many digits of a cell; a strip gives the same points to far more.
DIGITS = 4
ON_ROW = 1e-9
BATCH_POINTS, POINT_BYTES = 1_000_000, 16
# Line ends that wait for their continuation: row, level and the column before it.
Place = tuple[int, int, int]


def write_contours(raster: Path, path: Path, options: ProductOptions, strip_rows: int = STRIP_ROWS) -> None:
    """Layer `contours`: 2-D lines with their `elevation_m`, from low to high, higher ground on their right; the CRS
    says what that is above as far as the raster's does.

    Lines are straight between the lines that join cells' centres, where heights are linear; they end at holes and at
    the rim. Short closed ones, of which noise and trees make thousands, are left out. raster : of heights; strip_rows :
    rows worked on at a time, which change no line.

    Raises
    ------
    InputError
        The raster of heights is missing or damaged.
    ConfigError
        The interval asked for is too small for the relief.
    OutputError
        The file cannot be written.
    """
    from shapely import linestrings

    with BandReader(raster) as heights:
        interval = options.contour_interval_m or nice_interval(heights.statistic("STDDEV") or 0.0)
        _check_number(heights, interval, raster)
        transform, crs = heights.geobox.transform, heights.crs or local_frame()

        def batches() -> Iterator[Batch]:
            for levels, lines in batched(contours(heights, interval, strip_rows, options.contour_least_cells)):
                geometries = np.array([linestrings(_on_map(line, transform)) for line in lines], dtype=object)
                # Counted in steps, then multiplied: a sum of steps would drift.
                yield geometries, {"elevation_m": _rounded(np.array(levels, np.float64) * interval)}

        write_features(path, "contours", "LineString", batches(), crs)


def nice_interval(deviation_m: float) -> float:
    """1, 2 or 5 times a power of ten, m: 10 to 25 contours within two standard deviations of the mean height."""
    least = max(4.0 * deviation_m / WANTED, CLOSEST_M)
    power = math.floor(math.log10(least) + 1e-9)
    candidates = [float(f"{digit}e{p}") for p in (power, power + 1) for digit in (1, 2, 5)]
    return next(value for value in candidates if value >= least * (1 - 1e-9))


@dataclass(eq=False)
class _Chain:
    """A line that may go on at both ends. pieces : (n, 2) each, the last point of one is the first of the next."""

    pieces: list[FloatArray]
    head: Place | None
    tail: Place | None
    is_closed: bool = False

    def points(self) -> FloatArray:
        """All of it, (n, 2), rounded; a closed line starts at its first point from the north-west."""
        parts = [self.pieces[0], *(piece[1:] for piece in self.pieces[1:])]
        line = np.asarray(np.round(np.concatenate(parts), DIGITS), np.float64)
        if self.is_closed:
            line[-1] = line[0]
        line = line[np.r_[True, (np.diff(line, axis=0) != 0).any(axis=1)]]
        if len(line) > 2 and (line[0] == line[-1]).all():
            first = int(np.lexsort((line[:-1, 0], line[:-1, 1]))[0])
            line = np.concatenate([line[first:-1], line[: first + 1]])
        return line


@dataclass
class _Stitcher:
    """Lines of strips become whole ones; those that cannot go on are handed out, with their height in intervals."""

    live: dict[_Chain, int] = field(default_factory=dict)
    heads: dict[Place, _Chain] = field(default_factory=dict)
    tails: dict[Place, _Chain] = field(default_factory=dict)

    def add(self, level: int, line: FloatArray, head: Place | None, tail: Place | None) -> None:
        """A piece, (n, 2), and the places on shared rows where it starts and ends."""
        before = self.tails.pop(head) if head in self.tails else None
        if before is None:
            chain = _Chain([line], head, tail)
            self.live[chain] = level
        else:
            chain = before
            chain.pieces.append(line)
            chain.tail = tail
        after = self.heads.pop(tail) if tail in self.heads else None
        if after is chain:
            chain.is_closed, chain.head, chain.tail = True, None, None
            return
        if after is not None:
            chain.pieces.extend(after.pieces)
            chain.tail = after.tail
            del self.live[after]
        if chain.head is not None and before is None:
            self.heads[chain.head] = chain
        if chain.tail is not None:
            self.tails[chain.tail] = chain

    def finished(self, row: int) -> Iterator[tuple[int, FloatArray]]:
        """The lines, (n, 2), that no strip from a row on can lengthen."""
        for chain in [c for c in self.live if not any(end is not None and end[0] >= row for end in (c.head, c.tail))]:
            level = self.live.pop(chain)
            for end, ends in ((chain.head, self.heads), (chain.tail, self.tails)):
                if end is not None:
                    ends.pop(end, None)
            if len(line := chain.points()) > 1:
                yield level, line


def contours(
    heights: BandReader, interval_m: float, strip_rows: int = STRIP_ROWS, least_cells: float = 0.0
) -> Iterator[tuple[int, FloatArray]]:
    """Heights in intervals, and lines (n, 2) as (column, row), (0, 0) the first cell's centre; from low to high, those
    of one height by their first points, from north to south; without closed ones shorter than `least_cells`.

    Lines wait on disk until all are known: held are those that still grow, and where the others are.
    """
    stitcher = _Stitcher()
    n_rows, n_cols = heights.geobox.shape
    with TemporaryFile(dir=heights.path.parent) as waiting:
        # Height, first point's row and column, length, place in the file.
        index: list[tuple[int, float, float, int, int]] = []

        def keep(row: int) -> None:
            for level, line in stitcher.finished(row):
                if _is_ring_below(line, least_cells):
                    continue
                index.append((level, line[0, 1], line[0, 0], len(line), waiting.tell()))
                waiting.write(line.tobytes())

        for strip in strips_of(n_rows - 1, 0, strip_rows) if n_cols > 1 else ():
            # And the first row of the next one, which both share.
            z = heights.read_rows(strip.row, strip.rows + 1).astype(np.float64)
            for level, line in _traced(z, interval_m):
                ends = [_place(point, strip.row, strip.rows, level) for point in (line[0], line[-1])]
                is_whole = (line[0] == line[-1]).all()
                head, tail = (None, None) if is_whole else ends
                stitcher.add(level, line + np.array([0.0, strip.row]), head, tail)
            keep(strip.row + strip.rows)
        keep(n_rows)
        for level, _, _, n, at in sorted(index):
            waiting.seek(at)
            yield level, np.frombuffer(waiting.read(n * POINT_BYTES)).reshape(n, 2)


def batched(lines: Iterable[tuple[int, FloatArray]]) -> Iterator[tuple[list[int], list[FloatArray]]]:
    """The same by as many lines as hold `BATCH_POINTS`; one batch at least."""
    levels: list[int] = []
    held: list[FloatArray] = []
    n_points, is_any = 0, False
    for level, line in lines:
        levels.append(level)
        held.append(line)
        n_points += len(line)
        if n_points >= BATCH_POINTS:
            yield levels, held
            levels, held, n_points, is_any = [], [], 0, True
    if levels or not is_any:
        yield levels, held


def _traced(z: FloatArray, interval_m: float) -> Iterator[tuple[int, FloatArray]]:
    """Lines of a strip, their first row 0, and their heights in intervals."""
    from contourpy import contour_generator

    known = np.isfinite(z)
    if not known.any():
        return
    generator = contour_generator(z=np.ma.array(z, mask=~known), corner_mask=False, name="serial")
    low, high = float(z[known].min()), float(z[known].max())
    for level in range(math.ceil((low - ABOVE_M) / interval_m), math.floor((high - ABOVE_M) / interval_m) + 1):
        for line in generator.lines(level * interval_m + ABOVE_M):
            yield level, np.asarray(line, np.float64)


def _is_ring_below(line: FloatArray, least_cells: float) -> bool:
    """Whether a line (n, 2) is closed and shorter than so many cells."""
    return bool((line[0] == line[-1]).all()) and float(np.hypot(*np.diff(line, axis=0).T).sum()) < least_cells


def _place(point: FloatArray, row: int, rows: int, level: int) -> Place | None:
    """Where the end of a line lies on the first or last row of its strip; None elsewhere."""
    for shared in (0, rows):
        if abs(point[1] - shared) < ON_ROW:
            return row + shared, level, int(point[0])
    return None


def _on_map(line: FloatArray, transform: Affine) -> FloatArray:
    """Columns and rows of cells' centres as coordinates. (n, 2) each."""
    col, row = line[:, 0] + 0.5, line[:, 1] + 0.5
    return np.column_stack([transform.a * col + transform.c, transform.e * row + transform.f])


def _check_number(heights: BandReader, interval_m: float, raster: Path) -> None:
    low, high = heights.statistic("MINIMUM") or 0.0, heights.statistic("MAXIMUM") or 0.0
    if (high - low) / interval_m > MOST_LEVELS:
        raise ConfigError(
            f"Contours every {interval_m:g} m of {raster}, whose heights go from {low:.1f} to {high:.1f} m, are more "
            f"than {MOST_LEVELS} heights. Give a larger products.contour_interval_m."
        )


def _rounded(values: FloatArray) -> FloatArray:
    """Without the digits that multiplying by a decimal fraction brings."""
    return np.asarray(np.round(values, 6), np.float64)
