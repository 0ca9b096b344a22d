"""Every stage of a level against its slow twin, on a small scene: each twin gets what the stages before it made.

Three exact cameras see a wavy ground with a wall. The coarser level gives the search prior; the finest level is then
matched stage by stage. Tests of single kernels on random input are in `tests/matching/kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import CRS
from scipy.ndimage import median_filter, spline_filter

from orientation_scenes import image_of
from reference import agreement, semiglobal, surfaces
from reference.projection import bilinear, positions, slope_relief
from zlocus.core.grid import CellWindow
from zlocus.core.height_range import HeightRange
from zlocus.core.options import (
    CostOptions,
    PyramidOptions,
    RunConfig,
    large_window_side,
)
from zlocus.core.options.option_fields import value_of
from zlocus.core.scene import Scene, View
from zlocus.matching import subpixel
from zlocus.matching.cost_volume import CountedPairs, cost_parameters, cost_volume
from zlocus.matching.kernels.shared_records import NEVER_OCCLUDED, VisibleHeights
from zlocus.matching.kernels.spline import spline_coefficients
from zlocus.matching.kernels.subpixel import CUBIC, ProfileSampling
from zlocus.matching.level_records import PyramidLevel, SearchPrior, TileInputs
from zlocus.matching.local_contrast import edge_unit
from zlocus.matching.match_scene import build_match_scene
from zlocus.matching.occlusion import EDGE_PX, covered_heights, covers, in_level_indices, mark_occlusions
from zlocus.matching.search_range import prior_from_coarser
from zlocus.matching.semiglobal import aggregate, jump_penalties, winner_takes_all_indices
from zlocus.matching.subpixel import parabola_peaks, profiles_around, smoothed
from zlocus.matching.tile import LevelSearch, match_coarsest_level, search_along_slope, tile_inputs
from zlocus.matching.true_ortho import ortho_image
from zlocus.matching.view_directions import cells_per_step, parts_of_one_direction
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.render import Optics, Sun, expose, render
from zlocus.synthetic.terrain import analytic_ground

CENTRE, GSD_M, UTM = (462_000.0, 5_247_000.0), 0.5, CRS.from_epsg(32632)
# Forward and across view angles, degrees.
LOOKS = {"nadir": (1.0, -3.0), "fore": (18.0, 2.0), "aft": (-17.0, 4.0)}
FIELD, SIZE_PX = (640, 640), 56
SHAPE = (20, 26)
HEIGHTS_M = (45.0, 72.0)
CONFIG = RunConfig(
    pyramid=PyramidOptions(block=16, halo=8, max_levels=2),
    cost=CostOptions(large_window=5),
)
# Projection tables promise this; positions of the largest image differ by less.
TABLE_PX = 0.02
# Grey values in units of the images' contrast.
GREY = 2e-4
STEPS = 2e-4
# Rounding of a cost, and what its windows, which follow the slope surface at the speed of the block's middle, add.
COST = 1.01
NCC = 2e-3
NO_SECOND_MINIMUM = 65535


@dataclass(frozen=True)
class Stages:
    """What the stages of the finest level made, in their order."""

    tile: TileInputs
    level: PyramidLevel
    prior: SearchPrior
    search: LevelSearch
    visible: VisibleHeights
    cost: np.ndarray
    ortho: np.ndarray
    penalties: np.ndarray

    @property
    def views(self):
        return self.search.slope_views

    @property
    def lattice(self):
        return self.search.lattice

    def heights(self, options):
        """Semi-global heights, slope indices."""
        return aggregate(self.cost, self.lattice, self.penalties, self.tile.match_scene.step_cells, options)

    @property
    def dense_lattice(self):
        """The lattice with its heights counted from the lowest one that any block searches."""
        return replace(self.lattice, first=self.lattice.first - self.lattice.first.min())

    def dense(self, ragged):
        """(r, c, h) of a volume, infinite at the heights that a cell does not search."""
        return semiglobal.dense(ragged, self.dense_lattice, np.inf)

    @property
    def images(self):
        """Grey values of each view, (r, c)."""
        pixels = self.search.tile_views.pixels
        return [pixels[start : start + r * c].reshape(r, c) for start, r, c in self.search.tile_views.layout]

    def blocks(self):
        """Block row and column, and the rows and columns of the block's cells."""
        block, (rows, cols) = self.views.block, self.level.shape
        for b, d in np.ndindex(self.views.nodes.shape[1] - 1, self.views.nodes.shape[2] - 1):
            yield b, d, slice(b * block, min((b + 1) * block, rows)), slice(d * block, min((d + 1) * block, cols))


def scene():
    """Three views of ground that rises by a wall of 15 m, with exact cameras."""
    ground, views = analytic_ground("step", CENTRE, GSD_M / 2, FIELD, seed=5), []
    for number, (name, (along, across)) in enumerate(LOOKS.items()):
        centre = ((SIZE_PX - 1) / 2, (SIZE_PX - 1) / 2)
        sensor = SatelliteCamera((*CENTRE, 55.0), centre, GSD_M, along, across, 3.0)
        radiance = render(ground, sensor, (SIZE_PX, SIZE_PX), Sun(150.0, 50.0))
        grey = expose(radiance, Optics(noise=0.01, noise_floor=2.0), np.random.default_rng([3, number]))
        views.append(View(name, Path(f"{name}.tif"), image_of(grey.astype(float)), sensor))
    return Scene(tuple(views), UTM)


@pytest.fixture(scope="module")
def stages():
    x, y = np.random.default_rng(1).uniform(-8, 8, (2, 40)) + np.array(CENTRE)[:, None]
    ties = np.column_stack([x, y, np.where(x >= CENTRE[0], 65.0, 50.0)])
    heights = HeightRange.limited_to(HEIGHTS_M)
    match_scene = build_match_scene(scene(), GSD_M, (0.0, 0.0), heights, ties, None, CONFIG.pyramid)
    first = round(-CENTRE[1] / GSD_M) - SHAPE[0] // 2, round(CENTRE[0] / GSD_M) - SHAPE[1] // 2
    tile = tile_inputs(match_scene, CellWindow(*first, *SHAPE), CONFIG)
    assert len(tile.view_numbers) == 3
    coarsest = match_coarsest_level(tile).result
    level = tile.level(0)
    prior = prior_from_coarser(tile, level, coarsest)
    search = search_along_slope(tile, level, prior)
    visible = covered_heights(search.slope_views, search.slope_surface, search.lattice)
    cost = cost_volume(search.slope_views, search.slope_surface, search.lattice, visible, CONFIG.cost)
    ortho = np.where(covers(visible)[0], ortho_image(search.tile_views, search.smooth, 0), np.float32(np.nan))
    penalties = jump_penalties(ortho, level.shape, 0, CONFIG.semiglobal)
    return Stages(tile, level, prior, search, visible, cost, ortho, penalties)


def test_the_scene_is_worth_comparing(stages):
    """Both sides of the wall, several blocks, cells that a view does not cover, slopes, and edges in the image."""
    assert stages.level.number == 0
    assert len(list(stages.blocks())) >= 6
    assert np.ptp(stages.prior.surface) > 10
    assert np.ptp(stages.lattice.first) + np.ptp(stages.lattice.count) > 0
    assert not covers(stages.visible).all()
    assert np.isfinite(stages.ortho).mean() > 0.5
    assert len(np.unique(stages.penalties)) > 20


def test_projection_tables_give_the_positions_of_the_cameras(stages):
    views, level = stages.search.tile_views, stages.level
    for i, view_pixels in enumerate(views.view_pixels):
        for b, d, rows, cols in stages.blocks():
            row, col = np.mgrid[rows, cols]
            x, y = level.transform * (col + 0.5, row + 0.5)
            for index in (0, level.n_steps // 2, level.n_steps):
                z = np.full(x.shape, level.height_origin + index * level.height_step)
                xyz = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
                exact = view_pixels.sensor.image_from_ground(xyz) - np.array(view_pixels.origin[::-1])
                t = views.t_of_index[0] + index * views.t_of_index[1]
                found = positions(views.nodes[i, b : b + 2, d : d + 2], t, x.shape, views.block)
                np.testing.assert_allclose(found.reshape(-1, 2), exact, rtol=0, atol=TABLE_PX)


def test_a_surface_is_smoothed_as_in_plain_loops(stages):
    jump = CONFIG.refine.jump_steps
    expected = median_filter(stages.prior.surface.astype(float), 5, mode="nearest")
    for spacing in subpixel.SMOOTHING_SPACINGS_CELLS:
        by_row, by_col = (surfaces.slope(expected, subpixel.SLOPE_DISTANCE_CELLS, axis) for axis in (0, 1))
        expected = surfaces.smoothed(expected, by_row, by_col, spacing, jump)
    np.testing.assert_allclose(stages.search.smooth, expected, rtol=0, atol=STEPS)


def test_an_image_on_a_surface_is_resampled_at_the_projected_cells(stages):
    views, smooth = stages.search.tile_views, stages.search.smooth.astype(float)
    for i, image in enumerate(stages.images):
        found = ortho_image(views, stages.search.smooth, i)
        for b, d, rows, cols in stages.blocks():
            t = views.t_of_index[0] + smooth[rows, cols] * views.t_of_index[1]
            xy = positions(views.nodes[i, b : b + 2, d : d + 2], t, t.shape, views.block)
            inside = (xy > 1).all(axis=-1) & (xy < np.array(image.shape[::-1]) - 2).all(axis=-1)
            expected = bilinear(image, xy)
            np.testing.assert_allclose(found[rows, cols][inside], expected[inside], rtol=0, atol=10 * GREY)


def test_views_cover_the_heights_at_which_a_cell_falls_into_the_image(stages):
    """Along the slanted support surface; runs that end inside the search range may end one step beside the twin's."""
    views, slope_surface = stages.views, stages.search.slope_surface
    n_runs = 0
    for i, image in enumerate(stages.images):
        for b, d, rows, cols in stages.blocks():
            first, count = int(stages.lattice.first[b, d]), int(stages.lattice.count[b, d])
            node, shape = views.nodes[i, b : b + 2, d : d + 2], (rows.stop - rows.start, cols.stop - cols.start)
            inside = []
            for k in range(first, first + count):
                xy = positions(node, views.t_of_index[0] + k * views.t_of_index[1], shape, views.block)
                last = np.array(image.shape[::-1]) - 1 - EDGE_PX
                inside.append(((xy >= EDGE_PX) & (xy <= last)).all(axis=-1))
            inside = np.stack(inside, axis=-1)
            for r, c in np.ndindex(shape):
                low, high, _ = stages.visible.at((i, rows.start + r, cols.start + c))
                run = surfaces.longest_run(inside[r, c])
                if run is None:
                    assert low > high
                    continue
                bump = abs(slope_surface.relief[rows.start + r, cols.start + c]) + 1
                assert abs(low - first - run[0]) <= bump
                assert abs(high - first - run[1]) <= bump
                n_runs += run != (0, count - 1)
    assert n_runs > 0


def test_a_surface_occludes_what_marched_rays_meet(stages):
    occluder = cv2.erode(stages.prior.surface, stages.prior.erosion)
    visible, slope_cells = stages.visible.copy(), stages.search.slope_surface.cells
    margin_steps = value_of(CONFIG.cost, "occlusion_margin_steps")
    mark_occlusions(visible, stages.search.tile_views, occluder, slope_cells, margin_steps)
    n_occluded = 0
    for i in range(len(stages.images)):
        for part in parts_of_one_direction(stages.search.tile_views, i):
            by_col, by_row = cells_per_step(stages.search.tile_views, i, part)
            lowest = surfaces.marched(occluder.astype(float), by_col, by_row) - margin_steps - slope_cells
            found, expected = visible.lowest_unoccluded[i][part], lowest[part]
            free = expected < NEVER_OCCLUDED
            assert (found[free] == NEVER_OCCLUDED).all()
            # The kernel rounds to whole steps, and interpolates a bound again at every cell: it lies between those of
            # its neighbours, which differ much at the edges of roofs only.
            assert np.quantile(np.abs(found[~free] - expected[~free]), 0.95) <= 1.0
            around = np.ones((3, 3), np.uint8)
            assert (found >= cv2.erode(lowest, around)[part] - 1.0)[~free].all()
            assert (found <= cv2.dilate(lowest, around)[part] + 1.0)[~free].all()
            n_occluded += (expected > (occluder - slope_cells)[part]).sum()
    assert n_occluded > 0


def test_costs_are_those_of_windows_cut_out_one_by_one(stages):
    views, lattice, slope_surface = stages.views, stages.lattice, stages.search.slope_surface
    options = CONFIG.cost
    halves = sorted({options.small_window // 2, large_window_side(options) // 2})
    parameters = cost_parameters(options, CountedPairs())
    volume, lowest = stages.dense(stages.cost), int(lattice.first.min())
    padded = slope_surface.padded(max(halves))
    for b, d, rows, cols in stages.blocks():
        nodes, corners = views.nodes[:, b : b + 2, d : d + 2], slope_surface.nodes[b : b + 2, d : d + 2]
        relief = slope_relief(padded.astype(float), corners, rows, cols, views.block, max(halves))
        visible = stages.visible.at(np.s_[:, rows, cols])
        for k in range(int(lattice.first[b, d]), int(lattice.first[b, d] + lattice.count[b, d])):
            expected = agreement.cell_costs(
                stages.images, nodes, views.t_of_index, k, views.block, halves, visible, parameters, relief
            )
            assert np.abs(volume[rows, cols, k - lowest] - np.clip(expected, 0, 255)).max() < COST


def test_penalties_decrease_with_grey_differences(stages):
    """P2 / (1 + g / (edge_contrast median g)), not below p2_edge, between each cell and its W, NW, N and NE."""
    options, (rows, cols) = CONFIG.semiglobal, stages.level.shape
    unit = value_of(options, "edge_contrast") * edge_unit(stages.ortho)
    expected = np.empty((4, rows, cols))
    for path, (dr, dc) in enumerate(semiglobal.BEHIND):
        for r, c in np.ndindex(rows, cols):
            other = max(r + dr, 0), min(max(c + dc, 0), cols - 1)
            difference = abs(float(stages.ortho[r, c]) - float(stages.ortho[other]))
            difference = 0.0 if np.isnan(difference) else difference
            expected[path, r, c] = max(value_of(options, "p2") / (1 + difference / unit), value_of(options, "p2_edge"))
    # Penalties are rounded down.
    assert np.abs(stages.penalties - (expected - 0.5)).max() <= 0.5 + GREY


@pytest.mark.parametrize("predecessors", [1, 2])
def test_semiglobal_heights_have_the_least_sums_of_path_costs(stages, predecessors):
    """Of equal sums, the first height; the secondary minimum, the uniqueness and the parabola follow from the sums."""
    options = replace(CONFIG.semiglobal, predecessors=predecessors)
    found = stages.heights(options)
    twin = semiglobal.path_sums if predecessors == 1 else semiglobal.more_global_path_sums
    sums = twin(stages.dense(stages.cost), value_of(options, "p1"), stages.penalties)
    first, count = stages.lattice.cell_ranges()
    from_zero = first - stages.lattice.first.min()
    for r, c in np.ndindex(stages.level.shape):
        of_cell = sums[r, c, from_zero[r, c] : from_zero[r, c] + count[r, c]]
        best, second, vertex = semiglobal.winner(of_cell)
        assert found.best[r, c] - first[r, c] == best
        assert found.second[r, c] - first[r, c] == second
        assert found.vertex[r, c] - first[r, c] == pytest.approx(vertex, abs=STEPS)
        margin = of_cell[second] - of_cell[best] if second != best else NO_SECOND_MINIMUM
        assert found.uniqueness[r, c] == min(margin, NO_SECOND_MINIMUM)


def test_winner_takes_all_heights_have_the_least_costs(stages):
    volume, lowest = stages.dense(stages.cost), stages.lattice.first.min()
    heights = stages.heights(CONFIG.semiglobal)
    found = winner_takes_all_indices(stages.cost, stages.lattice, heights.best) - lowest
    of_found = np.take_along_axis(volume, found[..., None], axis=-1)[..., 0]
    np.testing.assert_array_equal(of_found, volume.min(axis=-1))


def test_correlation_profiles_follow_the_smooth_surface(stages):
    """Level indices and cubic interpolation, as in the last round of the refinement."""
    views, half = stages.search.tile_views, 3
    heights = stages.heights(CONFIG.semiglobal)
    surface = smoothed(heights.vertex + stages.search.slope_surface.cells, CONFIG.refine.jump_steps)
    splines = [spline_coefficients(image) for image in stages.images]
    for image, spline in zip(stages.images, splines, strict=True):
        np.testing.assert_allclose(spline, spline_filter(image, 3, output=np.float32, mode="mirror"), atol=10 * GREY)
    visible = in_level_indices(stages.visible.copy(), stages.search.slope_surface.cells)
    sampling = ProfileSampling(CUBIC, subpixel.LATER_OFFSETS, np.array([half]), np.float32(0.0))
    arrays = views.arrays._replace(pixels=np.concatenate([spline.ravel() for spline in splines]))
    found = profiles_around(arrays, surface, sampling, 1, visible)[0, 0]
    padded = np.pad(surface, half, mode="edge").astype(float)
    expected = np.empty_like(found)
    for b, d, rows, cols in stages.blocks():
        around = padded[rows.start : rows.stop + 2 * half, cols.start : cols.stop + 2 * half]
        nodes = views.nodes[:, b : b + 2, d : d + 2]
        for j, offset in enumerate(subpixel.LATER_OFFSETS):
            expected[j, rows, cols] = agreement.profile(
                stages.images,
                nodes,
                views.t_of_index,
                around,
                float(offset),
                views.block,
                half,
                visible.at(np.s_[:, rows, cols]),
            )
    np.testing.assert_allclose(found, expected, rtol=0, atol=NCC)
    assert found[1].mean() > 0.4
    peaks = parabola_peaks(found, subpixel.LATER_OFFSETS)
    left, middle, right = found.astype(float)
    bend = left - 2 * middle + right
    is_peak = (middle > left) & (middle > right)
    vertex = 0.5 * (left - right)[is_peak] / bend[is_peak] * (subpixel.LATER_OFFSETS[1] - subpixel.LATER_OFFSETS[0])
    assert peaks.is_inside[is_peak].all()
    np.testing.assert_allclose(peaks.position[is_peak], vertex, rtol=0, atol=10 * STEPS)
