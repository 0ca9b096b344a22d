"""Match scene: what all tiles of a scene share, computed before any of them is matched.

The order of the views, the lattice of cells, the lattice of heights, the levels of the pyramid, and the grey scales of
the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.break_lines import BreakLines
from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.footprints import footprint, ground_box, ground_sample_distance, shared_ground
from zlocus.core.grid import CellWindow, cells_of_bounds, window_transform
from zlocus.core.height_range import HeightRange
from zlocus.core.options import PyramidOptions
from zlocus.core.scene import ColourSource, Scene, View, held_window
from zlocus.core.sensor_model import Scanning, bare
from zlocus.matching.ground_pixels import with_common_pixel
from zlocus.matching.radiometry import GreyScale, grey_scales
from zlocus.matching.view_pixels import MARGIN_PX

# The visibility and the penalties of the finest level rest on two coarser ones.
MIN_LEVELS = 3
# The height range has at least this many steps.
MIN_STEPS = 4
# Places along each side of the ground of all views at which two of them are compared.
GROUND_SAMPLES_PER_SIDE = 65
# Points along each side of a window of cells whose projections say which images, and which of their pixels, it needs.
WINDOW_POINTS_PER_SIDE = 5
# Parallax rates are differences over this height above and below a point: at the middle of an image, and elsewhere.
IMAGE_HALF_HEIGHT_M, PLACE_HALF_HEIGHT_M = 5.0, 0.5
# Views whose equivalent disparity grows more slowly than this, px per metre, show no heights.
MIN_PARALLAX_RATE_PX = 1e-4


@dataclass(frozen=True)
class MatchScene:
    """What all tiles of a scene share.

    views : oriented, the reference image (the requested or the most nadir one) first; anchor : easting and northing of
    the north-west corner of cell (0, 0); cell_size : side of a finest cell; height_origin, height_step, n_steps :
    lattice of heights at the finest level; levels : of the pyramid; overlap_window : finest cells that two views may
    cover; grey_scales : grey scale of each image; ties : (n, 3) ground points, to which the search ranges of their
    cells extend; dem_limits : (2, r, c) float32, lowest and highest height to search on the cells of `overlap_window`
    at the coarsest level, NaN where the terrain model has no height; None without one; trusted_ties : (k, 3) those of
    the ties that neighbours confirm; expected_range : lowest and highest height at which they suggest a surface, None
    where they suggest nothing; line_shift_steps : root mean square displacement of the lines of the images that ties
    showed and that was put right, as a height: what they do not show is as large; break_lines : given by an operator,
    None for none.

    Lengths and heights are metres on the ground. In image space (`zlocus.matching.image_space`) the ground is a
    reference image: lengths are its pixels, and heights are hypotheses along its rays. That is why these names have no
    unit.
    """

    views: tuple[View, ...]
    anchor: tuple[float, float]
    cell_size: float
    height_origin: float
    height_step: float
    n_steps: int
    levels: int
    overlap_window: CellWindow
    grey_scales: tuple[GreyScale, ...]
    ties: NDArray[np.float64] = field(repr=False)
    dem_limits: NDArray[np.float32] | None = field(default=None, repr=False)
    trusted_ties: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)), repr=False)
    expected_range: tuple[float, float] | None = None
    line_shift_steps: float = 0.0
    break_lines: BreakLines | None = None

    @property
    def z_range(self) -> tuple[float, float]:
        """Lowest and highest height of the search."""
        return self.height_origin, self.height_origin + self.n_steps * self.height_step

    @property
    def ground_height(self) -> float:
        """A height of the ground: the middle of the heights at which the surface is expected."""
        return sum(self.expected_range or self.z_range) / 2

    @property
    def step_cells(self) -> float:
        """Height of a step over the side of a cell, the same at every level."""
        return self.height_step / self.cell_size

    def views_near(self, xy: NDArray[np.float64]) -> list[int]:
        """Numbers of the views that may see ground in the box around points (n, 2) m."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        near = ((low <= xy.max(axis=0)) & (xy.min(axis=0) <= high)).all(axis=1)
        return [int(number) for number in np.flatnonzero(near)]

    @cached_property
    def _boxes(self) -> NDArray[np.float64]:
        """Box of the ground that each view sees, (i, 2, 2) m, with the margin of its pixel windows."""
        margin_px = float(MARGIN_PX * 2**self.levels)
        return np.array([ground_box(view, self.z_range, margin_px) for view in self.views])

    @property
    def has_colours(self) -> bool:
        """Whether all images have colours, so that the ortho-image can have them too."""
        return len(self.coloured(range(len(self.views)))) > 0

    def coloured(self, view_numbers: Sequence[int]) -> list[ColourSource]:
        """The images of some views; an empty list unless every image of the scene has colours."""
        images = [view.image for view in self.views]
        coloured = [image for image in images if isinstance(image, ColourSource) and image.has_colours]
        return [coloured[number] for number in view_numbers] if len(coloured) == len(images) else []

    def transform(self, window: CellWindow, level: int) -> Affine:
        """From cell corners (column, row) of a window of a level to the ground."""
        return window_transform(window, self.anchor, self.cell_size * 2**level)

    def points_of(self, window: CellWindow, level: int, per_side: int = WINDOW_POINTS_PER_SIDE) -> NDArray[np.float64]:
        """Ground points (n, 2) all over a window of a level, m; per_side : along each of its sides."""
        transform = self.transform(window, level)
        across, down = (np.linspace(0, n, per_side) for n in (window.cols, window.rows))
        return np.array([transform * (c, r) for c in across for r in down])

    def are_in(self, window: CellWindow, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points of the ground (n, 2) m lie in a window of finest cells, (n,) bool."""
        col, row = ~self.transform(window, 0) * xy.T
        return np.asarray((col >= 0) & (col <= window.cols) & (row >= 0) & (row <= window.rows))

    @property
    def overlap_bounds(self) -> tuple[float, float, float, float]:
        """Bounds (xmin, ymin, xmax, ymax), m, of `overlap_window`."""
        transform = self.transform(self.overlap_window, 0)
        west, north = transform * (0, 0)
        east, south = transform * (self.overlap_window.cols, self.overlap_window.rows)
        return west, south, east, north


def parallax_rate(view: View, z: float, xy: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Parallax rate (dE, dN): metres that the ray of a pixel moves on the ground for each metre of height.

    z : height (m) at which the ray is followed; xy : (2,) px, None is the middle of the image.
    """
    top, left, rows, cols = held_window(view.image)
    pixels = np.array([[left + (cols - 1) / 2, top + (rows - 1) / 2] if xy is None else xy] * 2)
    heights = np.array([z - IMAGE_HALF_HEIGHT_M, z + IMAGE_HALF_HEIGHT_M])
    low, high = view.sensor.ground_from_image(pixels, heights)
    return np.asarray((high - low)[:2] / (2 * IMAGE_HALF_HEIGHT_M))


def reference_first(scene: Scene, z: float, reference: str | None) -> tuple[View, ...]:
    """The views in their order for the whole run: the reference image first, the others by growing parallax rate.

    reference : name of the reference image; None: the most nadir view.

    Raises
    ------
    ConfigError
        `reference` is not the name of a view.
    """
    names = [view.name for view in scene.views]
    if reference is not None and reference not in names:
        raise ConfigError(f"--reference {reference} is not a view of this scene. Choose one of {', '.join(names)}.")
    rates = [float(np.hypot(*parallax_rate(view, z))) for view in scene.views]
    order = sorted(range(len(names)), key=lambda i: (names[i] != reference, rates[i], names[i]))
    return tuple(scene.views[i] for i in order)


def height_step(views: tuple[View, ...], z: float, cell_m: float, max_shift_px: float) -> float:
    """Height step (m) that shifts the most sensitive image by `max_shift_px` against the reference image.

    Equivalent disparity (method section 2): |v_i - v_0| dz / g, with the parallax rates v and with g the larger of the
    image's ground pixel and the cell, because nothing finer is compared. Frame cameras have no reference image for the
    whole scene: there each place has its own, the most nadir one. views : the reference image first; z : m, a height of
    the ground.

    Raises
    ------
    GeometryError
        All views look along the same line, so that they show no heights.
    """
    if all(isinstance(bare(view.sensor), Scanning) for view in views):
        rates = _rates_against_first(views, z, cell_m) + _rates_against_nadir(views, z, cell_m)
    elif all(view.sensor.height_bounds() is None for view in views):
        rates = _rates_against_nadir(views, z, cell_m)
    else:
        rates = _rates_against_first(views, z, cell_m)
    # Large cells make the disparities small, and not the angles between the images.
    pixel_m = ground_sample_distance(views[0], z)
    pixel_m = pixel_m if np.isfinite(pixel_m) else cell_m
    base_to_height = max(rates, default=0.0) * max(cell_m, pixel_m)
    if not base_to_height > MIN_PARALLAX_RATE_PX * pixel_m:
        raise GeometryError(
            f"All images look along the same line (base-to-height ratio {base_to_height:.2g}), so they show no "
            "heights. Add an image from another direction."
        )
    return max_shift_px / max(rates)


def _rates_against_first(views: tuple[View, ...], z: float, cell_m: float) -> list[float]:
    """Equivalent disparity per metre, px, of each view against the reference image, at the middles of the images."""
    of_reference = parallax_rate(views[0], z)
    rates = []
    for view in views[1:]:
        pixel = max(ground_sample_distance(view, z), cell_m)
        rates.append(float(np.hypot(*(parallax_rate(view, z) - of_reference))) / pixel)
    return rates


def _rates_against_nadir(views: tuple[View, ...], z: float, cell_m: float) -> list[float]:
    """Equivalent disparity per metre, px, of each view against the most nadir view of each place; median over the
    ground at a height.

    For line scanners that all look straight down in the middle of their strips. The reference image alone would show no
    parallax there, but the ground between two strips is seen from two sides. For frame cameras, too: of all pairs of a
    block those count little that share a sliver of ground, although these would ask for the smallest steps.
    """
    outlines = np.concatenate([outline for outline in (footprint(view, z) for view in views) if len(outline)])
    low, high = outlines.min(axis=0), outlines.max(axis=0)
    x, y = np.meshgrid(*(np.linspace(a, b, GROUND_SAMPLES_PER_SIDE) for a, b in zip(low, high, strict=True)))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    by_height, pixels = map(np.array, zip(*(_parallax_rates(view, xyz) for view in views), strict=True))
    off_nadir = np.where(np.isnan(by_height[..., 0]), np.inf, np.hypot(by_height[..., 0], by_height[..., 1]))
    nadir, place = off_nadir.argmin(axis=0), np.arange(len(xyz))
    difference = np.hypot(*np.moveaxis(by_height - by_height[nadir, place], -1, 0))
    rates = difference / np.maximum(np.maximum(pixels, pixels[nadir, place]), cell_m)
    rates[nadir, place] = np.nan
    return [float(np.nanmedian(rate)) for rate in rates if np.isfinite(rate).any()]


def _parallax_rates(view: View, xyz: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parallax rates (dE, dN) (n, 2) of the rays to ground points (n, 3), and ground pixels there (n,) m; NaN where the
    image does not show a point."""
    xy, z = view.sensor.image_from_ground(xyz), xyz[:, 2]
    rows, cols = view.image.shape
    xy[~((xy >= -0.5) & (xy < (cols - 0.5, rows - 0.5))).all(axis=1)] = np.nan
    steps = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
    right, left, below, above = (view.sensor.ground_from_image(xy + step, z)[:, :2] for step in steps)
    (ax, ay), (bx, by) = (right - left).T, (below - above).T
    low, high = (view.sensor.ground_from_image(xy, z + dz)[:, :2] for dz in (-PLACE_HALF_HEIGHT_M, PLACE_HALF_HEIGHT_M))
    return (high - low) / (2 * PLACE_HALF_HEIGHT_M), np.sqrt(np.abs(ax * by - ay * bx))


def levels_for(n_steps: int, options: PyramidOptions) -> int:
    """Number of pyramid levels: as many as make the whole height range short at the coarsest level, at least
    `MIN_LEVELS`, at most `max_levels`."""
    levels = 1
    while levels < options.max_levels and (
        levels < MIN_LEVELS or n_steps / 2 ** (levels - 1) > options.max_coarsest_steps
    ):
        levels += 1
    return levels


def build_match_scene(
    scene: Scene,
    cell_m: float,
    anchor: tuple[float, float],
    height_range: HeightRange,
    ties: NDArray[np.float64],
    reference: str | None,
    options: PyramidOptions,
    ground: NDArray[np.float64] | None = None,
) -> MatchScene:
    """Build the match scene of views on a ground grid.

    cell_m, anchor : of the lattice of cells, see `MatchScene`; height_range : heights to search; ties : (n, 3) m;
    reference : name of the reference image, None for the most nadir one; ground : (k, 3) m, places at which the grey
    values of the images are compared, None: at the ties. An image that is much finer than all others is reduced, see
    `with_common_pixel`.

    Raises
    ------
    ConfigError
        `reference` is not the name of a view.
    GeometryError
        The views show no heights, or no two of them see the same ground.
    """
    z, z_range = height_range.middle, height_range.searched
    views = with_common_pixel(reference_first(scene, z, reference), z)
    step = height_step(views, z, cell_m, options.max_shift_px)
    n_steps = max(int(np.ceil((z_range[1] - z_range[0]) / step)), MIN_STEPS)
    levels = levels_for(n_steps, options)
    return MatchScene(
        views=views,
        anchor=anchor,
        cell_size=cell_m,
        height_origin=z_range[0],
        height_step=step,
        n_steps=n_steps,
        levels=levels,
        overlap_window=cells_of_bounds(shared_ground(scene, z_range), anchor, cell_m, levels),
        grey_scales=grey_scales(views, ties if ground is None else ground),
        ties=ties,
        expected_range=height_range.expected,
    )
