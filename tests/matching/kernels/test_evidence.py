"""Evidence in the cost volume against its slow twin, and the counts that it is learned from."""

from __future__ import annotations

import numpy as np
import pytest

from kernel_scene import even_lattice, kernel_scene
from reference import evidence as twin
from reference.semiglobal import dense
from zlocus.matching.evidence import NO_COUNTS, NO_EVIDENCE, NO_TABLE, nothing_counted
from zlocus.matching.kernels.cost_volume import CostParameters, SlopeArrays, tile_costs
from zlocus.matching.kernels.evidence import (
    CONTRAST_A,
    CONTRAST_B,
    TABLE_SHAPE,
    EvidenceTable,
    TableAndCounts,
    bit_count,
    doublings,
    pair_scratch,
    write_census,
    write_contrasts,
    write_gradients,
)
from zlocus.matching.kernels.ncc import ViewPair
from zlocus.matching.kernels.pairs_of_block import pairs_of_block
from zlocus.matching.kernels.shared_records import NEVER_COVERED

HALVES = np.array([1, 2])
EXCLUDED, BEST_SHARE = 0.4, 0.7
PARAMETERS = CostParameters(*(np.float32(v) for v in (0.0, 1.0, 0.3, 0.3, EXCLUDED)), 255, np.float32(0.0))
WORK = np.zeros((4, 0), np.float32)
PAIR = ViewPair(np.uint64(0), np.uint64(1))
NOISE = 0.05
UNIT, SMALL_UNIT = 14.0, 20.0
# Costs are whole numbers; a feature on the limit of a bin may fall into the next one, which few do.
COST, FEW = 0.51, 0.01
# Sums in float32, and a logarithm on straight lines.
CONTRAST_DOUBLINGS = 1e-2
BLOCK, SHAPE, N_HEIGHTS = 16, (20, 27), 12
BITS_OF_BYTE = np.array([number.bit_count() for number in range(256)])


def scene_and_visibility(n_views=3, seed=0):
    """A scene of which view 0 is occluded in some cells below height 4, and view 1 covers nothing in others.

    Of more than three views the last two are occluded in some cells too.
    """
    scene = kernel_scene(n_views, SHAPE, BLOCK, seed=seed)
    for image in scene.images:
        image /= 5
    scene = type(scene)(**(vars(scene) | {"pixels": np.concatenate([image.ravel() for image in scene.images])}))
    visible = scene.all_visible()
    visible.lowest_unoccluded[0, :9, :13] = 4
    visible.lowest_covered[1, 12:], visible.highest_covered[1, 12:] = NEVER_COVERED, -1
    if n_views > 3:
        visible.lowest_unoccluded[-2:, 4:, 6:] = 7
    return scene, visible


def flat_slope(scene):
    """A level support surface for windows of half width 2."""
    return SlopeArrays(np.zeros((scene.shape[0] + 4, scene.shape[1] + 4), np.float32), np.zeros(scene.nodes.shape[1:3]))


def run(scene, visible, evidence):
    """Costs (v,) of a tile."""
    lattice = even_lattice(N_HEIGHTS, SHAPE, BLOCK)
    volume = np.zeros(lattice.size, np.uint8)
    tile_costs(scene.arrays, flat_slope(scene), lattice.layout, HALVES, visible, PARAMETERS, evidence, volume)
    return volume, lattice


def planes_of(scene, block_row, block_col, rows, cols, index):
    """The planes of the views of a block at a height, and how they move."""
    shape = (rows.stop - rows.start, cols.stop - cols.start)
    nodes = scene.nodes[:, block_row : block_row + 2, block_col : block_col + 2]
    relief = np.zeros((shape[0] + 4, shape[1] + 4))
    planes = twin.planes_at(scene.images, nodes, scene.heights, index, BLOCK, 2, shape, relief)
    return planes, twin.movements(nodes, scene.heights, index, BLOCK, 2)


def worth_of(n_views, seed=5):
    """What each pair of views is worth, (i, i)."""
    worth = np.random.default_rng(seed).uniform(0.2, 2.0, (n_views, n_views)).astype(np.float32)
    return worth + worth.T


def grey_unit_of(n_views, seed=6):
    """The unit of the grey differences of each pair of views, (i, i)."""
    return worth_of(n_views, seed)


def table_with(ratios, n_views=3):
    """A table whose costs neither reach 0 nor 255."""
    values = (NOISE, UNIT, SMALL_UNIT, float(ratios.max()), 0.5, 0.3, 160.0)
    return EvidenceTable(
        np.append(ratios.ravel(), np.float32(0.0)).astype(np.float32),
        *(np.float32(v) for v in values),
        grey_unit_of(n_views),
        worth_of(n_views),
        np.float32(BEST_SHARE),
    )


def seen(visible, rows, cols, index):
    """(2, i, r, c): which views see the cells at a height, and cover them at any."""
    low, high, from_here = (bound[:, rows, cols] for bound in visible)
    covered = (low <= index) & (index <= high)
    return np.stack([covered & (from_here <= index), low <= high]), covered.sum(axis=0)


@pytest.mark.parametrize("n_views", [3, 6])
def test_costs_are_the_sums_of_the_table(n_views):
    scene, visible = scene_and_visibility(n_views)
    ratios = np.random.default_rng(1).uniform(-1.5, 2.0, TABLE_SHAPE).astype(np.float32)
    table = table_with(ratios, n_views)
    found, lattice = run(scene, visible, TableAndCounts(table, NO_COUNTS))
    found = dense(found, lattice, np.inf)
    expected = np.full(found.shape, np.inf)
    for b, d, rows, cols in scene.blocks():
        for index in range(lattice.first[b, d], lattice.first[b, d] + lattice.count[b, d]):
            views, n_covering = seen(visible, rows, cols, index)
            covering = np.flatnonzero(
                (visible.lowest_covered[:, rows, cols] <= visible.highest_covered[:, rows, cols]).any(axis=(1, 2))
            )
            of_block, n_effective = twin.pair_weights(table.worth, covering)
            weights = np.zeros((n_views, n_views))
            weights[np.ix_(covering, covering)] = of_block
            scale = UNIT * n_effective**0.3
            highest = min(scale * ratios.max(), 160.0)
            planes, movement = planes_of(scene, b, d, rows, cols, index)
            mean = twin.cell_evidence(
                planes, movement, HALVES, NOISE, table.grey_unit, ratios.astype(float), views, EXCLUDED, weights,
                BEST_SHARE,
            )  # fmt: skip
            cost = np.where(n_covering > 1, highest - scale * mean, highest - scale * 0.5)
            expected[rows, cols, index] = np.clip(cost, 0, 255)
    is_searched = np.isfinite(expected)
    assert is_searched.all()
    assert (np.abs(found - expected) > COST).mean() < FEW


@pytest.mark.parametrize("wrong_every", [1, 2])
def test_counts_are_those_of_right_and_of_wrong_heights(wrong_every):
    """Cells without a reference, views that do not see a cell, and heights that are neither right nor wrong are not
    counted, and wrong heights only at every so many indices."""
    scene, visible = scene_and_visibility()
    reference = np.full(SHAPE, 2.25, np.float32)
    reference[:, 20:] = np.nan
    learning = nothing_counted(3, reference, wrong_every)
    grey_unit = grey_unit_of(3)
    table = NO_TABLE._replace(noise_variance=np.float32(NOISE), grey_unit=grey_unit)
    _, lattice = run(scene, visible, TableAndCounts(table, learning))
    right, wrong, grey_roots = np.zeros(TABLE_SHAPE, int), np.zeros(TABLE_SHAPE, int), np.zeros((3, 3))
    for b, d, rows, cols in scene.blocks():
        known = np.isfinite(reference[rows, cols])
        for index in range(lattice.first[b, d], lattice.first[b, d] + lattice.count[b, d]):
            here = seen(visible, rows, cols, index)[0][0]
            (planes, movement), away = planes_of(scene, b, d, rows, cols, index), abs(index - 2.25)
            if away <= 3:
                right += twin.counted(planes, movement, HALVES, NOISE, grey_unit, known, here)
                grey_roots += twin.grey_roots(planes, HALVES[-1], known, here)
            elif away > 5 and index % wrong_every == 0:
                wrong += twin.counted(planes, movement, HALVES, NOISE, grey_unit, known, here)
    assert right.sum() > 4000
    assert wrong.sum() > 2000 / wrong_every
    for found, expected in ((learning.right, right), (learning.wrong, wrong)):
        assert found[:-1].sum() == expected.sum()
        assert np.abs(found[:-1].reshape(TABLE_SHAPE) - expected).sum() < FEW * expected.sum()
    np.testing.assert_allclose(learning.grey_roots, grey_roots, rtol=1e-4)
    for of_pair, of_all in ((learning.right_of_pair, learning.right), (learning.wrong_of_pair, learning.wrong)):
        likeness = of_all[:-1].reshape(TABLE_SHAPE).sum(axis=(0, 1, 2))
        np.testing.assert_array_equal(of_pair.sum(axis=(0, 1)), likeness)
        # View 1 covers half of the cells, so that its pairs are counted less often; none is counted twice.
        assert (of_pair.sum(axis=2)[[0, 1], [1, 2]] < of_pair[0, 2].sum()).all()
        assert not of_pair[np.tril_indices(3)].any()


def test_right_heights_can_be_counted_alone():
    scene, visible = scene_and_visibility()
    reference, found = np.full(SHAPE, 2.25, np.float32), []
    for wrong_every in (0, 1):
        learning = nothing_counted(3, reference, wrong_every)
        run(scene, visible, TableAndCounts(NO_TABLE._replace(grey_unit=grey_unit_of(3)), learning))
        found.append(learning)
    np.testing.assert_array_equal(found[0].right, found[1].right)
    np.testing.assert_array_equal(found[0].grey_roots, found[1].grey_roots)
    assert found[1].wrong.any()
    assert not found[0].wrong.any()
    assert not found[0].wrong_of_pair.any()


def test_without_a_table_the_cost_is_that_of_correlation():
    scene, visible = scene_and_visibility()
    correlation, _ = run(scene, visible, NO_EVIDENCE)
    flat, lattice = run(scene, visible, TableAndCounts(table_with(np.zeros(TABLE_SHAPE, np.float32)), NO_COUNTS))
    assert len(np.unique(correlation)) > 20
    assert len(np.unique(dense(flat, lattice, np.inf)[:9])) == 1


@pytest.mark.parametrize("n_views", [2, 4])
def test_the_order_of_the_views_does_not_matter(n_views):
    scene, _ = scene_and_visibility(n_views)
    ratios = np.random.default_rng(2).uniform(-1.0, 1.0, TABLE_SHAPE).astype(np.float32)
    table = table_with(ratios, n_views)
    order = list(reversed(range(n_views)))
    turned = type(scene)(**(vars(scene) | {"layout": scene.layout[order].copy(), "nodes": scene.nodes[order].copy()}))
    of_turned = {name: getattr(table, name)[np.ix_(order, order)].copy() for name in ("grey_unit", "worth")}
    tables = (table, table._replace(**of_turned))
    volumes = [
        run(s, s.all_visible(), TableAndCounts(t, NO_COUNTS))[0].astype(int)
        for s, t in zip((scene, turned), tables, strict=True)
    ]
    assert (np.abs(volumes[0] - volumes[1]) > 1).mean() < FEW


def test_heights_that_cost_the_most_before_in_all_cells_of_a_block_are_not_compared():
    """They cost the most afterwards too; at the others the evidence is added to the costs that were known."""
    scene, visible = scene_and_visibility()
    table = table_with(np.random.default_rng(4).uniform(-1.0, 1.0, TABLE_SHAPE).astype(np.float32))
    alone, lattice = run(scene, visible, TableAndCounts(table, NO_COUNTS))
    rng, far = np.random.default_rng(5), 30
    is_far = (rng.random((*lattice.count.shape, N_HEIGHTS)) < 0.4).repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)
    known = np.where(is_far[: SHAPE[0], : SHAPE[1]], far, rng.integers(0, far + 1, (*SHAPE, N_HEIGHTS)))
    # Every cell of an even lattice has all heights, and blocks of a row of blocks follow each other, row by row.
    volume = np.concatenate(
        [known[r, c : c + BLOCK].ravel() for r in range(SHAPE[0]) for c in range(0, SHAPE[1], BLOCK)]
    ).astype(np.uint8)
    np.testing.assert_array_equal(dense(volume, lattice, np.inf), known)
    evidence = TableAndCounts(table, NO_COUNTS, np.uint8(far))
    tile_costs(scene.arrays, flat_slope(scene), lattice.layout, HALVES, visible, PARAMETERS, evidence, volume)
    compared = np.minimum(dense(alone, lattice, np.inf) + known, 255)
    expected = np.where(is_far[: SHAPE[0], : SHAPE[1]], 255, compared)
    np.testing.assert_array_equal(dense(volume, lattice, np.inf), expected)


def test_evidence_of_small_windows_is_worth_more():
    """The unit of a block where all views are compared in the smallest window only."""
    scene, _ = scene_and_visibility()
    ratios = np.full(TABLE_SHAPE, -0.5, np.float32)
    table = table_with(ratios)._replace(highest=np.float32(0.0), worth=np.ones((3, 3), np.float32))
    costs = []
    for windows in (HALVES, HALVES[:1]):
        volume = np.zeros(even_lattice(N_HEIGHTS, SHAPE, BLOCK).size, np.uint8)
        around = int(windows[-1])
        slope = SlopeArrays(
            np.zeros((SHAPE[0] + 2 * around, SHAPE[1] + 2 * around), np.float32), np.zeros(scene.nodes.shape[1:3])
        )
        lattice = even_lattice(N_HEIGHTS, SHAPE, BLOCK)
        evidence = TableAndCounts(table, NO_COUNTS)
        tile_costs(scene.arrays, slope, lattice.layout, windows, scene.all_visible(), PARAMETERS, evidence, volume)
        costs.append(np.median(volume))
    pairs = 3**0.3
    assert costs == [round(UNIT * pairs * 0.5), round(SMALL_UNIT * pairs * 0.5)]


@pytest.mark.parametrize(
    ("views", "n_pairs"), [([0, 1], 1), ([1, 2, 4], 3), ([0, 1, 2, 3, 4, 5, 6], 14), (range(12), 24), (range(19), 31)]
)
def test_the_pairs_of_a_block_are_those_that_are_worth_most(views, n_pairs):
    worth = worth_of(19)
    found = pairs_of_block(worth, np.array(views))
    weights, n_effective = twin.pair_weights(worth.astype(float), views)
    np.testing.assert_allclose(found.weights, weights, rtol=1e-5)
    assert found.n_effective == pytest.approx(n_effective, rel=1e-5)
    assert np.count_nonzero(found.weights) // 2 == n_pairs


def test_pairs_that_see_a_cell_say_no_more_than_all_pairs():
    """Six views of which only two, the pair that is worth most, see the cells at low heights: all bins speak against
    these heights, and there as at the others the evidence is at most that of all pairs."""
    scene, _ = scene_and_visibility(6)
    ratio, visible, n_low = -0.5, scene.all_visible(), 5
    worth = np.ones((6, 6), np.float32)
    worth[0, 1] = worth[1, 0] = 4.0
    visible.lowest_unoccluded[2:] = n_low
    table = table_with(np.full(TABLE_SHAPE, ratio, np.float32), 6)._replace(highest=np.float32(0.0), worth=worth)
    volume, lattice = run(scene, visible, TableAndCounts(table, NO_COUNTS))
    cost = dense(volume, lattice, np.inf)
    assert np.ptp(cost[..., n_low:]) == 0
    assert (cost[..., :n_low] <= cost[..., n_low:].max()).all()
    assert (cost[..., :n_low] > 0).all()


def test_pairs_that_are_worth_nothing_change_no_cost():
    """A third view that agrees with nobody, and the cost of the other two alone."""
    scene, _ = scene_and_visibility()
    ratios = np.random.default_rng(3).uniform(-1.0, 1.0, TABLE_SHAPE).astype(np.float32)
    worth = np.full((3, 3), 1e-6, np.float32)
    worth[0, 1] = worth[1, 0] = 1.0
    table = table_with(ratios)._replace(worth=worth)
    visible = scene.all_visible()
    without = visible.copy()
    without.lowest_covered[2], without.highest_covered[2] = NEVER_COVERED, -1
    costs = [run(scene, v, TableAndCounts(table, NO_COUNTS))[0].astype(int) for v in (visible, without)]
    assert (np.abs(costs[0] - costs[1]) > 1).mean() < FEW


def test_an_edge_along_the_parallax_has_no_contrast():
    """A plane that is bright on one side of an edge: its contrast counts across the edge, and not along it."""
    plane = np.zeros((9, 12))
    plane[:, 6:] = 1.0
    plane[:] += np.random.default_rng(4).normal(0, 0.001, plane.shape)
    flat, n = np.append(plane.ravel(), np.zeros(40)).astype(np.float32)[None], 5 * 12
    scratch, found = pair_scratch(2, 2, flat.shape[1], WORK), {}
    write_gradients(flat, np.uint64(0), 2, 12, n, scratch.rows, scratch.gradients)
    scratch.gradients[1] = scratch.gradients[0]
    for name, direction in (("across", (0.0, 1.0)), ("along", (1.0, 0.0))):
        movement = np.array([direction, (0.0, 0.0)], np.float32)
        write_contrasts(scratch.gradients, movement, PAIR, np.float32(1e-6), n, scratch.rows)
        contrasts = [[doublings(word) for word in bits[:n]] for bits in scratch.bits[[CONTRAST_A, CONTRAST_B]]]
        contrast, other = np.reshape(contrasts, (2, 5, 12))
        found[name] = contrast[:, 3]
        expected = twin.contrast(flat[0, : plane.size].reshape(plane.shape).astype(float), 2, direction, 1e-6)
        np.testing.assert_allclose(contrast[:, :8], expected, rtol=0, atol=CONTRAST_DOUBLINGS)
        np.testing.assert_array_equal(contrast[:, :8], other[:, :8])
    assert (found["across"] > 15).all()
    assert (found["along"] < 2).all()


@pytest.mark.parametrize("half", [1, 2, 3, 5])
def test_the_census_tells_which_neighbours_are_brighter(half):
    """In windows of any side, some of which need several words, and with neighbours that are as bright as the cell."""
    rows, cols = 6, 7
    width = cols + 2 * half
    planes = np.random.default_rng(half).integers(0, 5, (2, rows + 2 * half, width)).astype(np.float32)
    flat, n = np.concatenate([planes.reshape(2, -1), np.zeros((2, 32))], axis=1).astype(np.float32), rows * width
    scratch = pair_scratch(2, half, flat.shape[1], WORK)
    for view in range(2):
        write_census(flat, np.uint64(view), half, width, n, scratch.census)
    differing = sum(
        BITS_OF_BYTE[(a ^ b).view(np.uint8)].reshape(len(a), -1).sum(axis=1) for a, b in scratch.census.swapaxes(0, 1)
    )
    expected = twin.same_order(*planes.astype(float), half)
    n_neighbours = (2 * half + 1) ** 2 - 1
    np.testing.assert_array_equal(n_neighbours - differing[:n].reshape(rows, width)[:, :cols], expected * n_neighbours)


def test_bits_are_counted():
    every_byte = np.arange(256, dtype=np.uint8)
    assert [bit_count(byte) for byte in every_byte] == BITS_OF_BYTE.tolist()
