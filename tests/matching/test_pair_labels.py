"""Labels of pairs of views at tie points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kernel_scene import at_all_heights, kernel_scene
from textured_views import LEVEL_STEPS, SHAPE, SHORT, SIDE, STEEP, STEPS_PER_CELL, WINDOW, textured, ties
from zlocus.core.grid import CellWindow
from zlocus.matching.match_curve import GOOD, POOR
from zlocus.matching.pair_labels import GridTies, label_pairs
from zlocus.matching.tile_views import TileViews


def ranked(views, xy, index, slope=(0.0, 0.0), window=WINDOW, options=SHORT):
    return label_pairs(views, window, GridTies(xy, index, np.tile(slope, (len(xy), 1))), SIDE, STEPS_PER_CELL, options)


def test_labels_of_views_that_show_the_same_and_of_one_that_does_not():
    found = ranked(textured(spoiled=(2,)), *ties(200), options=replace(SHORT, feature_cells=4))
    labels = found.labels
    assert labels.dtype == np.int8
    assert labels.shape == (len(found.xy), 4, 4)
    np.testing.assert_array_equal(labels, labels.swapaxes(1, 2))
    assert (np.diagonal(labels, axis1=1, axis2=2) == POOR).all()
    for i, j in ((0, 1), (0, 3)):  # 1 and 3 have hardly a base
        assert (labels[:, i, j] == GOOD).mean() > 0.9
    for i in (0, 1, 3):
        assert (labels[:, i, 2] == GOOD).mean() < 0.4  # by chance, over so short a range
    assert found.evaluations == len(found.xy) * 4 * 33


def test_labels_of_a_kernel_scene_are_symmetric_and_poor_with_itself():
    """Curved projections and images that have nothing in common."""
    scene = kernel_scene()
    holds = np.ones((scene.n_views, *np.subtract(scene.nodes.shape[1:3], 1)), bool)
    views = TileViews(scene.pixels, np.zeros(len(scene.pixels), bool), np.zeros(3, bool), scene.layout, scene.nodes,
                      scene.bends, holds, ~holds, scene.heights, at_all_heights(holds), scene.block)  # fmt: skip
    rng = np.random.default_rng(2)
    xy = rng.uniform((0, 0), (scene.shape[1], scene.shape[0]), (50, 2))
    window = CellWindow(0, 0, *scene.shape)
    index, flat = rng.uniform(5, 15, 50), np.zeros((50, 2))
    found = label_pairs(views, window, GridTies(xy, index, flat), SIDE, STEPS_PER_CELL, SHORT)
    np.testing.assert_array_equal(found.labels, found.labels.swapaxes(1, 2))
    assert (np.diagonal(found.labels, axis1=1, axis2=2) == POOR).all()
    assert (found.labels == GOOD).mean() < 0.1


def test_one_point_counts_per_square():
    xy, index = ties(200)
    found = ranked(textured(), xy, index)
    squares = {tuple(square) for square in (np.floor(xy / SHORT.feature_cells)).astype(int).tolist()}
    assert len(found.xy) == len(squares) < 30
    kept = {tuple(square) for square in (np.floor(found.xy / SHORT.feature_cells)).astype(int).tolist()}
    assert kept == squares
    np.testing.assert_array_equal(found.xy, xy[found.tie])
    assert len(ranked(textured(), xy, index, options=replace(SHORT, feature_cells=1000)).xy) == 1


def test_points_outside_the_window_and_without_a_height_are_left_out():
    views, window = textured(), CellWindow(-100, 50, *SHAPE)
    inside = np.array([[50.0, -100.0], [50.0 + SHAPE[1] - 0.01, -100.0 + SHAPE[0] - 0.01], [70.0, -80.0]])
    outside = np.array([[49.99, -90.0], [60.0, -100.01], [50.0 + SHAPE[1], -90.0], [60.0, -100.0 + SHAPE[0]]])
    xy = np.concatenate([outside, inside])
    found = ranked(views, xy, np.full(7, LEVEL_STEPS), window=window)
    assert sorted(found.xy.tolist()) == sorted(inside.tolist())
    index = np.full(7, LEVEL_STEPS)
    index[-1] = np.nan
    assert sorted(ranked(views, xy, index, window=window).xy.tolist()) == sorted(inside[:-1].tolist())
    none = ranked(views, outside, np.full(4, LEVEL_STEPS), window=window)
    assert none.labels.shape == (0, 4, 4)
    assert none.evaluations == 0


def test_a_window_elsewhere_gives_the_same_labels():
    xy, index = ties()
    moved = ranked(textured(spoiled=(1,)), xy + np.array([48.0, -96.0]), index, window=CellWindow(-96, 48, *SHAPE))
    np.testing.assert_array_equal(moved.labels, ranked(textured(spoiled=(1,)), xy, index).labels)


def test_windows_along_a_slope_agree_where_level_ones_do_not():
    views, (xy, index) = textured(slope=STEEP), ties(200, slope=STEEP)
    dense = replace(SHORT, feature_cells=4)
    sloped, level, wrong = (ranked(views, xy, index, slope, options=dense) for slope in (STEEP, (0, 0), STEEP[::-1]))
    for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (2, 3)):  # 1 and 3 have hardly a base
        assert (sloped.labels[:, i, j] == GOOD).mean() > 0.9
    for other in (level, wrong):
        assert (other.labels[:, 2, 3] == GOOD).mean() < 0.5
