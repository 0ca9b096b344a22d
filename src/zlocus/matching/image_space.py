"""Image space (GC3): the cells are the pixels of a reference image, and heights or depths are searched along its rays.

The matcher is the same as on the ground: each view gets a sensor model whose ground is the reference image
(`sensors/image_rays.py`). A position along a ray is a hypothesis: a height above a datum, or a disparity, in units of
about a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.footprints import ground_sample_distance
from zlocus.core.grid import CellWindow, cells_of_bounds
from zlocus.core.options import OrientationOptions, PyramidOptions, RunConfig
from zlocus.core.options.option_fields import with_depth_values
from zlocus.core.scene import ImageSource, ImageWindow, Scene, View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_scene import MatchScene, levels_for
from zlocus.matching.radiometry import grey_scales
from zlocus.matching.tile_views import COARSER_TABLE_PX, FINEST_TABLE_PX
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.image_rays import DepthRays, HeightRays, PixelModel, Rays
from zlocus.sensors.projection_table import TableRequest, projection_table

# Places along each side of the reference image at which its geometry is sampled.
SAMPLES_PER_SIDE = 7
# Outer corner of the first pixel: column, minus row.
ANCHOR = (-0.5, 0.5)
# Width of the copies of the outermost pixels around every image, which let windows at its edges be compared: half a
# window, the pixels that the interpolation needs beside it, and one more.
BORDER_PX = 6
# Ties from which a range of disparities is found, the percentiles of it that are used, and what is added at both ends.
MIN_TIES = 20
TIE_PERCENTILES = (0.5, 99.5)
DISPARITY_MARGIN_PX = 8.0
# Smaller disparities count as infinitely far.
MIN_DISPARITY_PX = 0.5
# Views whose equivalent disparity grows more slowly than this, px per unit of the hypothesis, show no depths.
MIN_DISPARITY_RATE_PX = 1e-4
MIN_BLOCK_CELLS = 8
# Disparities at which the overlap with the other views is tested.
DISPARITY_SAMPLES = 64
# Steps that are added at both ends of the hypotheses, because a peak at an end needs its neighbours.
END_STEPS = 6


@dataclass(frozen=True)
class BorderedImage:
    """An image with copies of its outermost pixels around it, as an `ImageSource`. border : px."""

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
    """A reference image, its rays, and all views with sensor models over its frame, the reference image first."""

    reference_view: View
    rays: Rays
    views: tuple[View, ...]

    def ground(self, row: int, z: NDArray[np.float32], col: int = 0) -> FloatArray:
        """Ground points (r, c, 3) m of a block of pixels whose first one is (row, col); NaN where z is NaN.

        z : (r, c) hypotheses.
        """
        known = np.isfinite(z)
        out = np.full((*z.shape, 3), np.nan)
        rows, cols = np.nonzero(known)
        out[known] = self.rays.ground(np.column_stack([cols + col, rows + row]).astype(float), z[known].astype(float))
        return out

    def frame_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Column, minus row, and hypothesis (n, 3) of ground points (n, 3) m; NaN where they are not visible."""
        xy = self.reference_view.sensor.image_from_ground(xyz)
        return np.column_stack([xy * [1.0, -1.0], self.rays.hypothesis(xyz)])


def is_by_depth(scene: Scene) -> bool:
    """Whether depths are searched instead of heights: where all views are frame cameras, which may look anywhere."""
    return all(isinstance(view.sensor, FrameModel) for view in scene.views)


def image_space(scene: Scene, reference: str, z_range: tuple[float, float]) -> ImageSpace:
    """The scene in the frame of one of its images. reference : name of its view; z_range : m, range of the heights of
    the ground, not used for depths.

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
    other_views = [view for view in scene.views if view.name != reference]
    rays = depth_rays(first, other_views) if is_by_depth(scene) else height_rays(first, z_range)
    return _along(rays, first, other_views)


def height_space(scene: Scene, reference: str, z_range: tuple[float, float]) -> ImageSpace:
    """The scene in the frame of one of its images, with heights along its rays whatever the cameras are, as in GC3.

    reference : name of one of its views; z_range : m, range of the heights of the ground.
    """
    (first,) = (view for view in scene.views if view.name == reference)
    return _along(height_rays(first, z_range), first, [view for view in scene.views if view.name != reference])


def _along(rays: Rays, view: View, other_views: list[View]) -> ImageSpace:
    """The space of some rays of a view."""
    moved = [replace(other, sensor=rays.to(other.sensor)) for other in other_views]
    return ImageSpace(view, rays, (replace(view, sensor=PixelModel()), *moved))


def height_rays(view: View, z_range: tuple[float, float]) -> HeightRays:
    """Rays of an image, with heights as hypotheses. z_range : m, range of the heights of the ground."""
    middle = (z_range[0] + z_range[1]) / 2
    unit = ground_sample_distance(view, middle)
    if not np.isfinite(unit):
        raise GeometryError(
            f"{view.name} ({view.path}) does not see the ground at {middle:.0f} m. Check its camera, or give --heights."
        )
    return HeightRays(view.sensor, middle, unit)


def depth_rays(view: View, other_views: list[View]) -> DepthRays:
    """Rays of a frame camera, with disparities as hypotheses, in pixels of the longest base to another view."""
    sensor = view.sensor
    assert isinstance(sensor, FrameModel), "only frame cameras are matched by depth"
    bases = [np.array(other.sensor.centre) - np.array(sensor.centre) for other in other_views]  # type: ignore[attr-defined]
    longest = max(float(np.linalg.norm(base)) for base in bases)
    if not longest > 0:
        raise GeometryError(
            "All cameras stand in one place, so their images show no depths. Add an image from another place."
        )
    return DepthRays(sensor, sensor.focal * longest)


def build_image_match_scene(
    image_space: ImageSpace,
    z_range: tuple[float, float],
    ties: FloatArray,
    options: PyramidOptions,
    ground: FloatArray | None = None,
) -> MatchScene:
    """Match scene whose cells are the pixels of a reference image and whose heights are hypotheses.

    z_range : hypotheses to search, to which END_STEPS are added at both ends; ties : (n, 3), column, minus row,
    hypothesis; ground : (k, 3), points at which the grey values of the images are compared, None: at all ties.
    """
    rows, cols = image_space.reference_view.image.shape
    views = tuple(bordered(view) for view in image_space.views)
    step = hypothesis_step(image_space, (z_range[0] + z_range[1]) / 2, options.max_shift_px)
    n_steps = int(np.ceil((z_range[1] - z_range[0]) / step)) + 2 * END_STEPS
    levels = levels_for(n_steps, options)
    return MatchScene(
        views=views,
        anchor=ANCHOR,
        cell_size=1.0,
        height_origin=z_range[0] - END_STEPS * step,
        height_step=step,
        n_steps=n_steps,
        levels=levels,
        overlap_window=cells_of_bounds((-0.5, 0.5 - rows, cols - 0.5, 0.5), ANCHOR, 1.0, levels),
        grey_scales=grey_scales(views, ties if ground is None else ground),
        ties=ties,
    )


def beyond_range(match_scene: MatchScene, height: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(r, c) bool: hypotheses that lie in the END_STEPS beyond the range that was asked for. height : (r, c)."""
    low = match_scene.height_origin + (END_STEPS - 0.5) * match_scene.height_step
    high = match_scene.height_origin + (match_scene.n_steps - END_STEPS + 0.5) * match_scene.height_step
    return np.asarray((height < low) | (height > high))


def bordered(view: View) -> View:
    """The view with copies of its outermost pixels around it."""
    sensor = ShiftedModel(view.sensor, float(BORDER_PX), float(BORDER_PX))
    return replace(view, image=BorderedImage(view.image, BORDER_PX), sensor=sensor)


def depth_options(config: RunConfig) -> RunConfig:
    """The configuration with the values for depths, where options are unset.

    The values of the ground grid are chosen for ground seen from above. Close objects have deep jumps and sharp
    texture. So the correlation window is narrow, because every jump is an outline in the reference image, and the least
    penalty of jumps is higher. Pairs with an occluded view are excluded whole, because the reference image is never
    occluded. A view counts as occluded only far below the occluder, because the coarser surface blurs outlines by some
    steps, and the cross-consistency check finds occlusions exactly.
    """
    # With one predecessor per path: jumps are sharp, and the second one costs time.
    semiglobal = with_depth_values(config.semiglobal)
    semiglobal = replace(semiglobal, predecessors=semiglobal.predecessors or 1)
    planes = with_depth_values(config.planes)
    return replace(config, cost=with_depth_values(config.cost), semiglobal=semiglobal, planes=planes)


def hypotheses_of_heights(image_space: ImageSpace, z_range: tuple[float, float]) -> tuple[float, float] | None:
    """Lowest and highest hypothesis between two heights (m); None where a ray does not reach one of them."""
    rays, (rows, cols) = image_space.rays, image_space.reference_view.image.shape
    if isinstance(rays, HeightRays):
        return (z_range[0] - rays.datum) / rays.unit, (z_range[1] - rays.datum) / rays.unit
    col, row = np.meshgrid(np.linspace(0, cols - 1, SAMPLES_PER_SIDE), np.linspace(0, rows - 1, SAMPLES_PER_SIDE))
    xy = np.column_stack([col.ravel(), row.ravel()])
    ground = [image_space.reference_view.sensor.ground_from_image(xy, np.full(len(xy), z)) for z in z_range]
    found = rays.hypothesis(np.concatenate(ground))
    return (float(found.min()), float(found.max())) if np.isfinite(found).all() else None


def widest_disparities(image_space: ImageSpace) -> tuple[float, float]:
    """Disparities from infinitely far to the nearest point that another view can see too, at most half the longest base
    away."""
    rays = image_space.rays
    assert isinstance(rays, DepthRays), "heights have bounds of their own"
    nearest = 2.0 * rays.sensor.focal
    for z in np.linspace(nearest, nearest / DISPARITY_SAMPLES, DISPARITY_SAMPLES):
        if any(np.isfinite(shift_rates(image_space, view, float(z))).any() for view in image_space.views[1:]):
            return 0.0, float(z)
    return 0.0, nearest


def hypotheses_of_ties(image_space: ImageSpace, ties: FloatArray, options: OrientationOptions) -> tuple[float, float]:
    """Range of disparities to search, from ties (n, 3): column, minus row, disparity.

    The percentiles of the ties are widened at both ends by `range_margin` times their span and by
    `DISPARITY_MARGIN_PX`, but not below `MIN_DISPARITY_PX`.

    Raises
    ------
    GeometryError
        There are fewer than MIN_TIES.
    """
    if len(ties) < MIN_TIES:
        raise GeometryError(
            f"Only {len(ties)} reliable tie points were found in {image_space.reference_view.name}, too few to tell "
            f"its depths ({MIN_TIES} are needed). Give --heights ZMIN ZMAX, or check the cameras."
        )
    low, high = (float(v) for v in np.percentile(ties[:, 2], TIE_PERCENTILES))
    margin = options.range_margin * (high - low) + DISPARITY_MARGIN_PX
    return max(low - margin, MIN_DISPARITY_PX), high + margin


def fitting_block(match_scenes: Sequence[MatchScene], block: int) -> int | None:
    """The largest block, from `block` cells halved as often as needed, whose projection tables hold; None where even
    `MIN_BLOCK_CELLS` is too large.

    Between images that are rotated against each other the loci bend more within a block of pixels than on a map grid.
    """
    while not all(_fits(match_scene, block) for match_scene in match_scenes):
        block //= 2
        if block < MIN_BLOCK_CELLS:
            return None
    return block


def _fits(match_scene: MatchScene, block: int) -> bool:
    step = match_scene.height_step * 2 ** (match_scene.levels - 1)
    z_range = (match_scene.height_origin - 2 * step, match_scene.z_range[1] + 18 * step)
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


def hypothesis_step(image_space: ImageSpace, z: float, max_shift_px: float) -> float:
    """Step of the hypotheses, in their unit, at which the most sensitive image moves by `max_shift_px`.

    Movements are equivalent disparities, as in `height_step`: where a pixel of an image is smaller than one of the
    reference image, they are counted in pixels of the reference image.

    Raises
    ------
    GeometryError
        No image moves, or none overlaps the reference image.
    """
    rates = [
        float(np.nanmedian(r))
        for view in image_space.views[1:]
        if np.isfinite(r := shift_rates(image_space, view, z)).any()
    ]
    if not max(rates, default=0.0) > MIN_DISPARITY_RATE_PX:
        name, path = image_space.reference_view.name, image_space.reference_view.path
        raise GeometryError(
            f"No other image shows the heights of what {name} ({path}) sees: they do not overlap, or look along the "
            "same line. Check the cameras, or add an image from another direction."
        )
    return max_shift_px / max(rates)


def shift_rates(image_space: ImageSpace, view: View, z: float) -> FloatArray:
    """Equivalent disparity (n,) of a view, px per unit of the hypothesis, at n pixels spread over the reference image;
    NaN where the view does not see them. z : hypothesis."""
    rows, cols = image_space.reference_view.image.shape
    col, row = np.meshgrid(np.linspace(0, cols - 1, SAMPLES_PER_SIDE), np.linspace(0, rows - 1, SAMPLES_PER_SIDE))
    here = np.column_stack([col.ravel(), -row.ravel(), np.full(col.size, z)])
    at = [view.sensor.image_from_ground(here + 0.5 * step) for step in (np.zeros(3), *np.eye(3), *-np.eye(3))]
    by_col, by_row, by_z = (at[k] - at[k + 3] for k in (1, 2, 3))
    pixel = np.sqrt(np.abs(by_col[:, 0] * by_row[:, 1] - by_col[:, 1] * by_row[:, 0]))
    rate = np.hypot(*by_z.T) / np.maximum(pixel, 1.0)
    height, width = view.image.shape
    inside = ((at[0] > -0.5) & (at[0] < [width - 0.5, height - 0.5])).all(axis=1)
    return np.where(inside, rate, np.nan)


# Rows of an image that are checked at a time.
ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class MatchedImage:
    """Heights of the pixels of a reference image.

    height : (r, c) float32 hypotheses, NaN where there is none; middle : middle of the hypotheses that were searched.
    """

    image_space: ImageSpace
    height: NDArray[np.float32]
    middle: float

    def px_per_unit(self, other: str) -> float:
        """Equivalent disparity against another view, px per unit of the hypothesis; NaN where they do not overlap."""
        (view,) = (view for view in self.image_space.views if view.name == other)
        rates = shift_rates(self.image_space, view, self.middle)
        return float(np.median(rates[np.isfinite(rates)])) if np.isfinite(rates).any() else float("nan")


@dataclass(frozen=True)
class CrossConsistency:
    """How many other images have the same height, a height farther away (they see through it), or a nearer one (it is
    occluded there): each (r, c) uint8."""

    agreeing: NDArray[np.uint8]
    farther: NDArray[np.uint8]
    nearer: NDArray[np.uint8]

    @property
    def is_consistent(self) -> NDArray[np.bool_]:
        """(r, c): where more images agree than see through the height; so at least one agrees."""
        return np.asarray(self.agreeing > self.farther)


def check_cross_consistency(
    matched_image: MatchedImage, other_matched_images: Sequence[MatchedImage], tolerance_px: float
) -> Iterator[tuple[slice, CrossConsistency]]:
    """Compare every height of an image with those of the other images; yields some rows of the image after others.

    A height becomes a ground point. The ground point has a pixel (the nearest) and a hypothesis in each other image. It
    agrees with the height of that pixel where the two hypotheses differ by no more than `tolerance_px` of equivalent
    disparity between the two images. Pixels without a height do not count.
    """
    overlapping_images = images_that_overlap(matched_image, other_matched_images)
    n_rows, cols = matched_image.height.shape
    for row in range(0, n_rows, ROWS_AT_ONCE):
        window = CellWindow(row, 0, min(ROWS_AT_ONCE, n_rows - row), cols)
        rows = slice(row, row + window.rows)
        yield rows, cross_consistency(matched_image, window, overlapping_images, tolerance_px)


class OverlappingImage(NamedTuple):
    """An image that shows the ground of another one. px_per_unit : see `MatchedImage.px_per_unit`."""

    matched_image: MatchedImage
    px_per_unit: float


def images_that_overlap(
    matched_image: MatchedImage, other_matched_images: Sequence[MatchedImage]
) -> list[OverlappingImage]:
    """The images among others that show the ground of an image."""
    name = matched_image.image_space.reference_view.name
    rated = (OverlappingImage(other, other.px_per_unit(name)) for other in other_matched_images)
    return [each for each in rated if np.isfinite(each.px_per_unit)]


def cross_consistency(
    matched_image: MatchedImage, window: CellWindow, overlapping_images: Sequence[OverlappingImage], tolerance_px: float
) -> CrossConsistency:
    """The comparison of a window of an image's pixels with other images, see `check_cross_consistency`."""
    part = matched_image.height[window.row : window.row + window.rows, window.col : window.col + window.cols]
    counts, known = np.zeros((3, *part.shape), np.uint8), np.isfinite(part)
    ground = matched_image.image_space.ground(window.row, part, window.col)[known]
    for other, px_per_unit in overlapping_images:
        differs = hypothesis_differences(other, ground) * px_per_unit
        for count, where in zip(
            counts, (np.abs(differs) <= tolerance_px, differs < -tolerance_px, differs > tolerance_px), strict=True
        ):
            count[known] += where
    return CrossConsistency(counts[0], counts[1], counts[2])


def hypothesis_differences(matched_image: MatchedImage, ground: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hypotheses (n,) by which the heights of an image are nearer to it than ground points (n, 3) m; NaN where it has
    none."""
    at = matched_image.image_space.frame_from_ground(ground)
    rows, cols = matched_image.height.shape
    with np.errstate(invalid="ignore"):
        col, row = np.rint(at[:, 0]), np.rint(-at[:, 1])
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    own = np.full(len(ground), np.nan)
    own[inside] = matched_image.height[row[inside].astype(int), col[inside].astype(int)]
    return np.asarray(own - at[:, 2])
