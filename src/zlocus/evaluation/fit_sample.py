"""Places at which a surface is fitted to its reference: points or cells of a raster, and the surface around them.

A surface and a reference may have billions of cells or points. Only windows of both are held in memory, spread over
what they have in common.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import Points, converted, in_metres, points_on
from zlocus.evaluation.height_file import BLOCK, HeightFile
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.point_choice import PointChoice
from zlocus.evaluation.point_reference import PointReference
from zlocus.evaluation.truth import places
from zlocus.evaluation.vertical import above, above_geoid, geoid_datum, stated_datum
from zlocus.io.crs import is_on_earth
from zlocus.io.open_raster import cached_raster
from zlocus.io.points.ground_points import KnownPoints
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum
from zlocus.matching.quality import Quality

# Cells of the surface that are held in memory, with their medians: 360 MB.
MAX_CELLS = 30_000_000
MAX_POINTS = 200_000
# Places that are looked up for all points together, where a point is the mean of an area.
MAX_PLACES = 2_000_000
SEED = 0
# Beside the largest shift, slopes are measured this far away.
SLOPE_REACH_CELLS = 10


@dataclass(frozen=True, eq=False)
class FitPart:
    """A window of the surface, and the points in it. z : (n,) true heights, m; time_s : (n,) s, NaN where unknown.

    n_available : number of points there, of which these may be a part.
    """

    surface: HeightRaster
    points: Points
    z: FloatArray
    time_s: FloatArray
    n_available: int = 0

    @cached_property
    def smooth(self) -> HeightRaster:
        """The surface with the median of 3 x 3 cells in each; NaN where one of them has no height."""
        known = np.isfinite(self.surface.z)
        middle = float(np.median(self.surface.z[known])) if known.any() else 0.0
        filled = np.where(known, self.surface.z - middle, 0.0).astype(np.float32)
        whole = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        return replace(self.surface, z=np.where(whole, cv2.medianBlur(filled, 3), np.float32(np.nan)))


@dataclass(frozen=True, eq=False)
class FitSample:
    """All places at which a surface is compared with its reference to be fitted to it.

    cell_m : side of the surface's cells. n_available : number of places that the reference has in the surface, of which
    the sample may be a part. datums, assumed, geoid_added_to : see `PointReference`. left_out : number of points that
    were left out, by the reason.
    """

    parts: tuple[FitPart, ...]
    cell_m: float
    n_available: int
    datums: tuple[str | None, str | None] = (None, None)
    assumed: tuple[str, ...] = ()
    geoid_added_to: Path | None = None
    left_out: dict[str, int] | None = None

    def __len__(self) -> int:
        return sum(len(part.z) for part in self.parts)

    @property
    def xy(self) -> FloatArray:
        """Places (n, 2) of all parts."""
        return np.concatenate([part.points.xy for part in self.parts])

    @property
    def z(self) -> FloatArray:
        """True heights (n,) m of all parts."""
        return np.concatenate([part.z for part in self.parts])

    @property
    def time_s(self) -> FloatArray:
        """Times (n,) s of all parts."""
        return np.concatenate([part.time_s for part in self.parts])

    def heights(self, shift: Sequence[float] | FloatArray) -> FloatArray:
        """Heights (n,) m of the surface between its cells, at the places shifted by (east, north) m."""
        return np.concatenate(
            [part.points.heights(part.surface, HeightRaster.between_cells, shift) for part in self.parts]
        )

    def differences(self, shift: Sequence[float] | FloatArray) -> FloatArray:
        """Heights (n,) m of the shifted surface less those of the reference; NaN where it has none."""
        return self.heights(shift) - self.z

    def slopes(self, shift: Sequence[float] | FloatArray, half_step_m: float) -> FloatArray:
        """Slopes (n, 2) of the surface to the east and north, over twice a distance, at shifted places.

        They are those of medians of 3 x 3 cells, because slopes of single wrong heights would hide those of the ground.
        """
        at, columns = np.asarray(shift, float), []
        for step in (np.array((half_step_m, 0.0)), np.array((0.0, half_step_m))):
            ahead, behind = (
                np.concatenate(
                    [part.points.heights(part.smooth, HeightRaster.between_cells, place) for part in self.parts]
                )
                for place in (at + step, at - step)
            )
            columns.append((ahead - behind) / (2 * half_step_m))
        return np.column_stack(columns)

    def some(self, n: int) -> FitSample:
        """About n of the places, chosen at random."""
        share = n / max(len(self), 1)
        return self if share >= 1 else self.where(np.random.default_rng(SEED).random(len(self)) < share)

    def where(self, chosen: NDArray[np.bool_]) -> FitSample:
        """The places that a mask (n,) selects."""
        ends = np.cumsum([len(part.z) for part in self.parts])[:-1]
        parts = [
            replace(part, points=part.points.where(one), z=part.z[one], time_s=part.time_s[one])
            for part, one in zip(self.parts, np.split(chosen, ends), strict=True)
        ]
        return replace(self, parts=tuple(parts))


def check_on_map(height_file: HeightFile) -> None:
    """Refuse a surface that is not on a map in metres.

    Raises
    ------
    InputError
        Its CRS is in degrees, feet or other units.
    """
    if not in_metres(height_file.horizontal):
        raise InputError(
            f"{height_file.path} is not on a map in metres, on which it can be moved. Reproject it first "
            "(gdalwarp -t_srs EPSG:326nn)."
        )


def sample_of_points(reference: PointReference, max_shift_m: float, quality: Path | None = None) -> FitSample:
    """The surface around the points of a file: of more than `MAX_POINTS` a random choice.

    max_shift_m : how far the surface is moved at most. quality : flags of the surface; cells that were filled or are
    water are left out.

    Raises
    ------
    InputError
        See `PointReference.chunks`.
    """
    choice = PointChoice(MAX_POINTS)
    for points in reference.chunks():
        choice.add(points)
    sample = sample_around(reference.height_file, choice.points, max_shift_m, quality)
    return replace(
        sample, n_available=choice.n, datums=reference.datums, assumed=reference.assumed,
        geoid_added_to=reference.geoid_added_to, left_out=reference.dropped,
    )  # fmt: skip


def sample_around(
    height_file: HeightFile, points: KnownPoints, max_shift_m: float, quality: Path | None = None
) -> FitSample:
    """The surface around points in its CRS, all inside of it; see `sample_of_points`."""
    blocks = height_file.blocks_of(points.xyz[:, :2])
    rim = math.ceil(max_shift_m / height_file.cell) + SLOPE_REACH_CELLS
    side = BLOCK + 2 * rim
    parts = []
    for row, col in _spread(list(blocks), MAX_CELLS // side**2):
        window = _window(height_file, (row * BLOCK - rim, col * BLOCK - rim, side, side), quality)
        chosen = points.where(blocks[row, col])
        parts.append(FitPart(window, Points(chosen.xyz[:, :2]), chosen.xyz[:, 2], chosen.time_s))
    return FitSample(tuple(parts), height_file.cell, len(points))


def _spread(blocks: list[tuple[int, int]], n: int) -> list[tuple[int, int]]:
    """At most n of the blocks (one at least), spread over all."""
    if len(blocks) <= n:
        return blocks
    chosen = np.random.default_rng(SEED).permutation(len(blocks))[: max(n, 1)]
    return [blocks[i] for i in sorted(chosen)]


def _window(height_file: HeightFile, place: tuple[int, int, int, int], quality: Path | None) -> HeightRaster:
    """A window of the surface without cells that were filled. place : first row and column, rows and columns."""
    surface = height_file.window(*place)
    if quality is None:
        return surface
    top, left = max(place[0], 0), max(place[1], 0)
    rows, cols = surface.z.shape
    with cached_raster(quality) as source:
        flags = source.read(1, window=Window(left, top, cols, rows))
    return replace(surface, z=np.where(flags & np.uint16(Quality.FILLED), np.nan, surface.z))


@dataclass(frozen=True, eq=False)
class RasterHeights:
    """The heights of a raster, as the reference of a surface. Fields as of `PointReference`."""

    height_file: HeightFile
    reference: HeightFile
    datums: tuple[str | None, str | None]
    reference_vertical_datum: VerticalDatum
    surface_vertical_datum: VerticalDatum
    geoid_added_to: Path | None

    @classmethod
    def open(cls, height_file: HeightFile, path: Path, geoid: Path | None) -> RasterHeights:
        """Open a raster of heights as the reference of a surface.

        Raises
        ------
        InputError, ConfigError
            The file cannot be read; the CRS or vertical datums do not go together.
        """
        reference = HeightFile.open(path)
        mine, theirs = height_file.horizontal, reference.horizontal
        if theirs is not None and (mine is None and theirs.is_geographic):
            raise InputError(f"{path} is in degrees and {height_file.path} has no CRS. Assign it one (gdal_edit).")
        for file_path, crs in ((height_file.path, mine), (path, theirs)):
            if mine is not None and theirs is not None and mine != theirs and crs is not None and not is_on_earth(crs):
                raise InputError(f"{file_path} has the CRS {crs.name}, which cannot be converted to that of the other.")
        datums = tuple(stated_datum(one.spatial, one.path, one.description) for one in (height_file, reference))
        raised = above_geoid((height_file.path, path), (datums[0], datums[1]), geoid)
        added = ELLIPSOIDAL if geoid is None or raised is None else geoid_datum(geoid)
        if added.geoid is not None and (mine is None or theirs is None):
            raise InputError(
                f"{path} or {height_file.path} has no CRS, so no geoid can be added. Assign one (gdal_edit)."
            )
        return cls(
            height_file, reference, (datums[0], datums[1]), added if raised == path else ELLIPSOIDAL,
            added if raised == height_file.path else ELLIPSOIDAL, raised,
        )  # fmt: skip

    @property
    def assumed(self) -> tuple[str, ...]:
        """What had to be assumed, as sentences."""
        found, (mine, theirs) = list[str](), self.datums
        if self.geoid_added_to is None and (mine is None) != (theirs is None):
            silent = self.reference.path if theirs is None else self.height_file.path
            found.append(
                f"{silent} does not state its vertical datum: taken to be {above(mine or theirs)}, as of the other"
            )
        without = [str(one.path) for one in (self.height_file, self.reference) if one.horizontal is None]
        if without:
            verb = "has" if len(without) == 1 else "have"
            found.append(f"{' and '.join(without)} {verb} no CRS: coordinates were compared as they are")
        return tuple(found)

    def in_surface(self, xy: FloatArray) -> FloatArray:
        """Places (n, 2) of the reference in the CRS of the surface."""
        mine, theirs = self.height_file.horizontal, self.reference.horizontal
        return xy if mine is None or theirs is None else converted(theirs, mine, xy)

    def z_of(self, reference: HeightRaster, xy: FloatArray) -> FloatArray:
        """Heights (n,) m of a window of the reference at places of its CRS, in the surface's vertical datum."""
        z, crs = reference.nearest(xy), self.reference.horizontal
        known = np.isfinite(z)
        if crs is not None and known.any():
            z[known] += self.reference_vertical_datum.undulation(
                xy[known], crs
            ) - self.surface_vertical_datum.undulation(xy[known], crs)
        return z


def sample_of_raster(heights: RasterHeights, max_shift_m: float, quality: Path | None = None) -> FitSample:
    """The surface around cells of a raster, in windows that are spread over what both have in common.

    max_shift_m, quality : see `sample_of_points`. Where the cells of the reference are at least twice as large, each is
    compared with the mean of the surface in it, see `points_on`.

    Raises
    ------
    InputError
        The two do not overlap, or no cell has a height.
    """
    height_file, reference = heights.height_file, heights.reference
    ratio = _cell_ratio(heights)
    size = int(np.clip(BLOCK * 1.5 / ratio, 2, BLOCK))
    rows, cols = (-(-n // size) for n in reference.shape)
    corner = np.array([(r, c) for r in range(rows) for c in range(cols)])
    middle = heights.in_surface(places(reference.transform, *((corner + 0.5) * size).T))
    reach = size * ratio * height_file.cell
    xmin, ymin, xmax, ymax = height_file.bounds
    near = ((middle > (xmin - reach, ymin - reach)) & (middle < (xmax + reach, ymax + reach))).all(axis=1)
    rim = math.ceil(max_shift_m / height_file.cell) + SLOPE_REACH_CELLS
    n_windows = max(1, int(MAX_CELLS // (size * ratio + 2 * rim) ** 2))
    chosen = _spread([(int(r), int(c)) for r, c in corner[near]], n_windows)
    per_window = max(16, int(MAX_POINTS / max(len(chosen), 1)))
    found = [_part_of_raster(heights, place, size, rim, per_window, quality) for place in chosen]
    parts = tuple(part for part in found if part is not None)
    if not parts:
        raise InputError(
            f"{height_file.path} and {reference.path} have no height in common. Check the CRS of both, and that they "
            "show the same ground."
        )
    n = sum(part.n_available for part in parts) * int(np.count_nonzero(near)) // len(chosen)
    return FitSample(parts, height_file.cell, n, heights.datums, heights.assumed, heights.geoid_added_to, {})


def _cell_ratio(heights: RasterHeights) -> float:
    """Side of a cell of the reference in cells of the surface."""
    t, (rows, cols) = heights.reference.transform, heights.reference.shape
    ends = places(t, np.array([rows / 2, rows / 2 + 1, rows / 2]), np.array([cols / 2, cols / 2, cols / 2 + 1]))
    here = heights.in_surface(ends)
    area = abs(np.linalg.det(here[1:] - here[0]))
    if not np.isfinite(area):
        raise InputError(f"{heights.reference.path} lies outside of the CRS of {heights.height_file.path}. Check both.")
    return max(float(math.sqrt(area) / heights.height_file.cell), 1e-3)


def _part_of_raster(
    heights: RasterHeights, place: tuple[int, int], size: int, rim: int, n: int, quality: Path | None
) -> FitPart | None:
    """The cells of a window of the reference, and the surface around them; None where they have nothing in common."""
    window = heights.reference.window(place[0] * size, place[1] * size, size, size)
    row, col = np.nonzero(np.isfinite(window.z))
    if not len(row):
        return None
    xy = places(window.transform, row.astype(np.float64) + 0.5, col.astype(np.float64) + 0.5)
    cell = heights.height_file.row_col(heights.in_surface(xy))
    inside = ((cell >= 0) & (cell < heights.height_file.shape)).all(axis=1)
    if not inside.any():
        return None
    xy, cell = xy[inside], cell[inside]
    low, high = np.floor(cell.min(axis=0)).astype(int), np.ceil(cell.max(axis=0)).astype(int)
    margin = rim + math.ceil(_cell_ratio(heights))
    extent = high - low + 2 * margin
    surface = _window(heights.height_file, (*(low - margin), *extent), quality)
    frame = heights.height_file.horizontal
    like = points_on(surface, window, frame, xy[:1])
    most = n if like.areas is None else max(16, min(n, MAX_PLACES // len(like.areas.places) * n // MAX_POINTS))
    n_available = len(xy)
    if n_available > most:
        xy = xy[np.sort(np.random.default_rng(SEED + place[0] * 7919 + place[1]).permutation(len(xy))[:most])]
    z = heights.z_of(window, xy)
    return FitPart(surface, points_on(surface, window, frame, xy), z, np.full(len(z), np.nan), n_available)
