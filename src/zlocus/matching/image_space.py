"""Image space (GC3): the cells are the pixels of a reference image, and heights or depths are asked for along its rays.

The matcher needs no change: each view is given a sensor model whose ground is the reference image (`sensors/rays.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.footprints import ground_sample_distance
from zlocus.core.grid import cells_of_bounds
from zlocus.core.options import OrientationOptions, PyramidOptions, RunConfig
from zlocus.core.scene import ImageSource, ImageWindow, Scene, View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_scene import MatchScene, levels_for
from zlocus.matching.radiometry import grey_scales
from zlocus.matching.tile_views import COARSER_TABLE_PX, FINEST_TABLE_PX
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.image_rays import DepthRays, HeightRays, PixelModel, Rays
from zlocus.sensors.projection_table import TableRequest, projection_table

SAMPLES = 7
ANCHOR = (-0.5, 0.5)
# Copies of the outermost pixels around every image, so that windows at its border can be compared: half a window, the
# pixels that the interpolation needs beside it, and a pixel of slack.
BORDER_PX = 6
FEWEST_TIES = 20
TIE_PERCENT = (0.5, 99.5)
DISPARITY_MARGIN_PX = 8.0
# What is farther is as good as infinitely far.
LEAST_DISPARITY_PX = 0.5
BY_DEPTH: dict[str, dict[str, Any]] = {
    "cost": {"large_window": 3, "occluded_pairs_excluded": 1.0, "occlusion_margin_steps": 24.0, "grey_weight_two_images": 1.0},
    "semiglobal": {
        "predecessors": 1,
        "p1": 20,
        "p1_two_images": 20,
        "p2": 240,
        "p2_edge": 100,
        "edge_contrast": 2.0,
        "edge_contrast_two_images": 2.0,
    },
}
SMALLEST_BLOCK = 8
DISPARITY_SAMPLES = 64
END_STEPS = 6


@dataclass(frozen=True)
class BorderedImage:
    """An image with copies of its outermost pixels around it, as an `ImageSource`."""

    image: ImageSource
    border: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.image.shape
        return rows + 2 * self.border, cols + 2 * self.border

    @property
    def dtype(self) -> str:
        """See `ImageSource`."""
        return self.image.dtype

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """See `ImageSource`."""
        of_image = self.image.shape
        r, c = (
            np.clip(np.arange(first, first + n) - self.border, 0, last - 1)
            for first, n, last in zip((row, col), (rows, cols), of_image, strict=True)
        )
        window = self.image.read(int(r[0]), int(c[0]), int(r[-1] - r[0]) + 1, int(c[-1] - c[0]) + 1)
        at = np.ix_(r - r[0], c - c[0])
        return ImageWindow(np.ascontiguousarray(window.pixels[at]), np.ascontiguousarray(window.valid[at]))


@dataclass(frozen=True)
class ImageSpace:
    """A reference image, its rays, and the scene in its frame: a view each, the reference first."""

    reference: View
    rays: Rays
    views: tuple[View, ...]

    def ground(self, row: int, z: NDArray[np.float32], col: int = 0) -> FloatArray:
        """Ground points of a block of pixels, of which (row, col) is the first. z : (r, c) hypotheses -> (r, c, 3) m,
        NaN where there is none."""
        known = np.isfinite(z)
        out = np.full((*z.shape, 3), np.nan)
        rows, cols = np.nonzero(known)
        out[known] = self.rays.ground(np.column_stack([cols + col, rows + row]).astype(float), z[known].astype(float))
        return out

    def frame_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Ground points (n, 3) m -> column, minus row, hypothesis (n, 3)."""
        xy = self.reference.sensor.image_from_ground(xyz)
        return np.column_stack([xy * [1.0, -1.0], self.rays.hypothesis(xyz)])


def is_by_depth(scene: Scene) -> bool:
    """Whether depths are asked for, not heights: where all views are frame cameras, which may look anywhere."""
    return all(isinstance(view.sensor, FrameModel) for view in scene.views)


def image_space(scene: Scene, reference: str, z_range: tuple[float, float]) -> ImageSpace:
    """The scene in the frame of one of its images. z_range : m, heights the ground lies between; unused by depth.

    Raises
    ------
    ConfigError
        `reference` is not the name of a view.
    GeometryError
        All frame cameras stand in one place, or the reference does not see the ground between those heights.
    """
    by_name = {view.name: view for view in scene.views}
    if reference not in by_name:
        raise ConfigError(f"--reference {reference} is not a view of this scene. Choose one of {', '.join(by_name)}.")
    first = by_name[reference]
    others = [view for view in scene.views if view.name != reference]
    rays = depth_rays(first, others) if is_by_depth(scene) else height_rays(first, z_range)
    moved = [replace(view, sensor=rays.to(view.sensor)) for view in others]
    return ImageSpace(first, rays, (replace(first, sensor=PixelModel()), *moved))


def height_rays(view: View, z_range: tuple[float, float]) -> HeightRays:
    """Rays of an image by height."""
    middle = (z_range[0] + z_range[1]) / 2
    unit = ground_sample_distance(view, middle)
    if not np.isfinite(unit):
        raise GeometryError(
            f"{view.name} ({view.path}) does not see the ground at {middle:.0f} m. Check its camera, or give --heights."
        )
    return HeightRays(view.sensor, middle, unit)


def depth_rays(view: View, others: list[View]) -> DepthRays:
    """Rays of a frame camera by disparity, in pixels of the longest base."""
    sensor = view.sensor
    assert isinstance(sensor, FrameModel), "only frame cameras are matched by depth"
    bases = [np.array(other.sensor.centre) - np.array(sensor.centre) for other in others]  # type: ignore[attr-defined]
    longest = max(float(np.linalg.norm(base)) for base in bases)
    if not longest > 0:
        raise GeometryError(
            "All cameras stand in one place, so their images show no depths. Add an image from another place."
        )
    return DepthRays(sensor, sensor.focal * longest)


def build_image_match_scene(
    space: ImageSpace,
    z_range: tuple[float, float],
    ties: FloatArray,
    options: PyramidOptions,
    ground: FloatArray | None = None,
) -> MatchScene:
    """Lattice of hypotheses, levels and extent of a reference image.

    z_range : hypotheses, to which a few steps are added at both ends, for a peak there needs its neighbours; ties :
    (n, 3), column, minus row, hypothesis; ground : (k, 3), those where grey values compare, None: all. See
    `MatchScene`.
    """
    rows, cols = space.reference.image.shape
    views = tuple(bordered(view) for view in space.views)
    step = hypothesis_step(space, (z_range[0] + z_range[1]) / 2, options.max_shift_px)
    n_steps = int(np.ceil((z_range[1] - z_range[0]) / step)) + 2 * END_STEPS
    levels = levels_for(n_steps, options)
    return MatchScene(
        views=views,
        anchor=ANCHOR,
        cell_m=1.0,
        origin_m=z_range[0] - END_STEPS * step,
        step_m=step,
        n_steps=n_steps,
        levels=levels,
        overlap_window=cells_of_bounds((-0.5, 0.5 - rows, cols - 0.5, 0.5), ANCHOR, 1.0, levels),
        grey_scales=grey_scales(views, ties if ground is None else ground),
        ties=ties,
    )


def beyond_range(match_scene: MatchScene, height: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where hypotheses lie in the steps added by `build_image_match_scene`. height : (r, c)."""
    low = match_scene.origin_m + (END_STEPS - 0.5) * match_scene.step_m
    high = match_scene.origin_m + (match_scene.n_steps - END_STEPS + 0.5) * match_scene.step_m
    return np.asarray((height < low) | (height > high))


def bordered(view: View) -> View:
    """The view with copies of its outermost pixels around it."""
    sensor = ShiftedModel(view.sensor, float(BORDER_PX), float(BORDER_PX))
    return replace(view, image=BorderedImage(view.image, BORDER_PX), sensor=sensor)


def depth_options(config: RunConfig) -> RunConfig:
    """The options with those for depths where they have their defaults, which are chosen for ground seen from above.

    Close things have deep jumps and sharp texture: a narrow correlation window, for every jump is an outline of this
    very image, and a higher least penalty of jumps. Pairs with a hidden view are left out whole, for the reference is
    never hidden; and a view counts as hidden only far below what hides it, for the coarser surface blurs outlines by
    some steps, and matching back finds what is hidden exactly.
    """
    return _with_defaults(config, BY_DEPTH)


def _with_defaults(config: RunConfig, defaults: dict[str, dict[str, Any]]) -> RunConfig:
    """The options with other values, by stage, where they have their defaults."""
    changed = {}
    for stage, values in defaults.items():
        mine, default = getattr(config, stage), getattr(RunConfig(), stage)
        chosen = {name: value for name, value in values.items() if getattr(mine, name) == getattr(default, name)}
        changed[stage] = replace(mine, **chosen)
    return replace(config, **changed)


def hypotheses_of_heights(space: ImageSpace, z_range: tuple[float, float]) -> tuple[float, float] | None:
    """Lowest and highest hypothesis of the rays between two heights (m); None where a ray does not meet one of them."""
    rays, (rows, cols) = space.rays, space.reference.image.shape
    if isinstance(rays, HeightRays):
        return (z_range[0] - rays.datum) / rays.unit, (z_range[1] - rays.datum) / rays.unit
    col, row = np.meshgrid(np.linspace(0, cols - 1, SAMPLES), np.linspace(0, rows - 1, SAMPLES))
    xy = np.column_stack([col.ravel(), row.ravel()])
    ground = [space.reference.sensor.ground_from_image(xy, np.full(len(xy), z)) for z in z_range]
    found = rays.hypothesis(np.concatenate(ground))
    return (float(found.min()), float(found.max())) if np.isfinite(found).all() else None


def widest_disparities(space: ImageSpace) -> tuple[float, float]:
    """From infinitely far to the nearest that another view can see too, half the longest base away at most."""
    rays = space.rays
    assert isinstance(rays, DepthRays), "heights have bounds of their own"
    nearest = 2.0 * rays.sensor.focal
    for z in np.linspace(nearest, nearest / DISPARITY_SAMPLES, DISPARITY_SAMPLES):
        if any(np.isfinite(shift_rates(space, view, float(z))).any() for view in space.views[1:]):
            return 0.0, float(z)
    return 0.0, nearest


def hypotheses_of_ties(space: ImageSpace, ties: FloatArray, options: OrientationOptions) -> tuple[float, float]:
    """Range to be searched, from ties (n, 3), column, minus row, disparity: their percentiles, widened on both sides by
    `range_margin` times their span and by `DISPARITY_MARGIN_PX`, but not below `LEAST_DISPARITY_PX`.

    Raises
    ------
    GeometryError
        Where there are too few.
    """
    if len(ties) < FEWEST_TIES:
        raise GeometryError(
            f"Only {len(ties)} reliable tie points were found in {space.reference.name}, too few to tell its depths "
            f"({FEWEST_TIES} are needed). Give --heights ZMIN ZMAX, or check the cameras."
        )
    low, high = (float(v) for v in np.percentile(ties[:, 2], TIE_PERCENT))
    margin = options.range_margin * (high - low) + DISPARITY_MARGIN_PX
    return max(low - margin, LEAST_DISPARITY_PX), high + margin


def fitting_block(match_scenes: Sequence[MatchScene], block: int) -> int | None:
    """The largest block, halved as often as needed, over which projections are straight enough for their tables; None
    where even `SMALLEST_BLOCK` is too large.

    Images that are turned against each other bend the loci more within a block of pixels than a map grid does.
    """
    while not all(_fits(match_scene, block) for match_scene in match_scenes):
        block //= 2
        if block < SMALLEST_BLOCK:
            return None
    return block


def _fits(match_scene: MatchScene, block: int) -> bool:
    step = match_scene.step_m * 2 ** (match_scene.levels - 1)
    z_range = (match_scene.origin_m - 2 * step, match_scene.z_range[1] + 18 * step)
    try:
        for level in range(match_scene.levels):
            window = match_scene.overlap_window.at_level(level, 0)
            tolerance_px = 2**level * (COARSER_TABLE_PX if level else FINEST_TABLE_PX)
            request = TableRequest(
                match_scene.transform(window, level), (window.rows, window.cols), block, z_range, tolerance_px
            )
            for view in match_scene.views:
                projection_table(view.sensor, request, (0, 0, *view.image.shape))
    except GeometryError:
        return False
    return True


def hypothesis_step(space: ImageSpace, z: float, max_shift_px: float) -> float:
    """Step of the hypotheses that shifts the most sensitive image by `max_shift_px` at most, or by that share of the
    reference's pixel where the image's own is finer (equivalent disparity, as in `height_step`).

    Raises
    ------
    GeometryError
        When no image is shifted, or none sees what the reference sees.
    """
    rates = [float(np.nanmedian(r)) for view in space.views[1:] if np.isfinite(r := shift_rates(space, view, z)).any()]
    if not max(rates, default=0.0) > 1e-4:
        raise GeometryError(
            f"No other image shows the heights of what {space.reference.name} ({space.reference.path}) sees: they do "
            "not overlap, or look along the same line. Check the cameras, or add an image from another direction."
        )
    return max_shift_px / max(rates)


def shift_rates(space: ImageSpace, view: View, z: float) -> FloatArray:
    """Equivalent disparity, px, of a view per unit of the hypothesis at pixels spread over the reference, (n,); NaN
    where the view does not see them."""
    rows, cols = space.reference.image.shape
    col, row = np.meshgrid(np.linspace(0, cols - 1, SAMPLES), np.linspace(0, rows - 1, SAMPLES))
    here = np.column_stack([col.ravel(), -row.ravel(), np.full(col.size, z)])
    at = [view.sensor.image_from_ground(here + 0.5 * step) for step in (np.zeros(3), *np.eye(3), *-np.eye(3))]
    by_col, by_row, by_z = (at[k] - at[k + 3] for k in (1, 2, 3))
    pixel = np.sqrt(np.abs(by_col[:, 0] * by_row[:, 1] - by_col[:, 1] * by_row[:, 0]))
    rate = np.hypot(*by_z.T) / np.maximum(pixel, 1.0)
    height, width = view.image.shape
    inside = ((at[0] > -0.5) & (at[0] < [width - 0.5, height - 0.5])).all(axis=1)
    return np.where(inside, rate, np.nan)


ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class MatchedImage:
    """What was found for the pixels of an image.

    height : (r, c) float32 hypotheses, NaN where empty; middle : of the hypotheses that were searched.
    """

    space: ImageSpace
    height: NDArray[np.float32]
    middle: float

    def px_per_unit(self, other: str) -> float:
        """Equivalent disparity against another view of a unit of the hypothesis; NaN where they share no ground."""
        (view,) = (view for view in self.space.views if view.name == other)
        rates = shift_rates(self.space, view, self.middle)
        return float(np.median(rates[np.isfinite(rates)])) if np.isfinite(rates).any() else float("nan")


@dataclass(frozen=True)
class Confirmation:
    """How many other images agree with each height, see something farther (through it), or nearer (which hides it):
    each (r, c) uint8."""

    agreeing: NDArray[np.uint8]
    farther: NDArray[np.uint8]
    nearer: NDArray[np.uint8]

    @property
    def is_confirmed(self) -> NDArray[np.bool_]:
        """(r, c): where more images agree than look through it; so at least one does."""
        return np.asarray(self.agreeing > self.farther)


def confirm(
    mine: MatchedImage, others: Sequence[MatchedImage], tolerance_px: float
) -> Iterator[tuple[slice, Confirmation]]:
    """Compare every height of an image with those of the others, where they show the same ground; some rows of the
    image after others.

    A height becomes a ground point, which is at a pixel (the nearest) and at a hypothesis of each other image; that
    image's own hypothesis there agrees when it differs by no more than `tolerance_px` of equivalent disparity of the
    two. Pixels without a height have no say.
    """
    sharing = [(other, rate) for other in others if np.isfinite(rate := other.px_per_unit(mine.space.reference.name))]
    for row in range(0, len(mine.height), ROWS_AT_ONCE):
        rows = slice(row, min(row + ROWS_AT_ONCE, len(mine.height)))
        part = mine.height[rows]
        counts, known = np.zeros((3, *part.shape), np.uint8), np.isfinite(part)
        ground = mine.space.ground(row, part)[known]
        for other, px_per_unit in sharing:
            differs = difference(other, ground) * px_per_unit
            for count, where in zip(
                counts, (np.abs(differs) <= tolerance_px, differs < -tolerance_px, differs > tolerance_px), strict=True
            ):
                count[known] += where
        yield rows, Confirmation(counts[0], counts[1], counts[2])


def difference(image: MatchedImage, ground: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hypotheses by which an image's heights are nearer to it than ground points (n, 3) m; NaN where it has none.
    -> (n,)"""
    at = image.space.frame_from_ground(ground)
    rows, cols = image.height.shape
    with np.errstate(invalid="ignore"):
        col, row = np.rint(at[:, 0]), np.rint(-at[:, 1])
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    own = np.full(len(ground), np.nan)
    own[inside] = image.height[row[inside].astype(int), col[inside].astype(int)]
    return np.asarray(own - at[:, 2])
