"""What is settled for the whole scene before any tile: grid, heights, levels, the leading view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.footprints import footprint, ground_box, ground_sample_distance, shared_ground
from zlocus.core.grid import CellWindow
from zlocus.core.options import PyramidOptions
from zlocus.core.scene import ColourSource, Scene, View, held_window
from zlocus.core.sensor_model import Scanning, bare
from zlocus.matching.ground_pixels import with_common_pixel
from zlocus.matching.radiometry import GreyScale, grey_scales
from zlocus.matching.tile_views import MARGIN_PX

ON_GRID = 1e-6
FEWEST_LEVELS = 3
SHARED_SAMPLES, GROUND_SAMPLES = 9, 65
SLANT_M = 0.5


@dataclass(frozen=True)
class MatchScene:
    """All that is settled before tiling, the same for every tile.

    views : oriented, the leading one (most nadir, or asked for) first; anchor : ground position of cell (0, 0)'s
    corner; cell_m : side of a finest cell; origin_m, step_m, n_steps : lattice of heights at the finest level;
    levels : of the pyramid; seen : finest cells that two views may cover; grey : grey scale of each image; ties :
    (n, 3) ground points that widen the ranges of their blocks; prior : (2, r, c) float32 m, lowest and highest
    height to search on the cells of `seen` at the coarsest level (from a DEM), or None.
    """

    views: tuple[View, ...]
    anchor: tuple[float, float]
    cell_m: float
    origin_m: float
    step_m: float
    n_steps: int
    levels: int
    seen: CellWindow
    grey: tuple[GreyScale, ...]
    ties: NDArray[np.float64] = field(repr=False)
    prior: NDArray[np.float32] | None = field(default=None, repr=False)

    @property
    def z_range(self) -> tuple[float, float]:
        """Heights searched, m."""
        return self.origin_m, self.origin_m + self.n_steps * self.step_m

    def views_near(self, xy: NDArray[np.float64]) -> list[int]:
        """Numbers of the views that may see ground in the box around points (n, 2) m."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        near = ((low <= xy.max(axis=0)) & (xy.min(axis=0) <= high)).all(axis=1)
        return [int(number) for number in np.flatnonzero(near)]

    @cached_property
    def _boxes(self) -> NDArray[np.float64]:
        """Box of the ground that each view sees, (i, 2, 2) m, with the margin that its windows have."""
        margin_px = float(MARGIN_PX * 2**self.levels)
        return np.array([ground_box(view, self.z_range, margin_px) for view in self.views])

    @property
    def has_colours(self) -> bool:
        """Whether all images have, and so an ortho-image can."""
        return len(self.coloured(range(len(self.views)))) > 0

    def coloured(self, which: Sequence[int]) -> list[ColourSource]:
        """The images of some views; none where not all of the scene's have colours."""
        images = [view.image for view in self.views]
        found = [image for image in images if isinstance(image, ColourSource) and image.has_colours]
        return [found[number] for number in which] if len(found) == len(images) else []

    def transform(self, window: CellWindow, level: int) -> Affine:
        """Cell corners to ground of a window of a level."""
        side = self.cell_m * 2**level
        return Affine(side, 0.0, self.anchor[0] + window.col * side, 0.0, -side, self.anchor[1] - window.row * side)


def parallax_rate(view: View, z: float, at: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """(dE, dN) that the ground point seen by a pixel, `at` (2,) px or the image's centre, moves per metre of height."""
    top, left, rows, cols = held_window(view.image)
    xy = np.array([[left + (cols - 1) / 2, top + (rows - 1) / 2] if at is None else at] * 2)
    low, high = view.sensor.ground_from_image(xy, np.array([z - 5.0, z + 5.0]))
    return np.asarray((high - low)[:2] / 10.0)


def reference_first(scene: Scene, z: float, reference: str | None) -> tuple[View, ...]:
    """The views, the one asked for or the most nadir first, the others by growing angle.

    Raises
    ------
    ConfigError
        `reference` is not the name of a view.
    """
    names = [view.name for view in scene.views]
    if reference is not None and reference not in names:
        raise ConfigError(f"--reference {reference} is not a view of this scene. Choose one of {', '.join(names)}.")
    slant = [float(np.hypot(*parallax_rate(view, z))) for view in scene.views]
    order = sorted(range(len(names)), key=lambda i: (names[i] != reference, slant[i], names[i]))
    return tuple(scene.views[i] for i in order)




def height_step(views: tuple[View, ...], z: float, cell_m: float, max_shift_px: float) -> float:
    """Step (m) that shifts the most sensitive image by `max_shift_px` against the leading one.

    Equivalent disparity (method section 1): |v_i - v_0| dz / g, with g the larger of the image's ground pixel and the
    cell, since nothing finer is compared. Frame cameras have no leading image for the whole scene: all pairs count.

    Raises
    ------
    GeometryError
        When all views look along the same line, so that heights cannot be seen.
    """
    if all(isinstance(bare(view.sensor), Scanning) for view in views):
        rates = _rates_against_first(views, z, cell_m) + _rates_against_nadir(views, z, cell_m)
    elif all(view.sensor.height_bounds() is None for view in views):
        rates = _rates_where_shared(views, z, cell_m)
    else:
        rates = _rates_against_first(views, z, cell_m)
    if not max(rates, default=0.0) > 1e-4:
        raise GeometryError(
            f"All images look along the same line (base-to-height below {max(rates, default=0.0) * cell_m:.1e}), so "
            "they show no heights. Add an image from another direction."
        )
    return max_shift_px / max(rates)


def _rates_against_first(views: tuple[View, ...], z: float, cell_m: float) -> list[float]:
    """Equivalent disparity per metre, px, of each view against the leading one, as the middles of their images look."""
    lead = parallax_rate(views[0], z)
    rates = []
    for view in views[1:]:
        pixel = max(ground_sample_distance(view, z), cell_m)
        rates.append(float(np.hypot(*(parallax_rate(view, z) - lead))) / pixel)
    return rates


def _rates_against_nadir(views: tuple[View, ...], z: float, cell_m: float) -> list[float]:
    """Equivalent disparity per metre, px, of each view against the most nadir one at a place, median over the ground
    at a height.

    Line scanners are compared as satellites are, but strips that all look straight down on their middle see what lies
    between them from two sides.
    """
    outlines = np.concatenate([outline for outline in (footprint(view, z) for view in views) if len(outline)])
    low, high = outlines.min(axis=0), outlines.max(axis=0)
    x, y = np.meshgrid(*(np.linspace(a, b, GROUND_SAMPLES) for a, b in zip(low, high, strict=True)))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    slants, pixels = map(np.array, zip(*(_slants(view, xyz) for view in views), strict=True))
    tilt = np.where(np.isnan(slants[..., 0]), np.inf, np.hypot(slants[..., 0], slants[..., 1]))
    lead, place = tilt.argmin(axis=0), np.arange(len(xyz))
    apart = np.hypot(*np.moveaxis(slants - slants[lead, place], -1, 0))
    rates = apart / np.maximum(np.maximum(pixels, pixels[lead, place]), cell_m)
    rates[lead, place] = np.nan
    return [float(np.nanmedian(rate)) for rate in rates if np.isfinite(rate).any()]


def _rates_where_shared(views: tuple[View, ...], z: float, cell_m: float) -> list[float]:
    """Equivalent disparity per metre, px, of all pairs of views, median over the ground they share at a height.

    Satellites look the same way all over an image, cameras close by do not: two that look straight down see a place
    between them from two sides.
    """
    outlines = [footprint(view, z) for view in views]
    rates = []
    for i, j in combinations(range(len(views)), 2):
        if min(len(outlines[i]), len(outlines[j])) < 3:
            continue
        low = np.maximum(outlines[i].min(axis=0), outlines[j].min(axis=0))
        high = np.minimum(outlines[i].max(axis=0), outlines[j].max(axis=0))
        x, y = np.meshgrid(*(np.linspace(a, b, SHARED_SAMPLES) for a, b in zip(low, high, strict=True)))
        xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
        (one, pixel), (other, coarser) = (_slants(views[k], xyz) for k in (i, j))
        rate = np.hypot(*(one - other).T) / np.maximum(np.maximum(pixel, coarser), cell_m)
        if (high > low).all() and np.isfinite(rate).any():
            rates.append(float(np.nanmedian(rate)))
    return rates


def _slants(view: View, xyz: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(dE, dN) (n, 2) per metre of height along the rays to ground points (n, 3), and ground pixels there (n,) m; NaN
    outside the image."""
    xy, z = view.sensor.image_from_ground(xyz), xyz[:, 2]
    rows, cols = view.image.shape
    xy[~((xy >= -0.5) & (xy < (cols - 0.5, rows - 0.5))).all(axis=1)] = np.nan
    steps = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
    right, left, below, above = (view.sensor.ground_from_image(xy + step, z)[:, :2] for step in steps)
    (ax, ay), (bx, by) = (right - left).T, (below - above).T
    low, high = (view.sensor.ground_from_image(xy, z + dz)[:, :2] for dz in (-SLANT_M, SLANT_M))
    return (high - low) / (2 * SLANT_M), np.sqrt(np.abs(ax * by - ay * bx))


def levels_for(n_steps: int, options: PyramidOptions) -> int:
    """Levels of the pyramid: until the whole range is short at the coarsest, and never fewer than the visibility and
    the penalties need."""
    levels = 1
    while levels < options.max_levels and (
        levels < FEWEST_LEVELS or n_steps / 2 ** (levels - 1) > options.coarsest_steps
    ):
        levels += 1
    return levels


def seen_window(
    bounds: tuple[float, float, float, float], anchor: tuple[float, float], cell_m: float, levels: int
) -> CellWindow:
    """Finest cells that cover bounds, whole coarsest cells."""
    unit = 2 ** (levels - 1)
    side = cell_m * unit
    col0, col1 = np.floor((bounds[0] - anchor[0]) / side), np.ceil((bounds[2] - anchor[0]) / side)
    row0, row1 = np.floor((anchor[1] - bounds[3]) / side), np.ceil((anchor[1] - bounds[1]) / side)
    return CellWindow(int(row0) * unit, int(col0) * unit, int(row1 - row0) * unit, int(col1 - col0) * unit)


def build_match_scene(
    scene: Scene,
    cell_m: float,
    anchor: tuple[float, float],
    z_range: tuple[float, float],
    ties: NDArray[np.float64],
    reference: str | None,
    options: PyramidOptions,
    ground: NDArray[np.float64] | None = None,
) -> MatchScene:
    """Lattice of heights, levels and extent of a scene.

    z_range : m; ties : (n, 3) m; see `MatchScene`. ground : (k, 3) m, where grey values compare; None: at the ties. An
    image that is much finer than all others is reduced, see `with_common_pixel`.
    """
    z = (z_range[0] + z_range[1]) / 2
    views = with_common_pixel(reference_first(scene, z, reference), z)
    step = height_step(views, z, cell_m, options.max_shift_px)
    n_steps = max(int(np.ceil((z_range[1] - z_range[0]) / step)), 4)
    levels = levels_for(n_steps, options)
    return MatchScene(
        views=views,
        anchor=anchor,
        cell_m=cell_m,
        origin_m=z_range[0],
        step_m=step,
        n_steps=n_steps,
        levels=levels,
        seen=seen_window(shared_ground(scene, z_range), anchor, cell_m, levels),
        grey=grey_scales(views, ties if ground is None else ground),
        ties=ties,
    )
