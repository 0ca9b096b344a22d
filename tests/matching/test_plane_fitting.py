"""Planes through plain segments: their algebra, the views' agreement, and a sloped roof that was matched level."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from kernel_scene import at_all_heights, kernel_scene
from rendered_scenes import PART, rendered, run
from zlocus.core.options import PlaneOptions
from zlocus.matching import finest_level, tile
from zlocus.matching.kernels.plane_fitting import (
    SLOPE_SPAN_CELLS,
    disagreement,
    exclude_views,
    level_greys,
    plane_heights,
    plane_through,
    segment_greys,
    segment_loci,
    solve_damped,
)
from zlocus.matching.kernels.resample import block_grid, coordinate
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.local_contrast import deviation
from zlocus.matching.plane_fitting import PlanarHeights, plain_segments, share_below, with_planes
from zlocus.matching.tile_views import TileViews
from zlocus.matching.true_ortho import ortho_image

SIDE, BLOCK, MARGIN_PX = 96, 32, 40
# Pixels that a point moves per step in each view.
PARALLAX = (0.0, 0.5, -0.5, 0.35)
ROOF = slice(30, 66)
EAVES, RISE = 10.0, 0.08  # steps, and steps per row
ROOF_GREY, BLUR_PX, NOISE = 4.0, 0.6, 0.02
FAINT, BOW = 0.4, 4.0
OPTIONS = PlaneOptions()
STEPS = 0.25


def roof_heights(bow: float = 0.0) -> np.ndarray:
    """Of the rows of the roof; bow : steps from its middle to its ends, beside the plane."""
    row = np.arange(ROOF.stop - ROOF.start)
    return EAVES + RISE * row + bow * (2 * row / row[-1] - 1) ** 2


def true_heights(bow: float = 0.0) -> np.ndarray:
    height = np.zeros((SIDE, SIDE), np.float32)
    height[ROOF, ROOF] = roof_heights(bow)[:, None]
    return height


def shown(parallax: float, seed: int, roof_texture: float = 0.0, bow: float = 0.0) -> np.ndarray:
    """What a view shows: a textured level ground, and the roof where its rows are moved by their parallax."""
    rng = np.random.default_rng(7)
    ground = gaussian_filter(rng.normal(size=(SIDE + 2 * MARGIN_PX,) * 2), 1.0) * 5
    paint = gaussian_filter(rng.normal(size=(SIDE + 2 * MARGIN_PX,) * 2), 1.0) * 5 * roof_texture
    fine = 8
    image = np.repeat(ground, fine, axis=1)
    for row, height in zip(range(ROOF.start, ROOF.stop), roof_heights(bow), strict=True):
        away = parallax * height
        first = round((ROOF.start - 0.5 + away + MARGIN_PX + 0.5) * fine)
        width = (ROOF.stop - ROOF.start) * fine
        cells = paint[row + MARGIN_PX, ROOF.start : ROOF.stop].repeat(fine)
        image[row + MARGIN_PX, first : first + width] = ROOF_GREY + cells
    image = image.reshape(image.shape[0], -1, fine).mean(axis=2)
    return gaussian_filter(image, BLUR_PX) + np.random.default_rng(seed).normal(0, NOISE, image.shape)


def views(parallax=PARALLAX, roof_texture=0.0, bow=0.0) -> TileViews:
    images = [shown(a, i, roof_texture, bow).astype(np.float32) for i, a in enumerate(parallax)]
    n_nodes = SIDE // BLOCK + 1
    nodes = np.zeros((len(parallax), n_nodes, n_nodes, 2, 3))
    nodes[..., 0, 0] = BLOCK * np.arange(n_nodes)[None, None, :] + MARGIN_PX
    nodes[..., 1, 0] = BLOCK * np.arange(n_nodes)[None, :, None] + MARGIN_PX
    nodes[..., 0, 1] = np.array(parallax)[:, None, None]
    size, rows = images[0].size, images[0].shape[0]
    layout = np.array([(i * size, rows, rows) for i in range(len(parallax))])
    pixels = np.concatenate([image.ravel() for image in images])
    held = np.ones((len(parallax), n_nodes - 1, n_nodes - 1), bool)
    return TileViews(
        pixels, np.zeros(len(pixels), bool), np.zeros(len(parallax), bool), layout, nodes,
        np.empty((*held.shape, 2, 2, 0)), held, ~held, np.array([0.0, 1.0]), at_all_heights(held), BLOCK,
    )  # fmt: skip


def leading(seen_by: TileViews) -> np.ndarray:
    """The ortho-image of the first view, which parallax does not move."""
    _, rows, cols = seen_by.layout[0]
    image = seen_by.pixels[: rows * cols].reshape(rows, cols)
    return np.ascontiguousarray(image[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX])


def fitted(seen_by: TileViews, height: np.ndarray, options: PlaneOptions = OPTIONS) -> PlanarHeights:
    n = len(seen_by.layout)
    visible = VisibleHeights(*(np.full((n, SIDE, SIDE), index, np.int32) for index in (0, 100, -100)))
    known = PlanarHeights(height, np.zeros(height.shape, bool))
    return with_planes(seen_by, leading(seen_by), known, visible, options)


def level_roof() -> np.ndarray:
    """The semi-global answer: the roof at the height of its middle."""
    height = true_heights()
    height[ROOF, ROOF] = height[ROOF, ROOF].mean()
    return height


def test_a_roof_without_texture_gets_its_slope_from_its_outline():
    found, truth = fitted(views(), level_roof()), true_heights()
    inside = np.s_[ROOF.start + 2 : ROOF.stop - 2, ROOF.start + 2 : ROOF.stop - 2]
    assert found.is_planar[inside].all()
    before, after = (np.abs(h - truth)[inside].max() for h in (level_roof(), found.height))
    assert before > 4 * STEPS
    assert after < STEPS


def test_textured_ground_stays_as_it_is():
    found, before = fitted(views(), level_roof()), level_roof()
    ground = np.ones((SIDE, SIDE), bool)
    ground[ROOF.start - 2 : ROOF.stop + 2, ROOF.start - 2 : ROOF.stop + 2] = False
    assert not found.is_planar[ground].any()
    np.testing.assert_array_equal(found.height[ground], before[ground])


def test_a_view_of_another_day_is_excluded():
    other = views((*PARALLAX, 0.2))
    start, rows, cols = other.layout[-1]
    other.pixels[start:] = np.random.default_rng(5).normal(0, 3, rows * cols)
    found = fitted(other, level_roof())
    middle = np.s_[ROOF.start + 3 : ROOF.stop - 3, ROOF.start + 3 : ROOF.stop - 3]
    assert np.abs(found.height - true_heights())[middle].max() < STEPS


def test_two_of_eight_views_may_be_of_other_days():
    other = views((*PARALLAX, 0.2, -0.3, 0.1, -0.2))
    start, rows, cols = other.layout[-2]
    other.pixels[start:] = np.random.default_rng(5).normal(0, 3, 2 * rows * cols)
    found = fitted(other, level_roof())
    middle = np.s_[ROOF.start + 3 : ROOF.stop - 3, ROOF.start + 3 : ROOF.stop - 3]
    assert found.is_planar[middle].all()
    assert np.abs(found.height - true_heights())[middle].max() < STEPS


@pytest.mark.parametrize("brighter", [-1.5, 1.5])
def test_a_roof_may_be_brighter_from_one_side(brighter):
    """No sensor, and no side of a roof, shows the grey of another."""
    other = views()
    start, rows, cols = other.layout[1]
    other.pixels[start : start + rows * cols] += brighter
    found = fitted(other, level_roof())
    middle = np.s_[ROOF.start + 3 : ROOF.stop - 3, ROOF.start + 3 : ROOF.stop - 3]
    assert found.is_planar[middle].all()
    assert np.abs(found.height - true_heights())[middle].max() < STEPS


def test_greys_are_levelled_over_the_core():
    rng = np.random.default_rng(3)
    grey, visible, is_core = rng.normal(size=(4, 60)), rng.random((4, 60)) < 0.8, rng.random(60) < 0.7
    visible[3, is_core] = False
    expected = grey.copy()
    for i in range(3):
        seen = visible[i] & is_core & (visible.sum(axis=0) >= 2)
        middle = [np.median(grey[visible[:, p], p]) for p in np.flatnonzero(seen)]
        expected[i] -= (grey[i, seen] - middle).mean()
    level_greys(grey, visible, is_core)
    np.testing.assert_allclose(grey, expected, rtol=0, atol=1e-12)


def test_no_plane_where_fewer_than_two_views_see():
    seen_by = views()
    shape = (len(PARALLAX), SIDE, SIDE)
    visible = VisibleHeights(*(np.full(shape, index, np.int32) for index in (-100, 100, -100)))
    visible.highest_covered[1:, :, 48:] = -200
    known = PlanarHeights(level_roof(), np.zeros((SIDE, SIDE), bool))
    found = with_planes(seen_by, leading(seen_by), known, visible, OPTIONS)
    assert found.is_planar[35:60, 35:45].all()
    assert not found.is_planar[:, 48:].any()


def test_a_view_whose_table_does_not_hold_everywhere():
    """Neither its missing grey values nor its missing positions spoil what the others show."""
    seen_by = views()
    seen_by.nodes[0, :2, :2] = np.nan
    shape = (len(PARALLAX), SIDE, SIDE)
    visible = VisibleHeights(*(np.full(shape, index, np.int32) for index in (-100, 100, -100)))
    visible.highest_covered[0, : 2 * BLOCK, : 2 * BLOCK] = -200
    ortho = leading(seen_by)
    ortho[: BLOCK - 8, : BLOCK - 8] = np.nan
    found = with_planes(seen_by, ortho, PlanarHeights(level_roof(), np.zeros((SIDE, SIDE), bool)), visible, OPTIONS)
    middle = np.s_[ROOF.start + 3 : ROOF.stop - 3, ROOF.start + 3 : ROOF.stop - 3]
    assert found.is_planar[middle].all()
    assert np.abs(found.height - true_heights())[middle].max() < STEPS


def test_no_plane_where_most_heights_were_matched_elsewhere():
    """Half the roof far from any plane that the views could agree on."""
    height = level_roof()
    height[ROOF, ROOF] += np.random.default_rng(1).uniform(-12, 12, height[ROOF, ROOF].shape).astype(np.float32)
    found = fitted(views(), height)
    assert not found.is_planar.any()
    np.testing.assert_array_equal(found.height, height)


@pytest.mark.parametrize(("bow", "is_flat"), [(0.0, True), (BOW, False)])
def test_no_plane_where_the_views_agree_better_on_what_was_matched(bow, is_flat):
    """A faint texture, on a roof that is bowed by less than what a height may lie beside a plane."""
    height, seen_by = true_heights(bow), views(roof_texture=FAINT, bow=bow)
    found = fitted(seen_by, height, replace(OPTIONS, texture=0.8))
    middle = np.s_[ROOF.start + 3 : ROOF.stop - 3, ROOF.start + 3 : ROOF.stop - 3]
    assert found.is_planar[middle].mean() > 0.9 if is_flat else not found.is_planar[middle].any()
    any_cost = replace(OPTIONS, texture=0.8, max_cost_increase=10.0)
    assert fitted(seen_by, height, any_cost).is_planar[middle].any()


@pytest.mark.parametrize(("around", "is_roof"), [(2.0, True), (EAVES - 1.0, False), (2 * EAVES, False)])
def test_no_plane_where_a_segment_does_not_stand_above_its_surroundings(around, is_roof):
    """A field is as plain as a roof, and the bottom of a pit is too. around : steps, height of the surroundings."""
    height = level_roof()
    is_beside = np.ones((SIDE, SIDE), bool)
    is_beside[ROOF, ROOF] = False
    height[is_beside] = around
    assert fitted(views(), height).is_planar.any() == is_roof
    assert fitted(views(), height, replace(OPTIONS, min_share_below=0.0)).is_planar.any()


def test_share_of_the_surroundings_that_lie_below_a_plane():
    plain = np.zeros((40, 50), bool)
    plain[10:20, 10:20], plain[28:38, 35:45] = True, True
    segments = plain_segments(plain, replace(OPTIONS, min_cells=50))
    row = np.indices(plain.shape)[0]
    slope = SLOPE_SPAN_CELLS * 0.5
    # Both planes rise by half a step per row; the cells to the right of the middle of the first one lie far below it.
    height = (20.0 + 0.5 * (row - 14.5)).astype(np.float32)
    height[:, 15:] -= 8.0
    planes = np.array([[20.0, slope, 0.0], [20.0 + 0.5 * 18, slope, 0.0]])
    both = np.ones(2, bool)
    assert share_below(segments, planes, height, both).tolist() == [0.5, 1.0]
    assert share_below(segments, planes, height, np.array([False, True])).tolist() == [1.0]
    assert share_below(segments, planes, height, ~both).size == 0
    assert share_below(segments, planes, height + 8, both).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("changed", [{"texture": 0.0}, {"min_cells": 5000}, {"max_slope_steps": 0.01}])
def test_options_that_leave_no_plane(changed):
    assert not fitted(views(), level_roof(), replace(OPTIONS, **changed)).is_planar.any()


def test_segments_and_their_rims():
    plain = np.zeros((40, 50), bool)
    plain[5:15, 5:15], plain[20:24, 20:24], plain[30:38, 40:50] = True, True, True
    found = plain_segments(plain, replace(OPTIONS, min_cells=50, max_cells=90))
    assert found.start.tolist() == [0, 110]
    assert found.is_core.sum() == 80
    assert set(found.row[~found.is_core]) <= set(range(29, 39))
    assert (found.of_cell == 0).all()
    both = plain_segments(plain, replace(OPTIONS, min_cells=50))
    assert np.bincount(both.of_cell, both.is_core).tolist() == [100, 80]
    assert np.bincount(both.of_cell).tolist() == [144, 10 * 11]
    assert plain_segments(np.zeros((9, 9), bool), OPTIONS).start.tolist() == [0]


def test_segments_of_each_view_are_found_on_the_heights_so_far(monkeypatch, tmp_path):
    """Planes of the view before change them."""
    looked_at = []

    def raised(views, ortho, known, visible, options, core):
        same = [view for view in range(3) if np.array_equal(ortho, ortho_image(views, known.height, view))]
        looked_at.append((same, float(known.height.mean())))
        return PlanarHeights(known.height + 1, known.is_planar)

    monkeypatch.setattr(finest_level, "with_planes", raised)
    images = rendered(tmp_path, "sine").inputs[:3]
    run(images, tmp_path / "out", bounds=PART, report=False)
    assert [len(same) for same, _ in looked_at] == [1, 1]
    assert looked_at[0][0] != looked_at[1][0]
    assert looked_at[1][1] == pytest.approx(looked_at[0][1] + 1)


def test_deviation_of_a_window():
    grey = np.random.default_rng(2).normal(size=(20, 20)).astype(np.float32)
    np.testing.assert_allclose(deviation(grey, (3, 3))[7, 9], grey[6:9, 8:11].std(), rtol=0, atol=1e-5)


def test_normal_equations_are_solved():
    rng = np.random.default_rng(3)
    a = rng.normal(size=(9, 3))
    normal, right, out = a.T @ a, rng.normal(size=3), np.empty(3)
    solve_damped(normal, right, 0.0, out)
    np.testing.assert_allclose(out, np.linalg.solve(normal, right), rtol=1e-6)
    solve_damped(normal, right, 0.5, out)
    damped = normal + np.eye(3) * 0.5 * np.trace(normal) / 3
    np.testing.assert_allclose(out, np.linalg.solve(damped, right), rtol=1e-6)


def test_the_first_plane_passes_by_a_few_wrong_heights():
    row, col = (v.ravel() for v in np.indices((20, 30)))
    middle, plane, out = np.array([row.mean(), col.mean()]), np.empty(3), np.empty(row.size)
    true = np.array([40.0, 1.5, -0.7])
    plane_heights(row, col, middle, true, out)
    np.testing.assert_allclose(out[0], 40 - 9.5 / SLOPE_SPAN_CELLS * 1.5 + 14.5 / SLOPE_SPAN_CELLS * 0.7)
    wrong = out.copy()
    wrong[::6] += 25.0
    plane_through(row, col, middle, wrong, np.empty(row.size), np.empty(row.size), plane)
    np.testing.assert_allclose(plane, true, rtol=0, atol=0.1)


def test_greys_and_their_slopes():
    """The slope is the change of the grey per step; positions are those of the table."""
    seen_by, n = views(), 50
    rng = np.random.default_rng(4)
    row, col = rng.integers(0, SIDE, (2, n))
    start, asked = rng.uniform(0, 20, (2, n))
    locus = np.empty((len(PARALLAX), n, 4))
    segment_loci(seen_by.arrays, row, col, start, locus)
    np.testing.assert_allclose(locus[1, :, 0], col + MARGIN_PX + 0.5 * start)
    np.testing.assert_allclose(locus[2, :, 1:], np.column_stack([row + MARGIN_PX, np.full(n, -0.5), np.zeros(n)]))
    grey, slope, near, _ = np.empty((4, len(PARALLAX), n))
    segment_greys(seen_by.pixels, seen_by.layout, locus, start, asked, grey, slope)
    segment_greys(seen_by.pixels, seen_by.layout, locus, start, asked + 1e-4, near, np.empty_like(slope))
    crosses = np.floor(locus[:, :, 0] + (asked - start) * locus[:, :, 2]) != np.floor(
        locus[:, :, 0] + (asked + 1e-4 - start) * locus[:, :, 2]
    )
    np.testing.assert_allclose(np.where(crosses, 0, (near - grey) / 1e-4 - slope), 0, rtol=0, atol=1e-3)
    np.testing.assert_allclose(grey[0], seen_by.pixels[(row + MARGIN_PX) * seen_by.layout[0, 2] + col + MARGIN_PX])


def test_loci_of_bent_blocks_are_those_of_their_grids():
    scene = kernel_scene(is_bent=True)
    rng = np.random.default_rng(5)
    row, col = (rng.integers(0, side, 60) for side in scene.shape)
    start, step = rng.uniform(0, 20, 60), 1e-4
    locus = np.empty((scene.n_views, 60, 4))
    segment_loci(scene.arrays, row, col, start, locus)
    for view, n in np.ndindex(scene.n_views, 60):
        b, d = row[n] // scene.block, col[n] // scene.block
        places = []
        for height in (start[n], start[n] + step):
            grid = block_grid(scene.of_block(b, d), view, scene.heights[0] + height * scene.heights[1], 0)
            places.append([coordinate(axis, row[n] - b * scene.block, col[n] - d * scene.block) for axis in grid])
        np.testing.assert_allclose(locus[view, n, :2], places[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(locus[view, n, 2:], np.diff(places, axis=0)[0] / step, rtol=0, atol=1e-4)


def slow_disagreement(grey, slope, visible, is_core, noise):
    q = np.where(visible, grey - np.nanmedian(np.where(visible, grey, np.nan), axis=0), np.nan)
    s = np.where(visible, slope - np.nanmean(np.where(visible, slope, np.nan), axis=0), np.nan)
    enough = visible.sum(axis=0) >= 2
    size = np.abs(q) / noise
    w = np.where(size < 1, 1, 1 / np.maximum(size, 1e-12))
    loss = np.where(enough, np.where(size < 1, 0.5 * size**2, size - 0.5), np.nan)
    weight, value = (np.where(enough, np.nansum(v, axis=0), 0) for v in (w * s * s, -w * s * q))
    return weight, value, np.column_stack([np.nanmean(loss, axis=1), np.nanmean(loss[:, is_core], axis=1)])


def test_segments_are_not_looked_for_in_views_that_disagree_with_the_others(monkeypatch, tmp_path):
    """Haze hides the ridge of a roof, so that its two pitches seem to be one segment."""
    looked_in = []

    def seen(views, ortho, known, visible, options, core):
        looked_in.extend(v for v in range(3) if np.array_equal(ortho, ortho_image(views, known.height, v)))
        return known

    monkeypatch.setattr(finest_level, "with_planes", seen)
    monkeypatch.setattr(tile, "view_agreement", lambda *_: np.array([0.5, 1.0, 0.9]))
    images = rendered(tmp_path, "sine").inputs[:3]
    run(images, tmp_path / "out", bounds=PART, report=False)
    assert looked_in == [1, 2]


def test_disagreement_equals_its_slow_twin():
    rng = np.random.default_rng(6)
    grey, slope = rng.normal(size=(2, 5, 200))
    visible, is_core = rng.random((5, 200)) < 0.5, rng.random(200) < 0.6
    visible[0] = True
    weight, value, cost = np.empty(200), np.empty(200), np.empty((5, 2))
    disagreement(grey, slope, visible, is_core, 0.4, weight, value, cost)
    for found, expected in zip(
        (weight, value, cost), slow_disagreement(grey, slope, visible, is_core, 0.4), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    visible[3] = False
    disagreement(grey, slope, visible, is_core, 0.4, weight, value, cost)
    assert np.isinf(cost[3]).all()


@pytest.mark.parametrize(
    ("costs", "left"),
    [
        ((0.1,) * 5, 5), ((0.1,) * 4 + (9.0,), 4), ((0.1,) * 3 + (9.0,) * 2, 0), ((0.1, 0.1, 9.0), 0),
        ((0.1,) * 4 + (9.0, np.inf), 4), ((0.1,) * 3 + (9.0, np.inf), 3), ((0.1,) * 4 + (9.0,) * 2, 0),
    ],
)  # fmt: skip
def test_one_view_in_four_may_be_excluded(costs, left):
    visible = np.ones((len(costs), 4), bool)
    assert exclude_views(visible, np.repeat(np.array(costs)[:, None], 2, axis=1), 0.2) == left
    assert (~visible).any(axis=1).tolist() == [cost == 9.0 for cost in costs]
