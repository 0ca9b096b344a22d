"""Where an image shows the ground of an ortho-image: the image is laid on the heights by its camera, and windows of
both are compared.

What is compared are the directions of grey value edges, whatever their sign and strength (orientation correlation:
Fitch et al. 2002, *Orientation correlation*, BMVC, with the angles doubled), so that the two may be of other dates,
seasons and bands. Both lie on the same ground, so only the error of the camera and of the heights is left between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.footprints import Bounds, ground_box, ground_sample_distance
from zlocus.core.grid import cell_centres
from zlocus.core.options import OrientationOptions
from zlocus.core.parallel import run_all
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.edge_correlation import Peak, correlation, peak_of
from zlocus.sensors.correction import AffinelyShiftedModel, ShiftedModel
from zlocus.sensors.ground_sampling import BandWindow, sampled

# The pointing error is found from so many windows of so many cells, which may lie apart by so many cells.
ROUGH_WINDOWS, ROUGH_CELLS, ROUGH_SEARCH_CELLS = 36, 96, 32
# Windows of the points, and how far apart the two may be in each round. The last rounds measure what is almost zero,
# where no interpolation favours whole cells.
WINDOW_CELLS, SEARCH_CELLS = 64, (10, 5, 4)
# Side of the lattice of windows over the ground that an image shows, and the smallest distance of two, in cells.
LATTICE, MIN_SPACING_CELLS = 16, 40
# A maximum stands out if it exceeds the rest of its surface by so many standard deviations of it.
MIN_ROUGH_PEAK, MIN_PEAK = 8.0, 4.5
# Points that agree: within so many standard deviations, or this part of a cell where they agree better.
AGREEING_SIGMAS, AGREEING_CELLS = 3.0, 0.5
# An image shows the ground of the reference if at least so many points and this share of the windows agree. By chance
# 3 % of the windows would.
MIN_POINTS, MIN_SHARE = 12, 0.2
# From so many points on, the correction may change linearly over the image.
MIN_AFFINE_POINTS = 30
# Cells along each side of the grid on which the heights of the whole reference are looked at.
OVERVIEW_CELLS = 128


class GroundReference(Protocol):
    """An ortho-image and heights of the same ground."""

    @property
    def cell_m(self) -> float:
        """Side of a cell of the ortho-image, m."""
        ...

    @property
    def area(self) -> Bounds:
        """Bounds of the ortho-image in the frame of the scene, m."""
        ...

    def grey(self, geobox: GeoBox) -> NDArray[np.float32]:
        """Grey values (r, c) on a grid in the frame of the scene; NaN where there is none."""
        ...

    def heights(self, geobox: GeoBox) -> NDArray[np.float32]:
        """Ellipsoidal heights (r, c) m on a grid; NaN where there is none."""
        ...


@dataclass(frozen=True, eq=False)
class GroundMatches:
    """Points of the ground that an image shows.

    lattice : (n, 2) numbers of the windows, equal for all images with the same spacing; xyz : (n, 3) m; xy : (n, 2) px;
    residual_px : (n, 2), from a common shift or affine map of the image; offset_px : (2,) how far the image is from
    where its camera places it; n_windows : windows with enough texture that were compared; cell_m : side of their
    cells.
    """

    lattice: NDArray[np.int64]
    xyz: FloatArray
    xy: FloatArray
    residual_px: FloatArray
    offset_px: FloatArray
    n_windows: int
    cell_m: float

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' length."""
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean())) if len(self) else np.nan


@dataclass(frozen=True)
class NoGroundMatch:
    """Why an image could not be compared with the reference, as the end of a sentence that begins with its name.

    is_elsewhere : it shows no ground of the reference at all.
    """

    reason: str
    is_elsewhere: bool = False


@dataclass(frozen=True)
class _Comparison:
    """An image laid on the ground by its camera, and the reference. cell_m : side of the cells of both."""

    view: View
    reference: GroundReference
    crs: CRS
    cell_m: float
    pixels_per_cell: float

    def peaks(
        self, sensor: SensorModel, nodes: FloatArray, n_cells: int, n_search: int, factor: int, threads: int
    ) -> list[tuple[FloatArray, NDArray[np.float64]] | None]:
        """Correlation surface of each window, with its middle (x, y, z); None where it cannot be compared.

        nodes : (n, 2) m, middles of the windows; n_cells, n_search : see `ROUGH_CELLS`; factor : cells of a window are
        so many times as large as those of the comparison.
        """
        cell_m, side = self.cell_m * factor, n_cells + 2 * n_search

        def compare(number: int) -> tuple[FloatArray, NDArray[np.float64]] | None:
            x, y = nodes[number]
            first = Affine(cell_m, 0.0, x - cell_m * side / 2, 0.0, -cell_m, y + cell_m * side / 2)
            geobox = GeoBox((side, side), first, self.crs)
            grey, z = self.reference.grey(geobox), self.reference.heights(geobox)
            # The middle of the window lies between four cells.
            middle = float(z[side // 2 - 1 : side // 2 + 1, side // 2 - 1 : side // 2 + 1].mean())
            if not np.isfinite(middle):
                return None
            seen = self._seen(sensor, geobox, z, self.pixels_per_cell * factor)
            surface = None if seen is None else correlation(grey, seen, n_search)
            return None if surface is None else (np.array([x, y, middle]), surface)

        found: list[tuple[FloatArray, NDArray[np.float64]] | None] = [None] * len(nodes)
        for number, one in run_all(compare, range(len(nodes)), threads):
            found[number] = one
        return found

    def _seen(
        self, sensor: SensorModel, geobox: GeoBox, z: NDArray[np.float32], pixels_per_cell: float
    ) -> NDArray[np.float32] | None:
        """Grey values (r, c) of the image on the ground, NaN where it shows none; None where it shows nothing."""
        xyz = np.dstack([cell_centres(geobox), z]).reshape(-1, 3)
        xy = sensor.image_from_ground(xyz).reshape(*z.shape, 2)
        window = sampled(self._read, self.view.image.shape, xy, pixels_per_cell)
        return None if window is None else np.where(window.valid, window.values[0], np.float32(np.nan))

    def _read(self, row: int, col: int, rows: int, cols: int) -> BandWindow:
        window = self.view.image.read(row, col, rows, cols)
        return BandWindow(window.pixels[np.newaxis], window.valid)


def match_to_ground(
    view: View,
    reference: GroundReference,
    crs: CRS,
    options: OrientationOptions,
    spacing_m: float | None = None,
    threads: int = 1,
) -> GroundMatches | NoGroundMatch:
    """Find the ground points of a reference in an image whose camera may point past them by `max_pointing_px`.

    spacing_m : distance of the windows, equal for images that are to share points; None: by `lattice_spacing`.
    """
    z_range = heights_of(reference, crs)
    if z_range is None:
        return NoGroundMatch("the heights hold no value", True)
    box = ground_box(view, z_range, options.max_pointing_px)
    low, high = np.maximum(box[0], reference.area[:2]), np.minimum(box[1], reference.area[2:])
    if not (np.isfinite(box).all() and (high > low).all()):
        return NoGroundMatch("shows other ground than the reference covers", True)
    pixel_m = ground_sample_distance(view, sum(z_range) / 2)
    cell_m = max(pixel_m, reference.cell_m)
    comparison = _Comparison(view, reference, crs, cell_m, cell_m / pixel_m)
    spacing_m = lattice_spacing(view, z_range, cell_m) if spacing_m is None else spacing_m
    lattice = _lattice(low, high, spacing_m)
    nodes = np.asarray(lattice * spacing_m, float)
    offset = _rough_offset(comparison, low, high, options.max_pointing_px * pixel_m / cell_m, threads)
    if offset is None:
        return NoGroundMatch(
            f"does not look like the reference anywhere within {options.max_pointing_px:g} px of where its camera "
            "points"
        )
    sensor: SensorModel = view.sensor if not offset.any() else _shifted(view.sensor, offset, nodes, z_range)
    return _fine_matches(comparison, sensor, lattice, nodes, threads)


def lattice_spacing(view: View, z_range: tuple[float, float], cell_m: float) -> float:
    """Distance (m) of the windows in which an image is compared."""
    low, high = ground_box(view, z_range)
    return max(float(np.sqrt(np.prod(high - low))) / LATTICE, MIN_SPACING_CELLS * cell_m)


def heights_of(reference: GroundReference, crs: CRS) -> tuple[float, float] | None:
    """Lowest and greatest height (m) of a reference, on a coarse grid."""
    west, south, east, north = reference.area
    cell = max(east - west, north - south) / OVERVIEW_CELLS
    shape = max(int(np.ceil((north - south) / cell)), 1), max(int(np.ceil((east - west) / cell)), 1)
    z = reference.heights(GeoBox(shape, Affine(cell, 0.0, west, 0.0, -cell, north), crs))
    return (float(np.nanmin(z)), float(np.nanmax(z))) if np.isfinite(z).any() else None


def _lattice(low: FloatArray, high: FloatArray, spacing_m: float) -> NDArray[np.int64]:
    """Numbers (n, 2) of the nodes of the lattice between two corners."""
    first, last = np.ceil(low / spacing_m).astype(int), np.floor(high / spacing_m).astype(int)
    i, j = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1), indexing="ij")
    return np.column_stack([i.ravel(), j.ravel()]).astype(np.int64)


def _rough_offset(
    comparison: _Comparison, low: FloatArray, high: FloatArray, search_cells: float, threads: int
) -> FloatArray | None:
    """How far (m, east and north) the image lies from the reference on the ground; None where nothing agrees.

    The correlation surfaces of windows all over the image are added up: each may be wrong, but not all the same way.
    """
    factor = max(int(np.ceil(search_cells / ROUGH_SEARCH_CELLS)), 1)
    n_search = ROUGH_SEARCH_CELLS
    n = int(np.sqrt(ROUGH_WINDOWS))
    share = (np.arange(n) + 0.5) / n
    x, y = np.meshgrid(low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1]))
    nodes = np.column_stack([x.ravel(), y.ravel()])
    found = comparison.peaks(comparison.view.sensor, nodes, ROUGH_CELLS, n_search, factor, threads)
    surfaces = [one[1] for one in found if one is not None]
    if not surfaces:
        return None
    peak = peak_of(np.sum(surfaces, axis=0))
    if peak is None or peak.height < MIN_ROUGH_PEAK:
        return None
    return np.asarray(np.array([peak.col, -peak.row]) * comparison.cell_m * factor)


def _shifted(sensor: SensorModel, offset: FloatArray, nodes: FloatArray, z_range: tuple[float, float]) -> SensorModel:
    """The sensor model that places the ground where the image shows it. offset : (2,) m, see `_rough_offset`."""
    xyz = np.column_stack([nodes, np.full(len(nodes), sum(z_range) / 2)])
    moved = sensor.image_from_ground(xyz + np.append(offset, 0.0)) - sensor.image_from_ground(xyz)
    column, row = np.nanmedian(moved, axis=0)
    return ShiftedModel(sensor, float(column), float(row))


def _fine_matches(
    comparison: _Comparison, sensor: SensorModel, lattice: NDArray[np.int64], nodes: FloatArray, threads: int
) -> GroundMatches | NoGroundMatch:
    """Points of the ground in the image, which a camera places almost right. lattice, nodes : of the windows."""
    for n_search in SEARCH_CELLS:
        found = comparison.peaks(sensor, nodes, WINDOW_CELLS, n_search, 1, threads)
        compared = [number for number, one in enumerate(found) if one is not None]
        good, peaks = _standing_out(found)
        xyz = np.array([found[number][0] for number in good]).reshape(-1, 3)  # type: ignore[index]
        ground = np.array([[peak.col, -peak.row, 0.0] for peak in peaks]).reshape(-1, 3) * comparison.cell_m
        here, xy = sensor.image_from_ground(xyz), sensor.image_from_ground(xyz + ground)
        limit_px = AGREEING_CELLS * comparison.pixels_per_cell
        model, residual, agrees = _common_map(here, xy - here, limit_px)
        n_agreeing = int(agrees.sum())
        if n_agreeing < max(MIN_POINTS, MIN_SHARE * len(compared)):
            return NoGroundMatch(
                f"agrees with the reference in {n_agreeing} of {len(compared)} places only "
                f"({max(MIN_POINTS, int(np.ceil(MIN_SHARE * len(compared))))} are needed)"
            )
        if n_search != SEARCH_CELLS[-1]:
            sensor = AffinelyShiftedModel(sensor, *model)
    delivered = comparison.view.sensor.image_from_ground(xyz[agrees])
    offset_px = np.median(xy[agrees] - delivered, axis=0)
    return GroundMatches(
        lattice[good][agrees], xyz[agrees], xy[agrees], residual[agrees], offset_px, len(compared), comparison.cell_m
    )


def _standing_out(found: Sequence[tuple[FloatArray, NDArray[np.float64]] | None]) -> tuple[list[int], list[Peak]]:
    """Numbers of the windows whose maximum stands out, and the maxima."""
    good, peaks = [], []
    for number, one in enumerate(found):
        peak = None if one is None else peak_of(one[1])
        if peak is not None and peak.height >= MIN_PEAK:
            good.append(number)
            peaks.append(peak)
    return good, peaks


Axis = tuple[float, float, float]


def _common_map(
    xy: FloatArray, moved: FloatArray, limit_px: float
) -> tuple[tuple[Axis, Axis], FloatArray, NDArray[np.bool_]]:
    """The shift or affine map that most points agree with, residuals (n, 2) px, and which points (n,) agree.

    xy : (n, 2) px, where the camera places the points; moved : (n, 2) px, by how much they lie elsewhere.
    """
    nothing: tuple[Axis, Axis] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    if not len(xy):
        return nothing, moved, np.zeros(0, bool)
    middle = _densest(moved, limit_px)
    residual = moved - middle
    agrees = np.hypot(*residual.T) <= 4 * limit_px
    coefficients = np.vstack([middle, np.zeros((2, 2))])
    for _ in range(4):
        if agrees.sum() >= MIN_AFFINE_POINTS:
            terms = np.column_stack([np.ones(len(xy)), xy])
            scale = np.array([1.0, *np.maximum(np.ptp(xy, axis=0), 1.0)])
            solved = np.linalg.lstsq((terms / scale)[agrees], moved[agrees], rcond=None)[0]
            coefficients = solved / scale[:, None]
        elif agrees.any():
            coefficients = np.vstack([moved[agrees].mean(axis=0), np.zeros((2, 2))])
        residual = moved - np.column_stack([np.ones(len(xy)), xy]) @ coefficients
        length = np.hypot(*residual.T)
        sigma = float(np.median(length[agrees])) / 1.1774 if agrees.any() else 0.0
        agrees = length <= max(AGREEING_SIGMAS * sigma, limit_px)
    column, row = ((float(a), float(b), float(c)) for a, b, c in coefficients.T)
    return (column, row), residual, agrees


def _densest(moved: FloatArray, limit_px: float) -> FloatArray:
    """The displacement (2,) with most others within a few limits of it, averaged over these."""
    near = np.hypot(*(moved[:, None] - moved[None]).transpose(2, 0, 1)) <= 2 * limit_px
    best = int(near.sum(axis=1).argmax())
    return np.asarray(moved[near[best]].mean(axis=0))
