"""What follows the matching of the finest level: planes, refinement, checks, precision and ortho-image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import RunConfig
from zlocus.core.options.option_fields import value_of
from zlocus.matching.height_checks import judge
from zlocus.matching.kernels.spline import spline_coefficients
from zlocus.matching.level_records import LevelResult, TileInputs
from zlocus.matching.local_contrast import agreeing_views, edge_image, texture_unit
from zlocus.matching.local_planes import SIDES, smoothed_by_planes
from zlocus.matching.occlusion import covers, excluded_view_mask, n_seeing
from zlocus.matching.overlap import OverlapGround, unsupported
from zlocus.matching.plane_fitting import PlanarHeights, with_planes
from zlocus.matching.precision import sigma_steps, spread_around, texture_around, uncertainty_predictors
from zlocus.matching.quality import Quality, is_empty
from zlocus.matching.subpixel import refine
from zlocus.matching.surface import Surface
from zlocus.matching.true_ortho import CoarserHeights, ortho_image, surroundings_of_tile, true_ortho
from zlocus.matching.uncertain_heights import with_medians

# Number of views in which segments without texture are looked for, one after the other.
MAX_VIEWS_FOR_PLANES = 2
# A view is sharp enough to tell a plain roof from a blurred one where the texture of the second sharpest view (the
# sharpest may be noise) is at most this many times its own.
MAX_TEXTURE_RATIO_OF_SHARP_VIEW = 1.5


@dataclass(frozen=True)
class MeasuredHeights:
    """Refined heights of single cells, (r, c) each.

    lattice_index : float32; sigma : float32, their standard deviations, steps; quality : uint16; n_views : views that
    see a cell.
    """

    lattice_index: NDArray[np.float32]
    sigma: NDArray[np.float32]
    quality: NDArray[np.uint16]
    n_views: NDArray[np.integer]


@dataclass(frozen=True)
class RefinedSurface:
    """surface : of the finest level's window, without ortho-image; lattice_index : (r, c) float32, heights of all
    cells, of those too that the surface leaves empty."""

    surface: Surface
    lattice_index: NDArray[np.float32]


def with_planes_of_segments(result: LevelResult, config: RunConfig) -> LevelResult:
    """The finest level with planes in place of the heights of segments without texture, such as roofs.

    The segments are found in the first `MAX_VIEWS_FOR_PLANES` views that agree with the others and are sharp.
    """
    heights, core = result.heights, result.level.core
    planar = PlanarHeights(heights.vertex, np.zeros(heights.vertex.shape, np.bool_))
    n_views = len(result.tile_views.layout)
    orthos = [_known_ortho(result, planar.height, view) for view in range(n_views)]
    agrees = np.ones(n_views, np.bool_) if result.agreement is None else agreeing_views(result.agreement)
    texture = [texture_unit(ortho, core) for ortho in orthos]
    agreeing = [view for view in range(n_views) if agrees[view]]
    second_sharpest = sorted(texture[view] for view in agreeing)[-2:][0]  # of a single view its own
    sharp_views = [view for view in agreeing if texture[view] * MAX_TEXTURE_RATIO_OF_SHARP_VIEW > second_sharpest]
    for number, view in enumerate(sharp_views[:MAX_VIEWS_FOR_PLANES]):
        ortho = orthos[view] if number == 0 else _known_ortho(result, planar.height, view)
        planar = with_planes(result.tile_views, ortho, planar, result.visible, config.planes, core)
    return replace(result, heights=replace(heights, vertex=planar.height), is_planar=planar.is_planar)


def _known_ortho(result: LevelResult, lattice_index: NDArray[np.float32], view: int) -> NDArray[np.float32]:
    """The ortho-image (r, c) of a view on heights; NaN where masked pixels or nodata hide the ground, which would look
    like a plain segment."""
    ortho = ortho_image(result.tile_views, lattice_index, view)
    if not result.tile_views.has_blocked[view]:
        return ortho
    return np.where(covers(result.visible)[view], ortho, np.float32(np.nan))


def refined_surface(tile: TileInputs, result: LevelResult, ground: OverlapGround) -> RefinedSurface:
    """Refine the heights of the finest level, halo included, check them, and estimate their precision."""
    measured_heights = _single_cell_heights(tile, result, ground)
    lattice_index, quality = measured_heights.lattice_index, measured_heights.quality
    if tile.method != "mvll":
        lattice_index = _smoothed(tile, result, measured_heights)
    height = result.lattice.metres(lattice_index)
    sigma = measured_heights.sigma * np.float32(tile.match_scene.height_step)
    height[is_empty(quality)] = np.nan
    sigma[is_empty(quality)] = np.nan
    n_images = np.where(np.isnan(height), 0, measured_heights.n_views).astype(np.uint8)
    surface = Surface(height, sigma, quality, n_images, np.full_like(height, np.nan))
    return RefinedSurface(surface, lattice_index)


def _single_cell_heights(tile: TileInputs, result: LevelResult, ground: OverlapGround) -> MeasuredHeights:
    """Refine the heights of single cells, check them, and estimate their precision."""
    match_scene, config = tile.match_scene, tile.config
    splines, layout = np.empty_like(result.tile_views.pixels), result.tile_views.layout
    for view, (first, rows, cols) in zip(result.tile_views.view_pixels, layout, strict=True):
        splines[first : first + rows * cols] = spline_coefficients(view.pixels).ravel()
    refined = refine(
        result.tile_views, splines, result.heights.vertex, result.visible, match_scene.step_cells, config.refine,
        result.is_planar,
    )  # fmt: skip
    is_covered = covers(result.visible)
    n_covering = is_covered.sum(axis=0)
    n_views = n_seeing(result.visible, refined.height)
    texture = texture_around(result.tile_views, refined.height, is_covered)
    predictors = uncertainty_predictors(result.heights, refined, n_views, texture, config.pyramid.halo)
    last_index = match_scene.n_steps - 1
    group_distance = np.exp(predictors["group_distance"])
    sigma = sigma_steps(predictors, refined, match_scene.line_shift_steps)
    quality = judge(result.heights, refined, n_covering, n_views, group_distance, sigma, last_index, config.checks)
    _mark_overlap(quality, result, ground, refined.height)
    is_uneven = spread_around(sigma) > config.checks.max_overlap_edge_sigma_steps
    is_noise = ground.is_at_edge_in(result.level.window) & is_uneven
    quality[is_noise] |= np.uint16(Quality.NO_MATCH)
    return MeasuredHeights(refined.height, sigma, quality, n_views)


def _smoothed(tile: TileInputs, result: LevelResult, measured_heights: MeasuredHeights) -> NDArray[np.float32]:
    """Heights (r, c) smoothed by local planes, and medians of those that stay uncertain.

    The standard deviations stay: in some scenes the errors reach farther than the planes.
    """
    options, core, is_known = tile.config.refine, result.level.core, ~is_empty(measured_heights.quality)
    sides = [side for side in SIDES if side <= value_of(options, "max_plane_side")]
    smooth = smoothed_by_planes(measured_heights.lattice_index, measured_heights.sigma, is_known, core, sides).height
    is_covered = covers(result.visible)
    agrees = np.ones(len(is_covered)) if result.agreement is None else result.agreement
    grey = edge_image(result.tile_views, smooth, is_covered, core, agrees)
    return with_medians(
        smooth, measured_heights.sigma, grey, is_known, options.median_sigma_steps, texture_unit(grey, core)
    )  # fmt: skip


def _mark_overlap(
    quality: NDArray[np.uint16], result: LevelResult, ground: OverlapGround, lattice_index: NDArray[np.float32]
) -> None:
    """Mark excluded views, cells outside the overlap of the images, and planes; changes `quality` (r, c)."""
    window = result.level.window
    quality[excluded_view_mask(result.tile_views, quality.shape)] |= np.uint16(Quality.IMAGE_EXCLUDED)
    quality[ground.is_uncovered_in(window)] |= np.uint16(Quality.UNSEEN)
    is_unsupported = unsupported(ground, window, result.tile_views, result.visible, lattice_index)
    quality[is_unsupported] |= np.uint16(Quality.UNSEEN)
    if result.is_planar is not None:
        quality[result.is_planar] |= np.uint16(Quality.PLANE)


def ortho_of_surface(
    tile: TileInputs, results: Sequence[LevelResult], surface: Surface, lattice_index: NDArray[np.float32]
) -> NDArray[np.float32]:
    """True ortho-image of a surface with its filled cells, (r, c) or (r, c, 3) float32; NaN where there is no height.

    results : of all levels, the coarsest first; surface : of the finest level's window; lattice_index : (r, c) heights
    of all cells as they were matched, which occlude others whether they were kept or not.
    """
    *coarser_results, finest = results
    lattice, config = finest.lattice, tile.config
    is_filled = (surface.quality & np.uint16(Quality.FILLED)) != 0
    of_filled = (surface.height - np.float32(lattice.height_origin)) / np.float32(lattice.height_step)
    lattice_index = np.where(is_filled, of_filled, lattice_index)
    coarser = [CoarserHeights(r.level.number, r.level.window, r.heights.vertex) for r in reversed(coarser_results)]
    window, halo = finest.level.window, config.pyramid.halo
    surroundings = surroundings_of_tile(coarser, finest.tile_views, window, lattice_index, halo)
    scale = tile.match_scene.grey_scales[0] if config.products.ortho_levels == "common" else None
    coloured = tile.match_scene.coloured(tile.view_numbers)
    ortho = true_ortho(finest.tile_views, finest.visible, lattice_index, coloured, surroundings, scale)
    ortho[np.isnan(surface.height)] = np.nan
    return ortho
