"""Choice of images: reference and order of views, how many a block needs, and which cells decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from textured_views import LEVEL_STEPS, SHAPE, SHORT, SIDE, textured
from zlocus.core.grid import CellWindow
from zlocus.core.options import SelectionOptions
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.match_curve import FAIR, GOOD, POOR, predicted_sigma
from zlocus.matching.occlusion import exclude
from zlocus.matching.pair_labels import PairLabels
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


# --- order_views ---


def labels_of(xy, labels, angle_deg=None):
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
    found = order_views(labels_of(NEAR, agreeing(3)), share, AT.repeat(3, axis=0), OPTIONS)
    assert found.reference.tolist() == [1, 0, 0]
    assert [sorted(row) for row in found.search.tolist()] == [[0, 2], [1, 2], [1, 2]]
    assert found.is_helpful.all()


def test_a_view_that_agrees_with_none_is_not_the_reference_and_stands_last():
    found = order_views(labels_of(NEAR, agreeing(4, 0)), np.ones((4, 1)), AT, OPTIONS)
    assert found.reference.tolist() == [1]
    assert found.search.tolist() == [[2, 3, 0]]
    assert found.is_helpful.tolist() == [[True, True, False]]


def test_without_any_agreement_the_view_that_shows_most_is_the_reference():
    share = np.array([[0.5], [0.8], [0.8]])
    found = order_views(labels_of(NEAR, agreeing(3, 0, 1, 2)), share, AT, OPTIONS)
    assert found.reference.tolist() == [1]
    assert not found.is_helpful.any()
    found = order_views(labels_of(NEAR, agreeing(3)), share, AT, OPTIONS)
    assert found.reference.tolist() == [1], "no view shows all of the block"
    assert found.is_helpful.all()


def test_views_below_a_share_of_the_best_do_not_help():
    """Accumulated over five points: 5, 3 and 2 with the reference."""
    labels = np.broadcast_to(agreeing(4), (5, 4, 4)).copy()
    labels[:2, 0, 2] = labels[:2, 2, 0] = FAIR
    labels[:3, 0, 3] = labels[:3, 3, 0] = FAIR
    xy = 50.0 + np.arange(10.0).reshape(5, 2)
    for least, expected in ((0.6, [True, True, False]), (0.61, [True, False, False]), (0.4, [True, True, True])):
        options = SelectionOptions(min_label_share=least)
        found = order_views(labels_of(xy, labels), np.ones((4, 1)), AT, options)
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
        found = order_views(labels_of(NEAR, labels, angle), np.ones((5, 1)), AT, options)
        assert found.reference.tolist() == [0]
        assert found.search.tolist() == [expected], order
        assert found.is_helpful.tolist() == [[True, True, True, False]]


def test_blocks_have_the_order_of_the_points_around_them():
    labels = np.stack([agreeing(3, 0), agreeing(3, 2)])
    xy = np.array([[0.0, 0.0], [1000.0, 0.0]])
    found = order_views(labels_of(xy, labels), np.ones((3, 2)), xy + 5.0, OPTIONS)
    assert found.reference.tolist() == [1, 0]
    assert found.search.tolist() == [[2, 0], [1, 2]]
    assert found.is_helpful.tolist() == [[True, False], [True, False]]


def test_far_from_all_points_the_labels_of_the_whole_scene_count():
    """The first two agree with none in most of the scene; near the one point where they do, they lead."""
    labels = np.stack([agreeing(4, 0, 1), agreeing(4, 0, 1), agreeing(4, 0, 1), agreeing(4)])
    xy = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [5000.0, 0.0]])
    at = np.array([[2500.0, 2500.0], [5000.0, 5.0]])
    found = order_views(labels_of(xy, labels), np.ones((4, 2)), at, OPTIONS)
    assert found.reference.tolist() == [2, 0]
    assert found.search[0].tolist() == [3, 0, 1]
    assert found.is_helpful.tolist() == [[True, False, False], [True, True, True]]


@pytest.mark.parametrize("xy", [np.zeros((0, 2)), np.full((3, 2), 1e5)], ids=["no point at all", "far points"])
def test_cells_of_plain_roofs_and_roads_that_no_feature_point_covers_still_get_an_order(xy):
    """A reference that shows them and every other view once, in the order of the scene."""
    at = np.array([[50.0, 50.0], [80.0, 20.0], [-300.0, 0.0]])
    share = np.array([[1.0, 0.2, 0.3], [1.0, 1.0, 0.4], [0.0, 1.0, 0.2]])
    found = order_views(labels_of(xy, agreeing(3, 1)), share, at, OPTIONS)
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
def test_every_cell_is_covered_by_the_requested_number_of_views_or_by_all(choice):
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


def test_no_view_is_added_that_no_cell_needs():
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
    visible = VisibleHeights(*np.zeros((3, 3, *shape), np.int32))
    nothing = np.random.default_rng(4).random((3, *shape)) < 0.3
    exclude(visible, nothing)
    found = block_shares(visible, lattice)
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


def needed(views, options, *, worth=(True, True, True), covering=None, occluded_below=None, search=(1, 2, 3)):
    """Two blocks beside each other on level ground. occluded_below : (i,) lowest visible level index of the views."""
    n_views = len(views.layout)
    cells = np.array([(r, c) for c in (10, 14, 30, 34) for r in (10, 20, 28)], np.int64)
    of_block = (cells[:, 1] > 24).astype(np.int64)
    visible = VisibleHeights(*(np.full((n_views, *SHAPE), index, np.int32) for index in (0, 1000, -1000)))
    if occluded_below is not None:
        visible.lowest_unoccluded[:] = np.array(occluded_below)[:, None, None]
    order = ViewOrder(np.zeros(2, np.int64), np.tile(search, (2, 1)), np.tile(worth, (2, 1)))
    covering = np.ones((len(cells), n_views), bool) if covering is None else covering(cells)
    surface = np.full(SHAPE, LEVEL_STEPS, np.float32)
    curves = CoarserCurves(views, visible, surface, SIDE, REACH)
    return images_needed(curves, cells, of_block, covering, order, options)


def test_one_perfect_view_is_enough_by_its_label_but_not_where_precision_is_required():
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


def test_views_that_do_not_help_are_not_evaluated():
    found = needed(textured(), replace(SHORT, max_sigma_steps=1e-3), worth=(True, False, False))
    assert found.n_added.tolist() == [1, 1]
    assert found.evaluations == found.evaluations_all == 12 * (2 * REACH + 1)


def test_occluded_heights_are_excluded():
    """Neither the reference nor a search view counts below what hides it."""
    hidden_above = int(LEVEL_STEPS) - 3
    views, one = textured(), (True, False, False)
    index = LEVEL_STEPS - REACH + np.arange(2 * REACH + 1)
    open_ = needed(views, BY_LABEL, worth=one).mean_ncc
    assert not np.isnan(open_).any()
    for which in (0, 1):
        occluded_below = [-1000] * 4
        occluded_below[which] = hidden_above
        found = needed(views, BY_LABEL, worth=one, occluded_below=occluded_below).mean_ncc
        np.testing.assert_array_equal(np.isnan(found), np.broadcast_to(index < hidden_above, found.shape))
        np.testing.assert_array_equal(found[:, index >= hidden_above], open_[:, index >= hidden_above])
    # Hidden at the peak: the next view is needed, and it alone makes the curve there.
    found = needed(views, BY_LABEL, occluded_below=[-1000, int(LEVEL_STEPS) + 5, -1000, -1000])
    assert found.n_added.tolist() == [2, 2]
    alone = needed(views, BY_LABEL, search=(2, 1, 3), worth=one).mean_ncc
    np.testing.assert_array_equal(found.mean_ncc[:, REACH], alone[:, REACH])


def test_a_block_without_a_covered_sample_adds_no_view():
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
