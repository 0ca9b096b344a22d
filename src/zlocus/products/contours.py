"""contours.gpkg: lines of equal height."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.errors import ConfigError
from zlocus.io.crs import local_frame
from zlocus.options import ProductOptions
from zlocus.products.points import write_features
from zlocus.products.strips import STRIP_ROWS, ReadBand, strips_of
from zlocus.sensors.model import FloatArray

# By default so many contours at most within two standard deviations of the mean height, and no nearer than this.
WANTED, CLOSEST_M = 25, 0.1
MOST_LEVELS = 20000
# Lines run so much above their height: none then goes exactly through a cell's centre, where its way is ambiguous, for
# no float32 below 10 km is this number away from a multiple of a useful interval.
ABOVE_M = 1.234567e-6
# Coordinates keep so many digits of a cell; a strip gives the same points to far more.
DIGITS = 4
ON_ROW = 1e-9
# Line ends that wait for their continuation: row, level and the column before it.
Place = tuple[int, int, int]


def write_contours(raster: Path, path: Path, options: ProductOptions, strip_rows: int = STRIP_ROWS) -> None:
    """Layer `contours`: 2-D lines with their `elevation_m`, from low to high, higher ground on their right.

    Lines are straight between the lines that join cells' centres, where heights are linear; they end at holes and at
    the rim. raster : of heights; strip_rows : rows worked on at a time, which change no line.

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

    with ReadBand(raster) as heights:
        interval = options.contour_interval_m or nice_interval(heights.statistic("STDDEV") or 0.0)
        _check_number(heights, interval, raster)
        lines, levels = contours(heights, interval, strip_rows)
        transform, crs = heights.geobox.transform, heights.crs or local_frame()
    geometries = np.array([linestrings(_on_map(line, transform)) for line in lines], dtype=object)
    # Counted in steps, then multiplied: a sum of steps would drift.
    columns: dict[str, NDArray[np.generic]] = {"elevation_m": _rounded(np.array(levels, np.float64) * interval)}
    write_features(path, "contours", "LineString", geometries, columns, CRS(crs.to_2d()))


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
    """Lines of strips become whole ones, level by level."""

    chains: dict[int, dict[_Chain, None]] = field(default_factory=dict)
    heads: dict[Place, _Chain] = field(default_factory=dict)
    tails: dict[Place, _Chain] = field(default_factory=dict)

    def add(self, level: int, line: FloatArray, head: Place | None, tail: Place | None) -> None:
        """A piece, (n, 2), and the places on shared rows where it starts and ends."""
        before = self.tails.pop(head) if head in self.tails else None
        if before is None:
            chain = _Chain([line], head, tail)
            self.chains.setdefault(level, {})[chain] = None
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
            del self.chains[level][after]
        if chain.head is not None and before is None:
            self.heads[chain.head] = chain
        if chain.tail is not None:
            self.tails[chain.tail] = chain


def contours(heights: ReadBand, interval_m: float, strip_rows: int = STRIP_ROWS) -> tuple[list[FloatArray], list[int]]:
    """Lines (n, 2) as (column, row), (0, 0) the first cell's centre, and their heights in intervals; from low to high,
    those of one height by their first points, from north to south."""
    stitcher = _Stitcher()
    n_rows, n_cols = heights.geobox.shape
    if n_cols > 1:
        for strip in strips_of(n_rows - 1, 0, strip_rows):
            # And the first row of the next one, which both share.
            z = heights.read_rows(strip.row, strip.rows + 1).astype(np.float64)
            for level, line in _traced(z, interval_m):
                ends = [_place(point, strip.row, strip.rows, level) for point in (line[0], line[-1])]
                is_whole = (line[0] == line[-1]).all()
                head, tail = (None, None) if is_whole else ends
                stitcher.add(level, line + np.array([0.0, strip.row]), head, tail)
    lines = []
    for level in sorted(stitcher.chains):
        found = [line for chain in stitcher.chains[level] if len(line := chain.points()) > 1]
        lines += [(level, line) for line in sorted(found, key=lambda line: (line[0, 1], line[0, 0], len(line)))]
    return [line for _, line in lines], [level for level, _ in lines]


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


def _check_number(heights: ReadBand, interval_m: float, raster: Path) -> None:
    low, high = heights.statistic("MINIMUM") or 0.0, heights.statistic("MAXIMUM") or 0.0
    if (high - low) / interval_m > MOST_LEVELS:
        raise ConfigError(
            f"Contours every {interval_m:g} m of {raster}, whose heights go from {low:.1f} to {high:.1f} m, are more "
            f"than {MOST_LEVELS} heights. Give a larger products.contour_interval_m."
        )


def _rounded(values: FloatArray) -> FloatArray:
    """Without the digits that multiplying by a decimal fraction brings."""
    return np.asarray(np.round(values, 6), np.float64)
