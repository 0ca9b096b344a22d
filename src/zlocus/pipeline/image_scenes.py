"""Setup of matching in image space: cameras and heights, a match scene for each reference image, and the area.

The steps, in order: `set_up_images` (orientation and height range) and `build_image_scenes` (a match scene for each
reference image). `zlocus.pipeline.image_tiles` matches their tiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, CoverageError, GeometryError
from zlocus.core.footprints import (
    AREA_MARGIN,
    Bounds,
    check_bounds_seen,
    check_overlap,
    overlap_of,
    shared_ground,
)
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import CloudRequest
from zlocus.core.scene import Scene, View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.image_space import (
    END_STEPS,
    ImageSpace,
    build_image_match_scene,
    fitting_block,
    height_space,
    hypotheses_of_heights,
    hypotheses_of_ties,
    image_space,
    is_by_depth,
    widest_disparities,
)
from zlocus.matching.match_scene import MIN_LEVELS, MatchScene
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.tie_heights import supported
from zlocus.orientation.tie_refinement import RefinedTies
from zlocus.pipeline.height_range import possible_heights, range_from_ties
from zlocus.pipeline.setup import RunSetup, orient_views, reference_features, supported_views, wrong_heights
from zlocus.sensors.frame import FrameModel

# Margin around a window of pixels that may show an area.
MARGIN_PX = 16
# Rays followed along each side of a window of pixels: lenses and unsteady scanners bend its outline on the ground.
N_RAYS = 9
EVERYWHERE = (-np.inf, -np.inf, np.inf, np.inf)


@dataclass(frozen=True)
class ImageSetup:
    """What the matching of images in their own spaces starts from.

    scene : the views that take part, with corrected cameras; ties : (n, 3) m, ground points; is_supported : (n,)
    whether the tie points around confirm them; z_range : heights searched, m, None where each image takes its range of
    depths from the tie points.
    """

    scene: Scene
    orientation: Orientation
    ties: FloatArray
    is_supported: NDArray[np.bool_]
    z_range: tuple[float, float] | None


@dataclass(frozen=True)
class ImageScene:
    """A reference image: its image space, and the match scene of its tiles."""

    image_space: ImageSpace
    match_scene: MatchScene


def pixels_of(image_scene: ImageScene) -> CellWindow:
    """All pixels of a reference image."""
    return CellWindow(0, 0, *image_scene.image_space.reference_view.image.shape)


def _corners_of_rays(pixel_window: CellWindow, ends: tuple[float, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Columns, rows and two values along the ray (n,) at pixels spread over a window and a margin around it."""
    col, row = (np.linspace(start - MARGIN_PX, start + n + MARGIN_PX, N_RAYS) for start, n in (
        (pixel_window.col, pixel_window.cols), (pixel_window.row, pixel_window.rows)))  # fmt: skip
    x, y, z = (v.ravel() for v in np.meshgrid(col, row, ends))
    return x, y, z


def rays_on_ground(image_space: ImageSpace, pixel_window: CellWindow, hypotheses: tuple[float, float]) -> FloatArray:
    """Ground points (n, 3) m at two hypotheses along rays that are spread over a window of pixels and a margin."""
    x, y, z = _corners_of_rays(pixel_window, hypotheses)
    return image_space.rays.ground(np.column_stack([x, y]), z)


def searched_range(match_scene: MatchScene) -> tuple[float, float]:
    """Lowest and highest hypothesis that a pixel may keep, see `beyond_range`."""
    low = match_scene.height_origin + (END_STEPS - 0.5) * match_scene.height_step
    high = match_scene.height_origin + (match_scene.n_steps - END_STEPS + 0.5) * match_scene.height_step
    return low, high


@dataclass(frozen=True)
class GroundArea:
    """Ground to be matched.

    bounds : (xmin, ymin, xmax, ymax) m; z_range : lowest and highest height, m, None for all hypotheses that are
    searched; polygons : (n,) shapely geometries in the scene's CRS, of which one must hold a point, None holds all.
    """

    bounds: tuple[float, float, float, float]
    z_range: tuple[float, float] | None
    polygons: NDArray[Any] | None = None

    def may_show(
        self, image_space: ImageSpace, pixel_window: CellWindow, hypotheses: tuple[float, float] = (0.0, 0.0)
    ) -> bool:
        """Whether a window of pixels of a reference image, with a margin, may show the area between its two heights.

        hypotheses : lowest and highest one that is searched, for an area without heights.
        """
        if self.z_range is None:
            ground = rays_on_ground(image_space, pixel_window, hypotheses)[:, :2]
        else:
            x, y, z = _corners_of_rays(pixel_window, self.z_range)
            ground = image_space.reference_view.sensor.ground_from_image(np.column_stack([x, y]), z)[:, :2]
        if not np.isfinite(ground).all():
            return True
        (west, south), (east, north) = ground.min(axis=0), ground.max(axis=0)
        if west > self.bounds[2] or east < self.bounds[0] or south > self.bounds[3] or north < self.bounds[1]:
            return False
        if self.polygons is None:
            return True
        return bool(shapely.intersects(self.polygons, shapely.box(west, south, east, north)).any())

    def holds(self, xy: FloatArray) -> NDArray[np.bool_]:
        """Whether ground points lie in the area. xy : (n, 2) m, in the scene's CRS.

        The western and the southern bound belong to it, the others do not: areas side by side share no point.
        """
        (x, y), (west, south, east, north) = xy.T, self.bounds
        inside = (x >= west) & (x < east) & (y >= south) & (y < north)
        if self.polygons is None or not inside.any():
            return np.asarray(inside)
        x, y, of_any = x[inside], y[inside], np.zeros(int(inside.sum()), bool)
        near = shapely.intersects(self.polygons, shapely.box(x.min(), y.min(), x.max(), y.max()))
        for polygon in self.polygons[near]:
            of_any |= shapely.contains_xy(polygon, x, y)
        inside[inside] = of_any
        return np.asarray(inside)


def area_of(request: CloudRequest, polygons: NDArray[Any] | None, setup: ImageSetup) -> GroundArea | None:
    """The ground of --bounds and --area; None where neither is given. polygons : of --area.

    Raises
    ------
    GeometryError
        Two images see nothing of it.
    """
    if request.bounds is None and polygons is None:
        return None
    seen, bounds = ground_seen(setup), request.bounds or EVERYWHERE
    if request.bounds is not None:
        check_bounds_seen(bounds, seen)
    if polygons is None:
        return GroundArea(bounds, None)
    west, south, east, north = (float(v) for v in shapely.total_bounds(polygons))
    bounds = overlap_of(bounds, (west, south, east, north))
    shared = overlap_of(bounds, seen)
    if shared[0] >= shared[2] or shared[1] >= shared[3] or not shapely.intersects(polygons, shapely.box(*shared)).any():
        raise GeometryError(
            f"No pixel that two images see shows ground inside {request.area}. Check the polygons and their CRS."
        )
    return GroundArea(bounds, None, polygons)


def ground_seen(setup: ImageSetup) -> Bounds:
    """Bounds of the ground that two images see; where depths are searched, of the tie points and their surroundings."""
    if setup.z_range is not None and not is_by_depth(setup.scene):
        return shared_ground(setup.scene, setup.z_range)
    return bounds_of_ties(setup)


def bounds_of_ties(setup: ImageSetup) -> Bounds:
    """Bounds of the tie points, extended on all sides."""
    xy = setup.ties[setup.is_supported, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    (west, south), (east, north) = low - AREA_MARGIN * (high - low), high + AREA_MARGIN * (high - low)
    return float(west), float(south), float(east), float(north)


def reference_names(scene: Scene, requested: Sequence[str]) -> list[str]:
    """Names of the reference images in the scene's order; all of them where none is requested.

    Raises
    ------
    ConfigError
        A requested name is not a view of the scene.
    """
    names = [view.name for view in scene.views]
    for name in requested:
        if name not in names:
            raise ConfigError(f"--reference {name} is not a view of this scene. Choose from {', '.join(names)}.")
    return [name for name in names if not requested or name in requested]


def set_up_images(
    scene: Scene, config: RunConfig, progress: Progress, known_ties: RefinedTies | None = None
) -> ImageSetup:
    """Orient the views, and find the range of heights to search. known_ties : see `OrientationRequest`.

    Frame cameras may look in any direction. They are oriented over the pixels and disparities of the first image: a
    shift of an image is the same there, and disparities, unlike heights, are linear along every epipolar line.
    """
    options = config.orientation
    if not is_by_depth(scene):
        check_overlap(scene, possible_heights(scene, scene.heights))
        orientation = orient_views(scene, options, progress, known_ties=known_ties)
        is_supported = supported(orientation.xyz, orientation.sigma_z_m)
        z_range = scene.heights or range_from_ties(scene, orientation, options).expected
        try:
            used = supported_views(orientation.apply(scene), orientation)
        except CoverageError as error:
            wrong = None if scene.heights is None else wrong_heights(scene.heights, scene, config)
            raise wrong or error from error
        return ImageSetup(used, orientation, orientation.xyz, is_supported, z_range)
    space = image_space(scene, scene.views[0].name, (0.0, 0.0))
    given = None if scene.heights is None else hypotheses_of_heights(space, scene.heights)
    in_first_image = Scene(space.views, scene.crs, heights=given or widest_disparities(space))
    orientation = orient_views(in_first_image, options, progress, known_ties=known_ties)
    views = tuple(shifted(view, v.shift_px) for view, v in zip(scene.views, orientation.views, strict=True))
    ground = space.rays.ground(orientation.xyz[:, :2] * [1.0, -1.0], orientation.xyz[:, 2])
    is_supported = supported(orientation.xyz, orientation.sigma_z_m) & np.isfinite(ground).all(axis=1)
    used = supported_views(replace(scene, views=views), orientation)
    return ImageSetup(used, orientation, ground, is_supported, scene.heights)


def shifted(view: View, shift_px: tuple[float, float]) -> View:
    """A view whose frame camera is moved by a shift in its image, px."""
    assert isinstance(view.sensor, FrameModel), "only frame cameras are matched by depth"
    return replace(view, sensor=view.sensor.moved(*shift_px))


class ImageScenes(NamedTuple):
    """The reference images to be matched, and the configuration with blocks and levels that suit all of them."""

    image_scenes: list[ImageScene]
    config: RunConfig


def build_image_scenes(setup: ImageSetup, references: Sequence[str], config: RunConfig) -> ImageScenes:
    """The match scene of every reference image, and the configuration that suits them.

    Where frame cameras look from very different directions, projections bend too much within the blocks of a coarse
    level for the projection tables: then there are fewer levels, and the coarsest one searches more steps.
    """
    while True:
        image_scenes = [build_image_scene(setup, name, config) for name in references]
        block = fitting_block([each.match_scene for each in image_scenes], config.pyramid.block)
        levels = max(each.match_scene.levels for each in image_scenes)
        if block is not None or levels <= MIN_LEVELS:
            pyramid = replace(config.pyramid, block=block or config.pyramid.block)
            return ImageScenes(image_scenes, replace(config, pyramid=pyramid))
        config = replace(config, pyramid=replace(config.pyramid, max_levels=levels - 1))


def build_image_scene(setup: ImageSetup, reference: str, config: RunConfig) -> ImageScene:
    """A reference image's space, and the match scene of its pixels."""
    space = image_space(setup.scene, reference, setup.z_range or (0.0, 0.0))
    ties = space.frame_from_ground(setup.ties)
    is_known = np.isfinite(ties).all(axis=1)
    span = None if setup.z_range is None else hypotheses_of_heights(space, setup.z_range)
    if span is None:
        span = hypotheses_of_ties(space, ties[is_known & setup.is_supported], config.orientation)
    measured = ties[: setup.orientation.n_refined]
    measured = measured[np.isfinite(measured).all(axis=1)]
    return ImageScene(space, build_image_match_scene(space, span, ties[is_known], config.pyramid, measured))


def reference_scene(setup: RunSetup, config: RunConfig) -> ImageScene:
    """The pixels of the reference image of a run, with heights along its rays whatever its camera is (GC3).

    Its tie points are the feature points of the reference image.
    """
    scene, z_range = supported_views(setup.scene, setup.orientation), setup.height_range.expected
    space = height_space(scene, setup.match_scene.views[0].name, z_range)
    span = hypotheses_of_heights(space, z_range)
    assert span is not None, "hypotheses are heights"
    ties = space.frame_from_ground(reference_features(setup))
    ties = ties[np.isfinite(ties).all(axis=1)]
    return ImageScene(space, build_image_match_scene(space, span, ties, config.pyramid))
