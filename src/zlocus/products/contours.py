"""contours.gpkg: lines of equal height."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO, NamedTuple

import numpy as np
from affine import Affine

from zlocus.core.errors import ConfigError
from zlocus.core.options import ProductOptions
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import local_frame
from zlocus.io.row_strips import STRIP_ROWS, BandReader, strips_of
from zlocus.products.tie_layers import Batch, write_features

# The default interval gives at most this many contours within two standard deviations of the mean height.
MAX_DEFAULT_CONTOURS = 25
MIN_DEFAULT_INTERVAL_M = 0.1
MAX_CONTOUR_HEIGHTS = 20000
# Every line is traced this much above its nominal height. A line through a cell's centre would be ambiguous, and no
# float32 height below 10 km is exactly this far from a multiple of a useful interval.
TRACED_ABOVE_M = 1.234567e-6
# Coordinates are rounded to this many decimals of a cell.
COORDINATE_DECIMALS = 4
# Tolerance, in cells, within which an end of a line lies on the first or last row of its strip.
ON_ROW_CELLS = 1e-9
BATCH_POINTS, POINT_BYTES = 1_000_000, 16


def write_contours(raster: Path, path: Path, options: ProductOptions, strip_rows: int = STRIP_ROWS) -> None:
    """Write the contours of a raster of heights as a GeoPackage.

    Its layer `contours` holds 2-D lines with their `elevation_m`, from low to high, with the higher ground on their
    right. The CRS names the vertical datum where the raster's CRS does. Between the centres of cells heights are
    linear. Lines end at cells without a height and at the edge of the raster. Closed lines shorter than
    `min_contour_cells` are left out, because noise and trees make thousands of them. strip_rows : rows that are
    traced at a time; they change no line.

    Raises
    ------
    InputError
        The raster of heights is missing or damaged.
    ConfigError
        The interval is too small for the range of heights.
    OutputError
        The file cannot be written.
    """
    from shapely import linestrings

    with BandReader(raster) as reader:
        interval = contour_interval_m(reader, options)
        _check_number(reader, interval, raster)
        transform, crs = reader.geobox.transform, reader.crs or local_frame()

        def batches() -> Iterator[Batch]:
            for levels, lines in batched(contours(reader, interval, strip_rows, options.min_contour_cells)):
                geometries = np.array([linestrings(_map_coordinates(line, transform)) for line in lines], dtype=object)
                # A product of number and interval, since a sum of intervals would drift.
                yield geometries, {"elevation_m": _rounded(np.array(levels, np.float64) * interval)}

        write_features(path, "contours", "LineString", batches(), crs)


def contour_interval_m(reader: BandReader, options: ProductOptions) -> float:
    """Difference in height between two contours of a raster, m: as the options say, else a round one."""
    return options.contour_interval_m or nice_interval(reader.statistic("STDDEV") or 0.0)


def nice_interval(deviation_m: float) -> float:
    """1, 2 or 5 times a power of ten, m: 10 to 25 contours within two standard deviations of the mean height."""
    least = max(4.0 * deviation_m / MAX_DEFAULT_CONTOURS, MIN_DEFAULT_INTERVAL_M)
    power = math.floor(math.log10(least) + 1e-9)
    candidates = [float(f"{digit}e{p}") for p in (power, power + 1) for digit in (1, 2, 5)]
    return next(value for value in candidates if value >= least * (1 - 1e-9))


class StoredLine(NamedTuple):
    """Where a line is stored. first_row, first_col : its first point, in cells; n_points; offset : bytes."""

    first_row: float
    first_col: float
    n_points: int
    offset: int


@dataclass
class _LineStore:
    """Lines on disk, so that memory holds only their places. level : height of a line, in intervals."""

    file: BinaryIO
    whole_lines: dict[int, list[StoredLine]] = field(default_factory=lambda: defaultdict(list))
    line_pieces: dict[int, list[StoredLine]] = field(default_factory=lambda: defaultdict(list))

    def put(self, line: FloatArray) -> StoredLine:
        """Write a line (n, 2) at the end of the file."""
        stored_line = StoredLine(line[0, 1], line[0, 0], len(line), self.file.seek(0, 2))
        self.file.write(np.ascontiguousarray(line).tobytes())
        return stored_line

    def get(self, stored_line: StoredLine) -> FloatArray:
        """Read a line (n, 2)."""
        self.file.seek(stored_line.offset)
        return np.frombuffer(self.file.read(stored_line.n_points * POINT_BYTES)).reshape(-1, 2)

    def levels(self) -> list[int]:
        """Heights that have a line, in intervals, from low to high."""
        return sorted(self.whole_lines.keys() | self.line_pieces.keys())


def contours(
    reader: BandReader, interval_m: float, strip_rows: int = STRIP_ROWS, min_ring_cells: float = 0.0
) -> Iterator[tuple[int, FloatArray]]:
    """Yield the height of each contour, in intervals, and its line (n, 2) as (column, row).

    (0, 0) is the centre of the first cell. Lines come from low to high; lines of one height are ordered by their first
    points, from north to south. Closed lines shorter than `min_ring_cells` are left out.

    The raster is traced in strips that share one row. Lines that end on a shared row are joined afterwards, height by
    height, and all lines wait on disk: memory holds one strip, then the unjoined lines of one height.
    """
    n_rows, n_cols = reader.geobox.shape
    with TemporaryFile(dir=reader.path.parent) as file:
        store = _LineStore(file)
        for strip in strips_of(n_rows - 1, 0, strip_rows) if n_cols > 1 else ():
            # One row more, which is the first row of the next strip.
            z = reader.read_rows(strip.row, strip.rows + 1).astype(np.float64)
            for level, line in _traced(z, interval_m):
                is_closed = (line[0] == line[-1]).all()
                is_cut = not is_closed and _snap_ends(line, z, level * interval_m + TRACED_ABOVE_M)
                line += (0.0, strip.row)
                if is_cut:
                    store.line_pieces[level].append(store.put(line))
                else:
                    _keep(store, level, line, min_ring_cells)
        for level in store.levels():
            pieces = store.line_pieces.pop(level, [])
            for line in _joined([store.get(piece) for piece in pieces]):
                _keep(store, level, line, min_ring_cells)
            for stored_line in sorted(store.whole_lines.pop(level, [])):
                yield level, store.get(stored_line)


def _keep(store: _LineStore, level: int, line: FloatArray, min_ring_cells: float) -> None:
    """Store a whole line (n, 2), normalised, unless it is a point or a short ring."""
    line = _normalised(line)
    if len(line) > 1 and not _is_ring_below(line, min_ring_cells):
        store.whole_lines[level].append(store.put(line))


def _joined(pieces: list[FloatArray]) -> Iterator[FloatArray]:
    """Lines (n, 2) of pieces whose ends have equal coordinates, in the direction of the pieces."""
    from shapely import get_coordinates, get_parts, line_merge, multilinestrings
    from shapely import linestrings as lines_of

    if pieces:
        merged = line_merge(multilinestrings([lines_of(piece) for piece in pieces]), directed=True)
        yield from (get_coordinates(line) for line in get_parts(merged))


def batched(lines: Iterable[tuple[int, FloatArray]]) -> Iterator[tuple[list[int], list[FloatArray]]]:
    """Group lines into batches of about `BATCH_POINTS` points; at least one batch, which may be empty."""
    levels: list[int] = []
    waiting: list[FloatArray] = []
    n_points, is_any = 0, False
    for level, line in lines:
        levels.append(level)
        waiting.append(line)
        n_points += len(line)
        if n_points >= BATCH_POINTS:
            yield levels, waiting
            levels, waiting, n_points, is_any = [], [], 0, True
    if levels or not is_any:
        yield levels, waiting


def _traced(z: FloatArray, interval_m: float) -> Iterator[tuple[int, FloatArray]]:
    """Heights in intervals, and lines (n, 2) of a strip (r, c) as (column, row)."""
    from contourpy import contour_generator

    known = np.isfinite(z)
    if not known.any():
        return
    generator = contour_generator(z=np.ma.array(z, mask=~known), corner_mask=False, name="serial")
    low, high = float(z[known].min()), float(z[known].max())
    first, last = (low - TRACED_ABOVE_M) / interval_m, (high - TRACED_ABOVE_M) / interval_m
    for level in range(math.ceil(first), math.floor(last) + 1):
        for line in generator.lines(level * interval_m + TRACED_ABOVE_M):
            yield level, np.array(line, np.float64)


def _snap_ends(line: FloatArray, z: FloatArray, height_m: float) -> bool:
    """Compute ends of a line (n, 2) on the first and last row of its strip z (r, c) anew; return whether there are any.

    Both strips that share a row then have exactly equal ends, since both compute them from the same two heights.
    """
    is_cut = False
    for end in (0, -1):
        row = round(line[end, 1])
        if row in (0, len(z) - 1) and abs(line[end, 1] - row) < ON_ROW_CELLS:
            col = min(int(line[end, 0]), z.shape[1] - 2)
            left, right = z[row, col], z[row, col + 1]
            line[end] = col + (height_m - left) / (right - left), row
            is_cut = True
    return is_cut


def _normalised(line: FloatArray) -> FloatArray:
    """A line (n, 2), rounded and without repeated points.

    A closed line starts at its northernmost point; of several, at the westernmost of these.
    """
    line = np.asarray(np.round(line, COORDINATE_DECIMALS), np.float64)
    line = line[np.r_[True, (np.diff(line, axis=0) != 0).any(axis=1)]]
    if len(line) > 2 and (line[0] == line[-1]).all():
        first = int(np.lexsort((line[:-1, 0], line[:-1, 1]))[0])
        line = np.concatenate([line[first:-1], line[: first + 1]])
    return line


def _is_ring_below(line: FloatArray, min_cells: float) -> bool:
    """Whether a line (n, 2) is closed and shorter than `min_cells`."""
    return bool((line[0] == line[-1]).all()) and float(np.hypot(*np.diff(line, axis=0).T).sum()) < min_cells


def _map_coordinates(line: FloatArray, transform: Affine) -> FloatArray:
    """Map coordinates (n, 2) of columns and rows (n, 2), which count from the first cell's centre."""
    col, row = line[:, 0] + 0.5, line[:, 1] + 0.5
    return np.column_stack([transform.a * col + transform.c, transform.e * row + transform.f])


def _check_number(reader: BandReader, interval_m: float, raster: Path) -> None:
    low, high = reader.statistic("MINIMUM") or 0.0, reader.statistic("MAXIMUM") or 0.0
    if (high - low) / interval_m > MAX_CONTOUR_HEIGHTS:
        raise ConfigError(
            f"Contours every {interval_m:g} m of {raster}, whose heights go from {low:.1f} to {high:.1f} m, are more "
            f"than {MAX_CONTOUR_HEIGHTS} heights. Give a larger products.contour_interval_m."
        )


def _rounded(values: FloatArray) -> FloatArray:
    """Values without the digits that multiplication by a decimal fraction brings."""
    return np.asarray(np.round(values, 6), np.float64)
