"""Single stages of the method on plain arrays: vertical line loci, matching cost, true ortho-image, semi-global
constraint.

For readers who want to look at one stage, or to use a cost of their own. `zlocus.match` does not use this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.argument_checks import (
    bounds_or_none,
    count_or_none,
    instance_of,
    numeric_array,
    positions,
    positive_number,
    whole_number,
)
from zlocus.core.errors import ConfigError
from zlocus.core.options import PyramidOptions, SemiGlobalOptions
from zlocus.core.scene import ImageSource, Scene
from zlocus.matching import true_ortho as ortho
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.match_scene import height_step, reference_first
from zlocus.matching.occlusion import PAIR, covered_heights
from zlocus.matching.radiometry import GreyScale
from zlocus.matching.semiglobal import USUAL_STEP_CELLS, SemiGlobalHeights, aggregate, jump_penalties
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileGrid, tile_views
from zlocus.matching.view_pixels import read_pixels, window_showing

# Cost of 1 - NCC = 1 in the integer units of the kernels, and the largest cost that these hold.
COST_UNIT, MAX_COST = 64.0, 255.0
# Interpolation weights of valid pixels may differ from 1 by this much, by rounding.
ALL_VALID = 1e-3
# A window whose variance is below this share of the variance of the whole image has no texture: it is rounding.
MIN_TEXTURE = 1e-9
# Distances between cells may differ by this share of a cell, by rounding.
EVEN = 1e-3
SCENE_ADVICE = "Give zlocus.open_scene(*paths)."


@dataclass(frozen=True)
class LocusStack:
    """Grey values of every image along the vertical lines of some cells.

    grey : (i, h, r, c) float32, grey value that image i shows of cell (r, c) at height h; NaN where it does not show
    it. heights : (h,) m. x, y : (c,), (r,) m, of the cells' centres. names : of the images.
    """

    grey: NDArray[np.float32]
    heights: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    names: tuple[str, ...]

    def __repr__(self) -> str:
        """One line, without the arrays."""
        return (
            f"LocusStack(grey {self.grey.shape} of images, heights, rows, columns; {self.heights.min():g} to "
            f"{self.heights.max():g} m; {', '.join(self.names)})"
        )


def locus_stack(
    scene: Scene, bounds: tuple[float, float, float, float], resolution: float, heights: Sequence[float]
) -> LocusStack:
    """Resample the images of a scene (cubic) along the vertical lines of the cells of an area: the vertical line loci.

    For looking at loci and for costs of one's own; the matcher itself never holds so much at once: 4 i h r c bytes.
    scene : of i views, with corrected cameras (`orient`). bounds : (xmin, ymin, xmax, ymax) m in the scene's frame;
    resolution : side of a cell, m; heights : (h,) m above the ellipsoid. Source: Ji et al. (2014), section 2 (MVLL).

    Raises
    ------
    ConfigError
        There are no cells or no heights, or an argument is of another kind.
    """
    scene = instance_of("scene", scene, Scene, SCENE_ADVICE)
    checked_bounds = bounds_or_none(bounds)
    if checked_bounds is None:
        raise ConfigError("bounds is None. Give 4 numbers: (xmin, ymin, xmax, ymax).")
    bounds, resolution = checked_bounds, positive_number("resolution", resolution, "m")
    heights = positions("heights", heights, "heights").tolist()
    across, down = (round((bounds[k + 2] - bounds[k]) / resolution) for k in (0, 1))
    if min(across, down, len(heights)) < 1:
        raise ConfigError(f"{down} x {across} cells at {len(heights)} heights hold nothing. Give more of each.")
    x = np.asarray(bounds[0] + (np.arange(across) + 0.5) * resolution, np.float64)
    y = np.asarray(bounds[3] - (np.arange(down) + 0.5) * resolution, np.float64)
    column, row = np.meshgrid(x, y)
    grey = np.full((len(scene.views), len(heights), down, across), np.nan, np.float32)
    for i, view in enumerate(scene.views):
        for h, z in enumerate(heights):
            xyz = np.column_stack([column.ravel(), row.ravel(), np.full(row.size, float(z))])
            grey[i, h] = _sampled(view.image, view.sensor.image_from_ground(xyz).reshape(down, across, 2))
    return LocusStack(grey, np.asarray(heights, float), x, y, tuple(view.name for view in scene.views))


def _sampled(image: ImageSource, xy: NDArray[np.float64]) -> NDArray[np.float32]:
    """Values (r, c) of an image at (r, c, 2) px by cubic interpolation; NaN outside and near invalid pixels."""
    import cv2

    out = np.full(xy.shape[:2], np.nan, np.float32)
    rows, cols = image.shape
    inside: NDArray[np.bool_] = np.all((xy >= 0) & (xy <= (cols - 1, rows - 1)), axis=-1)
    if not inside.any():
        return out
    # Read only the part that is needed, with the margin of cubic interpolation.
    low = np.maximum(np.floor(xy[inside].min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(xy[inside].max(axis=0)).astype(int) + 3, (cols, rows))
    part = image.read(int(low[1]), int(low[0]), int(high[1] - low[1]), int(high[0] - low[0]))
    at = np.where(inside[..., None], xy - low, 0.0).astype(np.float32)
    grey = cv2.remap(part.pixels, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    known = cv2.remap(part.valid.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    shown = inside & (known > 1 - ALL_VALID)
    out[shown] = grey[shown]
    return out


def ncc_cost(grey: NDArray[np.floating], *, window: int = 5, reference: int | None = None) -> NDArray[np.float32]:
    """Matching cost of every cell at every height: 1 - NCC, averaged over pairs of images.

    grey : (i, h, r, c) of any unit, as of `locus_stack`, NaN where an image does not show a place; NCC ignores gain and
    offset. window : side of the square correlation window, cells, odd. reference : number of the image that the others
    are compared with, whose mean is the SNCC of Ji et al. (2014), section 2.1; None: all pairs are. Returns (r, c, h)
    float32, in the units of `semiglobal`; NaN where fewer than two images show the whole window. A window without
    texture costs 1 against every other.

    The matcher's own cost adds grey differences, and leaves out occluded images: `zlocus.matching.cost_volume`.

    Raises
    ------
    ConfigError
        The array or the window does not fit.
    """
    grey = numeric_array("grey", grey, "images, heights, rows, columns")
    if len(grey) < 2 or min(grey.shape) < 1:
        raise ConfigError(f"The images are {grey.shape}. Give (images, heights, rows, columns) of two images or more.")
    window, reference = whole_number("window", window), count_or_none("reference", reference)
    if window < 3 or window % 2 == 0 or (reference is not None and not 0 <= reference < len(grey)):
        raise ConfigError(
            f"A window of {window} and reference {reference} do not fit {len(grey)} images. Give an odd window of 3 or "
            f"more, and a reference of 0 to {len(grey) - 1}."
        )
    pairs = [pair for pair in combinations(range(len(grey)), 2) if reference is None or reference in pair]
    costs = [_cost_of_pairs(np.asarray(grey[:, h], np.float64), window, pairs) for h in range(grey.shape[1])]
    return np.stack(costs, axis=-1)


def _cost_of_pairs(images: NDArray[np.float64], window: int, pairs: Sequence[tuple[int, int]]) -> NDArray[np.float32]:
    """Mean of 1 - NCC (r, c) over pairs of images (i, r, c) at a height, NaN where no pair shows the window."""
    from scipy.ndimage import uniform_filter

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(uniform_filter(values, (0, window, window) if values.ndim == 3 else window, mode="constant"))

    known = np.isfinite(images)
    # Outside the array nothing is known.
    shown = mean(known.astype(np.float64)) > 1 - ALL_VALID / window**2
    # Relative to the mean, because squares of large values would cancel.
    grey = np.where(known, images - np.mean(images, where=known), 0.0) if known.any() else np.zeros_like(images)
    middle = mean(grey)
    variance = np.maximum(mean(grey**2) - middle**2, 0.0)
    least = max(MIN_TEXTURE * float(np.mean(grey**2)), np.finfo(float).tiny)
    total, count = np.zeros(images.shape[1:]), np.zeros(images.shape[1:])
    for a, b in pairs:
        both = shown[a] & shown[b]
        has_texture = np.minimum(variance[a], variance[b]) > least
        scale = np.sqrt(np.where(has_texture, variance[a] * variance[b], 1.0))
        ncc = np.where(has_texture, (mean(grey[a] * grey[b]) - middle[a] * middle[b]) / scale, 0.0)
        total += np.where(both, 1.0 - np.clip(ncc, -1.0, 1.0), 0.0)
        count += both
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def true_ortho(
    scene: Scene, height: NDArray[np.floating], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float32]:
    """True ortho-image of a surface: grey values (r, c) float32, NaN where there is no height and where no image sees
    it.

    Each cell takes its grey value from the image that shows it with most pixels, among the images in which the surface
    does not occlude it. Objects outside the area occlude nothing. Every image keeps its own grey values; a run levels
    them.

    scene : oriented; height : (r, c) m above the ellipsoid, NaN where there is none; x, y : (c,), (r,) m, of the
    cells' centres, evenly spaced, y from north to south.

    Raises
    ------
    ConfigError
        The arrays do not fit, or are no arrays of numbers.
    GeometryError
        All images look along the same line, or their projections bend too much for the cells.
    """
    scene = instance_of("scene", scene, Scene, SCENE_ADVICE)
    height = np.asarray(numeric_array("height", height, "rows, columns"), np.float64)
    x, y = positions("x", x, "columns"), positions("y", y, "rows")
    shape = (len(y), len(x))
    if height.shape != shape or min(shape) < 2 or not np.isfinite(height).any():
        raise ConfigError(
            f"Heights of {height.shape} cells, with {len(x)} x and {len(y)} y, show nothing. Give (rows, columns) of "
            "two or more each, and some heights."
        )
    _check_even(x, y)
    height = np.where(np.isfinite(height), height, np.nan)
    cell_m, lowest, highest = float(x[1] - x[0]), float(np.nanmin(height)), float(np.nanmax(height))
    views = reference_first(scene, (lowest + highest) / 2, None)
    options = PyramidOptions()
    step_m = height_step(views, (lowest + highest) / 2, cell_m, options.max_shift_px)
    origin_m, n_steps = lowest - step_m, int(np.ceil((highest - lowest) / step_m)) + 3
    z_range = (origin_m, origin_m + n_steps * step_m)
    transform = Affine(cell_m, 0, x[0] - cell_m / 2, 0, -cell_m, y[0] + cell_m / 2)
    across, down = np.linspace(0, shape[1], 5), np.linspace(0, shape[0], 5)
    corners = np.array([transform * (c, r) for c in across for r in down])
    parts = [(view, window_showing(view, corners, z_range)) for view in views]
    pixels = [read_pixels(view, part, GreyScale(0.0, 1.0)) for view, part in parts if part is not None]
    if not pixels:
        return np.full(shape, np.nan, np.float32)
    projected = tile_views(pixels, TileGrid(0, transform, shape, options.block, origin_m, step_m), z_range, 0)
    blocks = (-(-shape[0] // projected.block), -(-shape[1] // projected.block))
    lattice = HeightLattice(
        origin_m, step_m, shape, projected.block, np.zeros(blocks, np.int64), np.full(blocks, n_steps, np.int64)
    )
    index = ((np.where(np.isfinite(height), height, lowest) - origin_m) / step_m).astype(np.float32)
    visible = covered_heights(projected, SlopeSurface.flat(shape, projected.block), lattice)
    shown = ortho.true_ortho(projected, visible, index)
    shown[~np.isfinite(height)] = np.nan
    return shown


def _check_even(x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """Refuse centres of cells that are no square grid with columns to the east and rows to the south."""
    cell_m = float(x[1] - x[0])
    steps = np.concatenate([np.diff(x), -np.diff(y)])
    if cell_m <= 0 or np.abs(steps - cell_m).max() > EVEN * cell_m:
        raise ConfigError(
            f"x and y are no centres of square cells from west to east and from north to south: their steps range from "
            f"{steps.min():g} to {steps.max():g} m. Give evenly spaced ones, x rising and y falling."
        )


def semiglobal(
    cost: NDArray[np.floating],
    *,
    ortho: NDArray[np.float32] | None = None,
    options: SemiGlobalOptions | None = None,
    step_cells: float = USUAL_STEP_CELLS,
    n_images: int = PAIR,
) -> SemiGlobalHeights:
    """Heights by the semi-global constraint on a matching cost of one's own.

    cost : (r, c, h) in units of 1 - NCC: 0 where all images agree, NaN where it is unknown and taken as 1. The
    penalties are made for these units. Evenly spaced heights. ortho : (r, c) grey values of any unit, at whose edges
    heights may jump, NaN where there is none. step_cells : a height step over the side of a cell. n_images : that the
    cost compares; the more they are, the smaller is P1. Heights come back as indices into h (r, c); `vertex` is the one
    between steps, so that the height is `heights[0] + step * vertex`.

    Raises
    ------
    ConfigError
        The arrays do not fit, or are no arrays of numbers.
    """
    cost = numeric_array("cost", cost, "rows, columns, heights")
    if min(cost.shape) < 1:
        raise ConfigError(f"The cost has the shape {cost.shape}. Give one of (rows, columns, heights).")
    shape = cost.shape[:2]
    if ortho is not None:
        ortho = np.asarray(numeric_array("ortho", ortho, "rows, columns"), np.float32)
        if ortho.shape != shape:
            raise ConfigError(f"The ortho-image has {ortho.shape} cells, the cost {shape}. Give both on one grid.")
    advice = "Give zlocus.SemiGlobalOptions(...)."
    options = SemiGlobalOptions() if options is None else instance_of("options", options, SemiGlobalOptions, advice)
    step_cells, n_images = positive_number("step_cells", step_cells, "cells"), whole_number("n_images", n_images)
    if n_images < PAIR:
        raise ConfigError(f"n_images is {n_images}, and a cost compares {PAIR} or more. Give their number.")
    counted = np.rint(np.where(np.isfinite(cost), cost, 1.0) * COST_UNIT).clip(0, MAX_COST).astype(np.uint8)
    lattice = HeightLattice(
        0.0, 1.0, shape, max(shape), np.zeros((1, 1), np.int64), np.full((1, 1), cost.shape[2], np.int64)
    )
    p2 = jump_penalties(ortho, shape, 0, options)
    return aggregate(np.ascontiguousarray(counted).ravel(), lattice, p2, step_cells, options, n_images)
