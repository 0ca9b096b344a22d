"""Which views a block is matched with: labels at tie points, reference and order, how many, and which cells decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.ndimage import gaussian_filter, map_coordinates

from kernel_scene import HIDDEN, at_all_heights, kernel_scene
from zlocus.core.grid import CellWindow
from zlocus.core.options import SelectionOptions
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.match_curve import FAIR, GOOD, POOR, predicted_sigma
from zlocus.matching.pair_labels import PairLabels, GridTies, label_pairs
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_selection import (
    CoarserCurves,
    ViewOrder,
    block_middles,
    block_of_cells,
    block_shares,
    chosen_views,
    images_needed,
    order_views,
    sampled_cells,
)

OPTIONS = SelectionOptions()
# A range that the images of `textured` hold.
SHORT = SelectionOptions(reach_steps=16, feature_cells=8)
SHAPE, BLOCK, SIDE, BORDER_PX = (40, 48), 16, 7, 20
# Pixels along columns that a cell moves per step: the first view looks straight down.
SPEEDS = (0.0, 0.5, -0.5, 0.7)
LEVEL_STEPS, STEEP, STEPS_PER_CELL = 30.0, (0.0, 0.9), 1.0


def textured(slope=(0.0, 0.0), spoiled=(), noise=0.0, speeds=SPEEDS):
    """Views of one texture on a plane, LEVEL_STEPS up in the middle; slope : steps a cell down and across.

    Those that are `spoiled` show another texture.
    """
    rng = np.random.default_rng(7)
    shape = (SHAPE[0] + 2 * BORDER_PX, SHAPE[1] + 2 * BORDER_PX)
    per_step = 0.02
    corners = (-(-SHAPE[0] // BLOCK) + 1, -(-SHAPE[1] // BLOCK) + 1)
    row, col = np.meshgrid(np.arange(corners[0]) * BLOCK, np.arange(corners[1]) * BLOCK, indexing="ij")
    y, x = np.indices(shape) - float(BORDER_PX)
    same = gaussian_filter(rng.normal(size=(300, 300)), 1.2) * 10
    images, nodes, layout = [], [], []
    for i, speed in enumerate(speeds):
        # A pixel sees the cell whose column, moved by the height there, is its own: x = c + speed height(r, c).
        at_zero = height_at(slope, y, 0.0) - LEVEL_STEPS
        across = (x - speed * at_zero) / (1 + speed * slope[1])
        other = gaussian_filter(rng.normal(size=(300, 300)), 1.2) * 10
        image = map_coordinates(other if i in spoiled else same, [y + 120, across + 120], order=3)
        images.append((image + noise * rng.normal(size=shape)).astype(np.float32))
        layout.append((i * shape[0] * shape[1], *shape))
        node = np.zeros((*corners, 2, 4))
        node[..., 0, 0], node[..., 0, 1] = col + BORDER_PX, speed / per_step
        node[..., 1, 0] = row + BORDER_PX
        nodes.append(node)
    pixels = np.concatenate([image.ravel() for image in images])
    heights = np.array([-LEVEL_STEPS * per_step, per_step])
    holds = np.ones((len(images), corners[0] - 1, corners[1] - 1), bool)
    return TileViews(
        pixels, np.zeros(len(pixels), bool), np.zeros(len(images), bool), np.array(layout, np.int64), np.stack(nodes),
        holds, ~holds, heights, at_all_heights(holds), BLOCK,
    )  # fmt: skip


def height_at(slope, row, col):
    """Steps of the plane."""
    return LEVEL_STEPS + slope[0] * (row - SHAPE[0] / 2) + slope[1] * (col - SHAPE[1] / 2)


def ties(n=60, slope=(0.0, 0.0), seed=1):
    """xy (n, 2) columns and rows, height indices (n,)."""
    xy = np.random.default_rng(seed).uniform((8.0, 8.0), (SHAPE[1] - 8.0, SHAPE[0] - 8.0), (n, 2))
    cell = np.floor(xy)
    return xy, height_at(slope, cell[:, 1], cell[:, 0])


WINDOW = CellWindow(0, 0, *SHAPE)


def ranked(views, xy, index, slope=(0.0, 0.0), window=WINDOW, options=SHORT):
    return label_pairs(views, window, GridTies(xy, index, np.tile(slope, (len(xy), 1))), SIDE, STEPS_PER_CELL, options)


# --- label_pairs ---


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
                      holds, ~holds, scene.heights, at_all_heights(holds), scene.block)  # fmt: skip
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


# --- order_views ---


def ranking_of(xy, labels, angle_deg=None):
    """labels : of one symmetric (i, i) for all points, or (n, i, i); angles are equal unless given."""
    xy = np.asarray(xy, float).reshape(-1, 2)
    labels = np.asarray(labels, np.int8)
    n_views = labels.shape[-1]
    angle_deg = 10.0 * (1 - np.eye(n_views)) if angle_deg is None else np.asarray(angle_deg, float)
    return PairLabels(np.arange(len(xy)), xy, np.broadcast_to(labels, (len(xy), n_views, n_views)).copy(), angle_deg)


def agreeing(n_views, *stranger):
    """Labels of views that agree but for some that agree with none."""
    labels = np.full((n_views, n_views), GOOD)
    labels[list(stranger)] = labels[:, list(stranger)] = POOR
    np.fill_diagonal(labels, POOR)
    return labels


AT, NEAR = np.array([[50.0, 50.0]]), [[40.0, 50.0], [60.0, 55.0]]


def test_the_reference_is_the_first_view_that_shows_the_whole_block():
    share = np.array([[0.9, 1.0, 1.0], [0.96, 1.0, 0.0], [1.0, 1.0, 1.0]])
    found = order_views(ranking_of(NEAR, agreeing(3)), share, AT.repeat(3, axis=0), OPTIONS)
    assert found.reference.tolist() == [1, 0, 0]
    assert [sorted(row) for row in found.search.tolist()] == [[0, 2], [1, 2], [1, 2]]
    assert found.is_helpful.all()


def test_a_view_that_agrees_with_none_is_not_the_reference_and_stands_last():
    found = order_views(ranking_of(NEAR, agreeing(4, 0)), np.ones((4, 1)), AT, OPTIONS)
    assert found.reference.tolist() == [1]
    assert found.search.tolist() == [[2, 3, 0]]
    assert found.is_helpful.tolist() == [[True, True, False]]


def test_without_any_agreement_the_view_that_shows_most_leads():
    share = np.array([[0.5], [0.8], [0.8]])
    found = order_views(ranking_of(NEAR, agreeing(3, 0, 1, 2)), share, AT, OPTIONS)
    assert found.reference.tolist() == [1]
    assert not found.is_helpful.any()
    found = order_views(ranking_of(NEAR, agreeing(3)), share, AT, OPTIONS)
    assert found.reference.tolist() == [1], "no view shows all of the block"
    assert found.is_helpful.all()


def test_views_below_a_share_of_the_best_mislead():
    """Accumulated over five points: 5, 3 and 2 with the reference."""
    labels = np.broadcast_to(agreeing(4), (5, 4, 4)).copy()
    labels[:2, 0, 2] = labels[:2, 2, 0] = FAIR
    labels[:3, 0, 3] = labels[:3, 3, 0] = FAIR
    xy = 50.0 + np.arange(10.0).reshape(5, 2)
    for least, expected in ((0.6, [True, True, False]), (0.61, [True, False, False]), (0.4, [True, True, True])):
        options = SelectionOptions(min_label_share=least)
        found = order_views(ranking_of(xy, labels), np.ones((4, 1)), AT, options)
        assert found.search.tolist() == [[1, 2, 3]]
        assert found.is_helpful.tolist() == [expected], least


def test_of_views_that_help_the_one_at_the_best_angle_comes_first():
    """Angles to the reference 4, 35, 18 and 20 degrees; the last misleads, the third has the lowest label of those that
    help."""
    labels = agreeing(5, 4)
    labels[0, 3] = labels[3, 0] = FAIR
    labels = np.stack([agreeing(5, 4), labels])
    angle = np.zeros((5, 5))
    angle[0], angle[:, 0] = [0, 4, 35, 18, 20], [0, 4, 35, 18, 20]
    for order, expected in (("angle", [3, 2, 1, 4]), ("labels", [1, 2, 3, 4])):
        options = SelectionOptions(order=order)
        found = order_views(ranking_of(NEAR, labels, angle), np.ones((5, 1)), AT, options)
        assert found.reference.tolist() == [0]
        assert found.search.tolist() == [expected], order
        assert found.is_helpful.tolist() == [[True, True, True, False]]


def test_blocks_have_the_order_of_the_points_around_them():
    labels = np.stack([agreeing(3, 0), agreeing(3, 2)])
    xy = np.array([[0.0, 0.0], [1000.0, 0.0]])
    found = order_views(ranking_of(xy, labels), np.ones((3, 2)), xy + 5.0, OPTIONS)
    assert found.reference.tolist() == [1, 0]
    assert found.search.tolist() == [[2, 0], [1, 2]]
    assert found.is_helpful.tolist() == [[True, False], [True, False]]


def test_far_from_all_points_the_whole_scene_says_which_view_misleads():
    """The first two agree with none in most of the scene; near the one point where they do, they lead."""
    labels = np.stack([agreeing(4, 0, 1), agreeing(4, 0, 1), agreeing(4, 0, 1), agreeing(4)])
    xy = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [5000.0, 0.0]])
    at = np.array([[2500.0, 2500.0], [5000.0, 5.0]])
    found = order_views(ranking_of(xy, labels), np.ones((4, 2)), at, OPTIONS)
    assert found.reference.tolist() == [2, 0]
    assert found.search[0].tolist() == [3, 0, 1]
    assert found.is_helpful.tolist() == [[True, False, False], [True, True, True]]


@pytest.mark.parametrize("xy", [np.zeros((0, 2)), np.full((3, 2), 1e5)], ids=["no point at all", "far points"])
def test_cells_of_plain_roofs_and_roads_that_no_feature_point_covers_still_get_an_order(xy):
    """A reference that shows them and every other view once, in the order of the scene."""
    at = np.array([[50.0, 50.0], [80.0, 20.0], [-300.0, 0.0]])
    share = np.array([[1.0, 0.2, 0.3], [1.0, 1.0, 0.4], [0.0, 1.0, 0.2]])
    found = order_views(ranking_of(xy, agreeing(3, 1)), share, at, OPTIONS)
    for b in range(3):
        assert share[found.reference[b], b] == share[:, b].max()
        assert sorted([int(found.reference[b]), *found.search[b].tolist()]) == [0, 1, 2]
    if len(xy):
        assert found.search[0].tolist() == [2, 1], "by the whole scene"
        assert found.is_helpful[0].tolist() == [True, False]
    else:
        assert found.is_helpful.all(), "nothing is known against any"


# --- chosen_views ---


def plainly_chosen(order, n_search, covered, of_cell, options):
    """View after view, cell after cell."""
    chosen = [set() for _ in order.reference]
    for b, reference in enumerate(order.reference.tolist()):
        chosen[b].add(reference)
        mine = np.flatnonzero(of_cell == b)
        for view, is_helpful in zip(order.search[b].tolist(), order.is_helpful[b].tolist(), strict=True):
            most = n_search[b] if is_helpful else min(n_search[b], options.min_images)
            if any(covered[view, c] and covered[list(chosen[b]), c].sum() < 1 + most for c in mine):
                chosen[b].add(view)
    return chosen


@st.composite
def choices(draw):
    """An order of up to six views over up to four blocks, those that mislead last; what covers what."""
    n_views, n_blocks, n_cells = draw(st.integers(2, 6)), draw(st.integers(1, 4)), draw(st.integers(0, 20))
    rows = [draw(st.permutations(range(n_views))) for _ in range(n_blocks)]
    n_worth = draw(arrays.arrays(np.int64, n_blocks, elements=st.integers(0, n_views - 1)))
    order = ViewOrder(
        np.array([row[0] for row in rows]), np.array([row[1:] for row in rows]),
        np.arange(n_views - 1) < n_worth[:, None],
    )  # fmt: skip
    n_search = draw(arrays.arrays(np.int64, n_blocks, elements=st.integers(0, n_views)))
    covered = draw(arrays.arrays(np.bool_, (n_views, n_cells)))
    of_cell = draw(arrays.arrays(np.int64, n_cells, elements=st.integers(0, n_blocks - 1)))
    return order, n_search, covered, of_cell, SelectionOptions(min_images=draw(st.integers(1, 4)))


@given(choices())
def test_every_cell_is_covered_by_as_many_views_as_asked_for_or_as_there_are(choice):
    """Those that mislead fill up to `min_images` beside the first, never beyond."""
    order, n_search, covered, of_cell, options = choice
    chosen = chosen_views(*choice)
    assert chosen.shape == (len(covered), len(order.reference))
    for c, b in enumerate(of_cell.tolist()):
        helpful = [int(order.reference[b]), *order.search[b][order.is_helpful[b]].tolist()]
        covering = covered[chosen[:, b], c].sum()
        assert covering >= min(1 + n_search[b], covered[helpful, c].sum())
        assert covering >= min(1 + n_search[b], 1 + options.min_images, covered[:, c].sum())


@given(choices())
def test_views_are_chosen_as_in_plain_loops(choice):
    plain = plainly_chosen(*choice)
    assert [set(np.flatnonzero(row)) for row in chosen_views(*choice).T] == plain


def test_no_view_is_taken_that_no_cell_asks_for():
    order = ViewOrder(np.array([0]), np.array([[1, 2, 3]]), np.array([[True, True, False]]))
    of_cell, options = np.zeros(2, np.int64), SelectionOptions(min_images=2)

    def taken(covered, n_search, options=options):
        chosen = chosen_views(order, np.array([n_search]), np.array(covered, bool), of_cell, options)
        return np.flatnonzero(chosen[:, 0]).tolist()

    everywhere = [[1, 1]] * 4
    assert [taken(everywhere, n) for n in (0, 1, 2, 3)] == [[0], [0, 1], [0, 1, 2], [0, 1, 2]]
    assert taken(everywhere, 3, SelectionOptions(min_images=3)) == [0, 1, 2, 3]
    beside = [[1, 1], [1, 0], [0, 1], [1, 1]]
    assert taken(beside, 1) == [0, 1, 2], "each cell with one"
    assert taken([[1, 1], [1, 1], [0, 0], [1, 1]], 2) == [0, 1, 3], "not the one that shows nothing"
    assert taken([[1, 0], [1, 1], [1, 1], [1, 1]], 1) == [0, 1, 2], "a cell outside the reference takes two others"


# --- blocks and cells ---


def lattice_of(shape, block):
    blocks = (-(-shape[0] // block), -(-shape[1] // block))
    return HeightLattice(0.0, 1.0, shape, block, np.zeros(blocks, np.int64), np.full(blocks, 16))


SHAPES = pytest.mark.parametrize(("shape", "block"), [((37, 70), 16), ((32, 32), 16), ((8, 41), 8), ((3, 5), 32)])


@SHAPES
def test_cells_that_decide_lie_in_their_blocks(shape, block):
    lattice = lattice_of(shape, block)
    cells, of_block = sampled_cells(lattice)
    assert len(cells) == 9 * lattice.count.size
    assert np.bincount(of_block).tolist() == [9] * lattice.count.size
    n_across = lattice.count.shape[1]
    for (r, c), number in zip(cells.tolist(), of_block.tolist(), strict=True):
        assert 0 <= r < shape[0]
        assert 0 <= c < shape[1]
        assert number == r // block * n_across + c // block
    whole = cells[of_block == 0]
    if shape[0] >= block <= shape[1]:
        thirds = sorted({(v * 3 // block) for v in whole[:, 0]} | {(v * 3 // block) for v in whole[:, 1]})
        assert thirds == [0, 1, 2]


@SHAPES
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_blocks_of_cells(shape, block, stride):
    lattice = lattice_of(shape, block)
    found = block_of_cells(lattice, stride)
    plain = [[r // block * lattice.count.shape[1] + c // block for c in range(0, shape[1], stride)]
             for r in range(0, shape[0], stride)]  # fmt: skip
    assert found.tolist() == plain


@SHAPES
def test_middles_of_blocks(shape, block):
    lattice = lattice_of(shape, block)
    found = block_middles(CellWindow(-7, 11, *shape), 2, lattice).tolist()
    plain = [[(11 + (d + 0.5) * block) * 4, (-7 + (b + 0.5) * block) * 4]
             for b in range(lattice.count.shape[0]) for d in range(lattice.count.shape[1])]  # fmt: skip
    assert found == plain


@SHAPES
def test_shares_of_blocks(shape, block):
    lattice = lattice_of(shape, block)
    seen = np.zeros((3, 3, *shape), np.int32)
    nothing = np.random.default_rng(4).random((3, *shape)) < 0.3
    seen[0][nothing], seen[1][nothing] = HIDDEN, -1
    found = block_shares(seen, lattice)
    for i in range(3):
        plain = []
        for b in range(lattice.count.shape[0]):
            for d in range(lattice.count.shape[1]):
                part = ~nothing[i, b * block : (b + 1) * block, d * block : (d + 1) * block]
                plain.append(part.mean())
        np.testing.assert_allclose(found[i], plain, rtol=0, atol=1e-12)


# --- images_needed ---

BY_LABEL = replace(SHORT, max_sigma_steps=1000.0)
REACH = 16


def needed(views, options, *, worth=(True, True, True), covering=None, hidden=None, search=(1, 2, 3)):
    """Of two blocks beside each other, on a level surface. hidden : (i,) lowest visible height index of the views."""
    n_views = len(views.layout)
    cells = np.array([(r, c) for c in (10, 14, 30, 34) for r in (10, 20, 28)], np.int64)
    of_block = (cells[:, 1] > 24).astype(np.int64)
    seen = np.zeros((3, n_views, *SHAPE), np.int32)
    seen[1], seen[2] = 1000, -1000
    if hidden is not None:
        seen[2] = np.array(hidden)[:, None, None]
    order = ViewOrder(np.zeros(2, np.int64), np.tile(search, (2, 1)), np.tile(worth, (2, 1)))
    covering = np.ones((len(cells), n_views), bool) if covering is None else covering(cells)
    surface = np.full(SHAPE, LEVEL_STEPS, np.float32)
    curves = CoarserCurves(views, seen, surface, SIDE, REACH)
    return images_needed(curves, cells, of_block, covering, order, options)


def test_one_perfect_view_is_enough_by_its_label_and_not_where_precision_is_asked_for():
    views = textured(noise=0.05)
    by_label = needed(views, BY_LABEL)
    assert by_label.n_added.tolist() == [1, 1]
    assert by_label.evaluations == 12 * (2 * REACH + 1)
    count = np.ones(by_label.mean_ncc.shape, int)
    alone = predicted_sigma(by_label.mean_ncc, count, SIDE**2)
    assert 0 < alone.min() <= alone.max() < 1.0
    precise = needed(views, replace(SHORT, max_sigma_steps=float(alone.min()) * 0.8))
    assert (precise.n_added > 1).all()
    assert needed(views, replace(SHORT, max_sigma_steps=float(alone.max()) * 1.01)).n_added.tolist() == [1, 1]
    assert needed(views, replace(SHORT, max_sigma_steps=1e-3)).n_added.tolist() == [3, 3]
    np.testing.assert_array_equal(by_label.mean_ncc.argmax(axis=1), REACH)


def test_a_spoiled_view_before_the_good_ones_is_not_enough():
    found = needed(textured(spoiled=(1,)), BY_LABEL)
    assert (found.n_added >= 2).all()
    assert needed(textured(spoiled=(1,)), BY_LABEL, search=(2, 3, 1)).n_added.tolist() == [1, 1]


def test_views_that_mislead_are_not_asked():
    found = needed(textured(), replace(SHORT, max_sigma_steps=1e-3), worth=(True, False, False))
    assert found.n_added.tolist() == [1, 1]
    assert found.evaluations == found.evaluations_all == 12 * (2 * REACH + 1)


def test_heights_at_which_a_view_is_hidden_are_left_out():
    """Neither the reference nor a search view counts below what hides it."""
    hidden_above = int(LEVEL_STEPS) - 3
    views, one = textured(), (True, False, False)
    index = LEVEL_STEPS - REACH + np.arange(2 * REACH + 1)
    open_ = needed(views, BY_LABEL, worth=one).mean_ncc
    assert not np.isnan(open_).any()
    for which in (0, 1):
        hidden = [-1000] * 4
        hidden[which] = hidden_above
        found = needed(views, BY_LABEL, worth=one, hidden=hidden).mean_ncc
        np.testing.assert_array_equal(np.isnan(found), np.broadcast_to(index < hidden_above, found.shape))
        np.testing.assert_array_equal(found[:, index >= hidden_above], open_[:, index >= hidden_above])
    # Hidden at the peak: the next view is needed, and it alone makes the curve there.
    found = needed(views, BY_LABEL, hidden=[-1000, int(LEVEL_STEPS) + 5, -1000, -1000])
    assert found.n_added.tolist() == [2, 2]
    alone = needed(views, BY_LABEL, search=(2, 1, 3), worth=one).mean_ncc
    np.testing.assert_array_equal(found.mean_ncc[:, REACH], alone[:, REACH])


def test_a_block_none_of_whose_samples_is_seen_adds_nothing():
    def right_only(cells):
        return np.broadcast_to(cells[:, 1:] > 24, (len(cells), 4))

    def reference_on_the_right_only(cells):
        covering = np.ones((len(cells), 4), bool)
        covering[:, 0] = cells[:, 1] > 24
        return covering

    for covering in (right_only, reference_on_the_right_only):
        found = needed(textured(), BY_LABEL, covering=covering)
        assert found.n_added.tolist() == [0, 1]
        assert np.isnan(found.mean_ncc[:6]).all()


# --- predicted_sigma ---


def bump(rho=0.9, bend=0.1, n=9):
    """A parabola of correlations: rho - bend k^2 / 2 around the middle."""
    k = np.arange(n) - n // 2
    return (rho - 0.5 * bend * k**2)[None]


def test_predicted_sigma_is_the_formula():
    """sqrt(2 (1 - rho) / (c N m)) = sqrt(2 x 0.1 / (0.1 x 25 x 2)) = 0.2."""
    found = predicted_sigma(bump(), np.full((1, 9), 2), 25)
    assert found.tolist() == pytest.approx([0.2])
    assert predicted_sigma(bump(rho=1.0), np.full((1, 9), 2), 25)[0] == 0.0


def test_predicted_sigma_falls_with_images_curvature_window_and_correlation():
    one = np.ones((1, 9), int)
    base = predicted_sigma(bump(), one, 25)[0]
    assert predicted_sigma(bump(), 4 * one, 25)[0] == pytest.approx(base / 2)
    assert predicted_sigma(bump(bend=0.4), one, 25)[0] == pytest.approx(base / 2)
    assert predicted_sigma(bump(), one, 100)[0] == pytest.approx(base / 2)
    assert predicted_sigma(bump(rho=0.95), one, 25)[0] == pytest.approx(base / 2**0.5)


def test_images_count_where_the_peak_is():
    count = np.ones((1, 9), int)
    count[0, 4] = 4
    assert predicted_sigma(bump(), count, 25)[0] == pytest.approx(predicted_sigma(bump(), 4 + 0 * count, 25)[0])


def test_predicted_sigma_is_infinite_without_two_sides():
    count = np.ones((1, 9), int)
    for gap in (3, 5):
        curve = bump()
        curve[0, gap] = np.nan
        assert predicted_sigma(curve, count, 25)[0] == np.inf
    even = np.full((1, 9), 0.5)
    assert predicted_sigma(even, count, 25)[0] == np.inf
    assert predicted_sigma(np.full((1, 9), np.nan), count, 25)[0] == np.inf


def test_predicted_sigma_of_a_peak_at_an_end_is_infinite():
    """The curve still rises where the range ends: the peak has one side."""
    rising = bump()[:, :5]
    for curve in (rising, rising[:, ::-1]):
        assert predicted_sigma(curve, np.ones((1, 5), int), 25)[0] == np.inf
