"""Stereo selection of Ji et al. (2014): single cells against plain loops and true heights, in both spaces."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from reference import selection as plain
from rendered_scenes import CENTRE, GSD_M, HEIGHTS, UTM
from zlocus.core.grid import CellWindow
from zlocus.core.height_range import HeightRange
from zlocus.core.options import PyramidOptions, RunConfig, SelectionOptions, large_window_side
from zlocus.io.scene_file import open_scene
from zlocus.matching.image_space import ImageSpace, build_image_match_scene, height_space, hypotheses_of_heights
from zlocus.matching.locus_windows import CurveSamples
from zlocus.matching.match_curve import GOOD, ProgressiveMatch, curve_labels, curve_peaks
from zlocus.matching.match_scene import MatchScene, build_match_scene
from zlocus.matching.pair_labels import GridTies
from zlocus.matching.quality import Quality, is_empty
from zlocus.matching.selected_surface import match_tile_of_paper, quality_of
from zlocus.matching.stereo_selection import (
    SelectedMatch,
    all_cells,
    cell_middles,
    feature_curves,
    feature_points,
    initial_heights,
    match_cells,
    options_of_paper,
    point_curves_of_paper,
    selection_area,
)
from zlocus.synthetic.terrain import analytic_height

KIND = "sine"
# The radius is small, so that the cells have different feature points, and some of them none.
CONFIG = RunConfig(selection=SelectionOptions(radius_px=8.0, nearest=2, max_radii=3.0))
N_FEATURES = 40
# A step of heights is about half a pixel of parallax; the height of a cell is that of a step.
WITHIN_M, LEAST_WITHIN = 0.6, 0.97
ROUNDING = 1e-6


def truth(xy: np.ndarray) -> np.ndarray:
    return analytic_height(KIND, xy[:, 0] - CENTRE[0], xy[:, 1] - CENTRE[1])


@dataclass(frozen=True)
class Space:
    """A match scene and what its cells mean. window : cells that all views see."""

    match_scene: MatchScene
    image_space: ImageSpace | None
    window: CellWindow

    def errors(self, cells: np.ndarray, lattice_index: np.ndarray) -> np.ndarray:
        """Found less true heights (n,) m. cells : row and column in the window."""
        col, row = cell_middles(cells, self.window).T
        match_scene = self.match_scene
        z = match_scene.height_origin + lattice_index * match_scene.height_step
        x, y = match_scene.anchor[0] + col * match_scene.cell_size, match_scene.anchor[1] - row * match_scene.cell_size
        if self.image_space is None:
            return z - truth(np.column_stack([x, y]))
        ground = self.image_space.rays.ground(np.column_stack([x, -y]), z)
        return ground[:, 2] - truth(ground[:, :2])


@pytest.fixture(scope="module", params=["ground", "image"])
def space(request, images) -> Space:
    """The analytic ground, whose feature points are exact."""
    scene = open_scene(images(KIND).inputs, UTM)
    rng = np.random.default_rng(11)
    xy = np.array(CENTRE) + rng.uniform(-24.0, 24.0, (N_FEATURES, 2))
    features = np.column_stack([xy, truth(xy)])
    ground = build_match_scene(
        scene, GSD_M, (0.0, 0.0), HeightRange.limited_to(HEIGHTS), features, "nadir", PyramidOptions()
    )
    if request.param == "ground":
        row, col = (int(-CENTRE[1] / GSD_M) - 25, int(CENTRE[0] / GSD_M) - 25)
        return Space(ground, None, CellWindow(row, col, 50, 50))
    along_rays = height_space(scene, "nadir", HEIGHTS)
    z_range = hypotheses_of_heights(along_rays, HEIGHTS)
    match_scene = build_image_match_scene(along_rays, z_range, along_rays.frame_from_ground(features), PyramidOptions())
    return Space(match_scene, along_rays, CellWindow(50, 50, 50, 50))


@pytest.fixture(scope="module")
def area(space):
    found = selection_area(space.match_scene, space.window, CONFIG)
    assert found is not None
    return found


def some_cells(n: int) -> np.ndarray:
    return np.random.default_rng(2).integers(0, 50, (n, 2)).astype(np.int64)


def ncc_of(area, cell, initial) -> np.ndarray:
    """NCC of the reference with every search image at one cell of the window, (i, h), window by window."""
    side, reach = large_window_side(CONFIG.cost), CONFIG.selection.reach_steps
    samples = CurveSamples(
        cell[None], np.array([initial - reach]), 2 * reach + 1, np.zeros((1, side * side), np.float32)
    )
    windows = [samples.windows(area.tile_views, view, slice(None))[0] for view in range(len(area.view_numbers))]
    curves = []
    for view in area.search:
        of_heights = zip(windows[0], windows[view], strict=True)
        curves.append([float(np.dot(a.astype(float), b.astype(float))) for a, b in of_heights])
    return np.array(curves)


def test_every_cell_is_matched_as_in_plain_loops(area):
    """Labels, order, mean and stop of single cells, one image after the other (section 3.3)."""
    options = options_of_paper(CONFIG.selection)
    cells = some_cells(30)
    match = match_cells(area, cells, CONFIG)
    middle = cell_middles(cells, area.window)
    features = area.features.xy.tolist()
    in_window = np.floor(area.features.xy[:, ::-1]).astype(np.int64) - (area.window.row, area.window.col)
    step_px = area.step_px[1:].tolist()
    labels = [
        [plain.label(curve, px, options) for curve, px in zip(ncc_of(area, cell, z), step_px, strict=True)]
        for cell, z in zip(in_window, area.ties.lattice_index[area.numbers], strict=True)
    ]
    assert area.features.labels.tolist() == labels
    sources = set()
    for n, cell in enumerate(cells):
        initial = area.initial[tuple(cell)]
        source, neighbours = plain.radius_neighbours(features, middle[n], options)
        sources.add(source)
        order = plain.order(labels, neighbours if source < 2 else range(len(labels)), options)
        ncc = ncc_of(area, cell, initial).tolist()
        curve, used, is_stopped = plain.matched(ncc, order, [True] * len(ncc), step_px, options)
        progressive = match.progressive_match
        assert progressive.n_images[n] == len(used)
        assert progressive.is_stopped[n] == is_stopped
        np.testing.assert_allclose(progressive.mean_ncc[n], curve, rtol=0, atol=ROUNDING)
        assert match.lattice_index(options.reach_steps)[n] == initial - options.reach_steps + int(np.nanargmax(curve))
    assert sources >= {0, 1}


def test_a_point_and_a_tile_find_the_same(area):
    cells = some_cells(20)
    match = match_cells(area, cells, CONFIG)
    for n, (row, col) in enumerate(cells.tolist()):
        cell = area.window.row + row, area.window.col + col
        curves = point_curves_of_paper(area, cell, area.initial[row, col], CONFIG)
        assert curves.is_stopped == match.progressive_match.is_stopped[n]
        assert curves.n_used == match.progressive_match.n_images[n]
        np.testing.assert_allclose(
            curves.mean_curves.values[curves.n_used - 1], match.progressive_match.mean_ncc[n], rtol=0, atol=ROUNDING
        )
        assert curves.mean_curves.peaks.peak[curves.n_used - 1] == match.peaks.peak[n]


def test_the_curves_of_a_feature_point_have_the_labels_that_order_the_images(area):
    for feature in range(len(area.features.xy)):
        curves = feature_curves(area, feature, CONFIG)
        assert curves.single_curves.labels.tolist() == area.features.labels[feature].tolist()
        assert curves.order.search.tolist() == [1, 2]


def test_heights_are_true_where_curves_are_distinct(space, area):
    cells = all_cells(space.window)
    match = match_cells(area, cells, CONFIG)
    error = space.errors(cells, match.lattice_index(CONFIG.selection.reach_steps))
    distinct = match.progressive_match.label == GOOD
    assert distinct.mean() > 0.5
    assert (np.abs(error[distinct]) < WITHIN_M).mean() > LEAST_WITHIN
    assert (match.progressive_match.n_images[distinct] < 2).any(), "some cells need a single search image"


def test_initial_heights_are_those_of_the_triangle_or_of_the_nearest_point(space):
    ties = feature_points(space.match_scene)
    xy = cell_middles(all_cells(space.window.at_level(0, 20)), space.window.at_level(0, 20))[::37]
    found = initial_heights(ties, xy)
    inside = LinearNDInterpolator(ties.xy - ties.xy[0], ties.lattice_index)(xy - ties.xy[0])
    nearest = [min(range(len(ties.xy)), key=lambda k: math.dist(ties.xy[k], at)) for at in xy]
    expected = np.where(np.isfinite(inside), inside, ties.lattice_index[nearest])
    assert np.isnan(inside).any()
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_two_feature_points_give_the_height_of_the_nearer_one():
    ties = GridTies(np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([5.0, 7.0]), np.zeros((2, 2)))
    assert initial_heights(ties, np.array([[1.0, 3.0], [8.0, -2.0]])).tolist() == [5.0, 7.0]


def test_a_point_of_two_orientations_is_one_feature_point(space):
    ties = space.match_scene.ties
    again = ties[:5] + np.array([1e-3, 0.0, 0.1])
    twice = replace(space.match_scene, ties=np.concatenate([ties, again, [[0.0, 0.0, np.nan]]]))
    assert len(feature_points(twice).xy) == len(feature_points(space.match_scene).xy)


def test_a_tile_has_the_heights_of_its_cells(space):
    core = space.window.within(space.match_scene.overlap_window)
    surface = match_tile_of_paper(space.match_scene, core, core, CONFIG).surface
    known = ~is_empty(surface.quality)
    assert np.array_equal(np.isfinite(surface.height), known)
    assert np.array_equal(np.isfinite(surface.ortho), known)
    assert np.array_equal(surface.views > 0, known)
    assert np.isnan(surface.sigma).all()
    match_scene = space.match_scene
    index = (surface.height - match_scene.height_origin) / match_scene.height_step
    error = space.errors(all_cells(core)[known.ravel()], index[known].astype(float))
    assert known.mean() > 0.8
    if space.image_space is not None:
        pixels = space.image_space.reference_view.image.read(core.row, core.col, core.rows, core.cols).pixels
        np.testing.assert_allclose(surface.ortho[known], pixels[known], rtol=1e-5)
    assert (np.abs(error) < WITHIN_M).mean() > 0.9


def test_a_kept_cell_does_not_depend_on_the_others(space):
    core = space.window.within(space.match_scene.overlap_window)
    kept = CellWindow(core.row + 7, core.col + 11, 20, 15)
    whole, part = (match_tile_of_paper(space.match_scene, core, w, CONFIG).surface for w in (core, kept))
    for every, some in zip(whole.part(kept, core).arrays, part.part(kept, core).arrays, strict=True):
        np.testing.assert_array_equal(every, some)
    outside = np.ones(part.height.shape, bool)
    outside[kept.slices_in(core)] = False
    assert np.isnan(part.height[outside]).all()


def curve(*peaks: tuple[int, float], missing: tuple[int, ...] = ()) -> np.ndarray:
    """A curve of 21 heights with one-sample peaks (sample, value) on a floor of -0.5."""
    values = np.full(21, -0.5)
    for at, value in peaks:
        values[at] = value
    values[list(missing)] = np.nan
    return values


FLAGGED = [
    (curve((10, 0.95)), Quality(0)),
    (curve((10, 0.95), (16, 0.93)), Quality.AMBIGUOUS),
    (curve((10, 0.55)), Quality.WEAK),
    (curve((10, 0.4)), Quality.NO_MATCH),
    (curve((10, 0.55), (16, 0.53)), Quality.NO_MATCH),
    (curve((0, 0.95)), Quality.RANGE_END | Quality.AMBIGUOUS),
    (curve((20, 0.4)), Quality.RANGE_END | Quality.NO_MATCH),
    (curve((10, 0.95), missing=(11,)), Quality.RANGE_END | Quality.AMBIGUOUS),
    (curve(missing=tuple(range(21))), Quality.UNSEEN),
]


@pytest.mark.parametrize(("values", "flags"), FLAGGED)
def test_flags_say_why_a_cell_has_no_height_or_a_doubtful_one(values, flags):
    peaks, label = curve_peaks(values[None], 0.5, CONFIG.selection), curve_labels(values[None], 0.5, CONFIG.selection)
    one = np.ones(1, np.int64)
    match = SelectedMatch(np.zeros(1), ProgressiveMatch(values[None], one, label, label == GOOD, one, 1, 1), peaks)
    quality = quality_of(match, CONFIG.selection)
    assert Quality(int(quality[0])) == flags
    has_height = flags in (Quality(0), Quality.AMBIGUOUS, Quality.WEAK)
    assert is_empty(quality)[0] != has_height


def test_nothing_of_ours_takes_part():
    """Blocks, the sigma of the peak, the angle and the share of labels change nothing."""
    ours = SelectionOptions(
        order="angle", min_label_share=0.9, max_sigma_steps=0.01, stopped_share=0.3, min_images=5, max_images=5
    )
    assert options_of_paper(ours) == options_of_paper(SelectionOptions())


def test_a_window_that_the_reference_image_does_not_show_has_no_heights(space):
    window = replace(space.window, row=space.window.row + 100_000)
    assert selection_area(space.match_scene, window, CONFIG) is None
    result = match_tile_of_paper(space.match_scene, window, window, CONFIG)
    assert np.isnan(result.surface.height).all()
    assert (result.surface.quality == Quality.UNSEEN).all()


def test_a_scene_without_feature_points_has_no_heights(space):
    bare = replace(space.match_scene, ties=np.zeros((0, 3)))
    assert selection_area(bare, space.window, CONFIG) is None
