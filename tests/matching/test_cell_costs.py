"""Costs of single cells: the evidence of the pairs adds up to the cost that the run's kernel gave."""

from __future__ import annotations

import io

import numpy as np
import pytest

from rendered_scenes import HEIGHTS, SMALL_TILES
from zlocus.core.grid import CellWindow
from zlocus.core.progress import progress_for
from zlocus.core.requests import DsmRequest, SetupRequest
from zlocus.matching.cell_costs import cell_costs, match_with_costs, tile_around
from zlocus.matching.tile import match_tile, tile_inputs
from zlocus.pipeline.setup import open_inputs, orient_views, set_up_run

# Costs are whole numbers, and so are those of single pairs, of which an evidence has two decimals.
ROUNDED = 1.5
SIDE = 96


@pytest.fixture(scope="module")
def matched(images, tmp_path_factory):
    """A tile in the middle of the sine, with evidence, although it is small."""
    request = DsmRequest(images("sine").inputs, tmp_path_factory.mktemp("costs") / "out", crs="EPSG:32632",
                         resolution=0.5, heights=HEIGHTS)  # fmt: skip
    setup_request, progress = SetupRequest.of(request), progress_for(io.StringIO())
    opened = open_inputs(setup_request, progress)
    orientation = orient_views(opened.scene, SMALL_TILES.orientation, progress)
    match_scene = set_up_run(setup_request, opened, orientation, SMALL_TILES, progress).match_scene
    overlap = match_scene.overlap_window
    core = CellWindow(overlap.row + (overlap.rows - SIDE) // 2, overlap.col + (overlap.cols - SIDE) // 2, SIDE, SIDE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zlocus.matching.tile.MIN_CELLS_OF_TILE", 0)
        patch.setattr("zlocus.matching.evidence.MIN_TRUSTED_CELLS", 500)
        found = match_with_costs(tile_inputs(match_scene, core, SMALL_TILES))
        surface = match_tile(match_scene, core, SMALL_TILES).surface
    return found, core, surface


def cells_of(core):
    return [(core.row + r, core.col + c) for r in (17, 48, 79) for c in (9, 50, 83)]


def test_it_is_matched_as_a_tile_of_a_run_is(matched):
    found, core, surface = matched
    np.testing.assert_array_equal(found.height_m[core.slices_in(found.level.window)], surface.height)


def test_the_evidence_of_the_pairs_adds_up_to_the_cost(matched):
    """The mean of the best share of the pairs (Rockafellar, Uryasev 2000) is what the kernel made the cost of."""
    found, core, _ = matched
    table, compared = found.table_and_counts.table, 0
    for row, col in cells_of(core):
        cell = cell_costs(found, row, col)
        weights = np.array([pair.weight for pair in cell.pair_evidence])
        n_effective = weights.sum() ** 2 / (weights**2).sum()
        scale = table.unit * n_effective**table.pair_exponent
        highest = min(scale * table.highest, table.max_cost)
        for k in range(len(cell.heights_m)):
            ratios = np.array([pair.log_ratio[k] for pair in cell.pair_evidence])
            own = int(cell.cost[k]) - int(cell.known_cost[k])
            if np.isnan(ratios).any() or cell.cost[k] in (0, 255):
                continue  # a pair does not see it, or the cost was cut off
            best = min(t + (weights * np.maximum(ratios - t, 0)).sum() / (table.best_share * weights.sum())
                       for t in ratios)  # fmt: skip
            assert own == pytest.approx(highest - scale * best, abs=ROUNDED + scale * 0.02)
            compared += 1
    assert compared > 100


def test_right_heights_have_evidence_and_no_prior_cost(matched):
    found, core, surface = matched
    chosen = [cell_costs(found, row, col) for row, col in cells_of(core)]
    at_height = [np.nansum([pair.log_ratio[cell.chosen] for pair in cell.pair_evidence]) for cell in chosen]
    elsewhere = [np.nanmean([pair.log_ratio for pair in cell.pair_evidence]) for cell in chosen]
    assert np.mean(at_height) > 3 * np.mean(elsewhere)
    assert [int(cell.known_cost[cell.chosen]) for cell in chosen] == [0] * len(chosen)
    for cell, (row, col) in zip(chosen, cells_of(core), strict=True):
        assert cell.heights_m[cell.chosen] == pytest.approx(surface.height[row - core.row, col - core.col], abs=1.0)
        assert abs(cell.coarser_m - cell.heights_m[cell.chosen]).min() < 2.0
        assert cell.sees.sum() >= 2
        n_counting = sum(bool(pair.counts[cell.chosen]) for pair in cell.pair_evidence)
        assert 1 <= n_counting <= len(cell.pair_evidence)


def test_cells_beyond_the_window_are_not_told(matched):
    found, core, _ = matched
    assert cell_costs(found, core.row - 10_000, core.col) is None


@pytest.mark.parametrize("at", [(1000, 2000), (1150, 2400), (1999, 2999), (1000, 2999)])
def test_a_part_holds_the_cell_with_room_around_it(at):
    core = CellWindow(1000, 2000, 1000, 1000)
    part = tile_around(core, *at, 288)
    assert part.within(core) == part
    assert (part.rows, part.cols) == (288, 288)
    for cell, first, size, low, length in (
        (at[0], part.row, part.rows, core.row, core.rows), (at[1], part.col, part.cols, core.col, core.cols),
    ):  # fmt: skip
        assert first <= cell < first + size
        assert cell - first >= 72 or first == low
        assert first + size - cell > 71 or first + size == low + length
    small = CellWindow(1000, 2000, 400, 400)
    assert tile_around(small, 1100, 2100, 288) == small
