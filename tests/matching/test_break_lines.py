"""Break lines: which steps cross them, and what they do to costs and penalties."""

import numpy as np
import shapely
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from zlocus.core.break_lines import BreakLines
from zlocus.core.grid import CellWindow
from zlocus.core.options import SemiGlobalOptions
from zlocus.matching.break_lines import STEPS, constrain, held_heights, steps_across
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.level_records import PyramidLevel
from zlocus.matching.semiglobal import aggregate
from zlocus.matching.slope_surface import SlopeSurface

CELL_M, TOP_M = 0.5, 100.0


def level_of(rows, cols):
    """A level of cells of 0.5 m whose north-west corner is at (0, 100) m, with heights from 0 in steps of 1 m."""
    return PyramidLevel(
        0, CellWindow(0, 0, rows, cols), (slice(0, rows), slice(0, cols)),
        Affine(CELL_M, 0, 0, 0, -CELL_M, TOP_M), CELL_M, 0.0, 1.0, 8,
    )  # fmt: skip


def centre(row, col):
    return (col + 0.5) * CELL_M, TOP_M - (row + 0.5) * CELL_M


def slow_steps_across(jumps, rows, cols):
    """`steps_across` by shapely, step by step."""
    across = np.zeros((len(STEPS), rows, cols), bool)
    lines = shapely.linestrings(jumps)
    for k, (down, right) in enumerate(STEPS):
        for r in range(rows):
            for c in range(cols):
                step = shapely.linestrings([centre(r + down, c + right), centre(r, c)])
                across[k, r, c] = shapely.intersects(lines, step).any()
    return across


# Off the lines through centres, on which rounding decides.
place = st.tuples(st.floats(-1.0, 4.0), st.floats(97.0, 101.0)).map(lambda p: (p[0] + 0.013, p[1] + 0.0171))


@given(st.lists(st.tuples(place, place), min_size=1, max_size=3))
def test_steps_that_cross_a_line_are_those_that_shapely_finds(segments):
    jumps = np.array(segments)
    jumps = jumps[np.hypot(*(jumps[:, 1] - jumps[:, 0]).T) > 1e-3]
    found = steps_across(BreakLines(jumps=jumps), level_of(5, 6))
    expected = slow_steps_across(jumps, 5, 6) if len(jumps) else np.zeros_like(found)
    assert (found == expected).mean() > 0.995  # a step that ends on the line may round to either side


def test_a_line_between_two_columns_is_crossed_by_the_steps_between_them():
    x = 3 * CELL_M  # between the columns 2 and 3
    found = steps_across(BreakLines(jumps=np.array([[[x, TOP_M + 9], [x, TOP_M - 9]]])), level_of(4, 6))
    from_west, from_nw, from_north, from_ne = found
    assert from_west[:, 3].all()
    assert from_west.sum() == 4
    assert from_nw[:, 3].all()
    assert not from_north.any()
    assert from_ne[:, 2].all()


def flat_problem(rows, cols, n):
    """Costs of heights 0 to n - 1: no cell knows anything. Penalties are those of equal grey values."""
    lattice = HeightLattice(0.0, 1.0, (rows, cols), 8, np.zeros((1, 1), np.int64), np.full((1, 1), n, np.int64))
    return lattice, np.full(lattice.size, 20, np.uint8), np.full((4, rows, cols), 500, np.uint16)


def test_heights_on_both_sides_of_a_line_do_not_know_of_each_other():
    """Only the outermost columns know their heights, 1 and 6: with the line each half has that of its own end, and
    without a line some cells beside the middle have another one or the same jump costs its penalty."""
    rows, cols, n = 6, 8, 8
    lattice, cost, penalties = flat_problem(rows, cols, n)
    volume = cost.reshape(rows, cols, n)
    volume[:, 0, 1], volume[:, -1, 6] = 0, 0
    x = 3 * CELL_M
    lines = BreakLines(jumps=np.array([[[x, TOP_M + 9], [x, TOP_M - 9]]]))
    level, slope_surface = level_of(rows, cols), SlopeSurface.flat((rows, cols), 8)
    open_penalties = constrain(lines, level, lattice, slope_surface, cost, penalties)
    assert (open_penalties[0, :, 3] == 0).all()
    assert (open_penalties[0, :, 4] == 500).all()
    heights = aggregate(cost, lattice, open_penalties, 1.35, SemiGlobalOptions()).best
    assert (heights[:, :3] == 1).all()
    assert (heights[:, 3:] == 6).all()


def test_a_line_with_heights_holds_its_cells_and_draws_their_neighbours():
    rows, cols, n = 6, 8, 8
    lattice, cost, penalties = flat_problem(rows, cols, n)
    xs = np.arange(0.05, cols * CELL_M, 0.1)
    held = np.column_stack([xs, np.full(len(xs), centre(2, 0)[1]), np.full(len(xs), 5.2)])
    level, slope_surface = level_of(rows, cols), SlopeSurface.flat((rows, cols), 8)
    same = constrain(BreakLines(held=held), level, lattice, slope_surface, cost, penalties)
    assert (same == penalties).all()
    volume = cost.reshape(rows, cols, n)
    assert (volume[2, :, 5] == 0).all()
    assert (np.delete(volume[2], 5, axis=1) == 255).all()
    assert (np.delete(volume, 2, axis=0) == 20).all()
    assert (aggregate(cost, lattice, same, 1.35, SemiGlobalOptions()).best == 5).all()


def test_a_height_that_is_not_searched_holds_no_cell():
    lattice, cost, penalties = flat_problem(4, 4, 8)
    held = np.array([[*centre(1, 1), 30.0]])
    constrain(BreakLines(held=held), level_of(4, 4), lattice, SlopeSurface.flat((4, 4), 8), cost, penalties)
    assert (cost == 20).all()


def test_the_height_of_a_cell_is_the_mean_of_its_points():
    points = np.array([[*centre(1, 2), 4.0], [*centre(1, 2), 5.0], [*centre(0, 0), 7.0], [-9.0, 0.0, 1.0]])
    found = held_heights(points, ~Affine(CELL_M, 0, 0, 0, -CELL_M, TOP_M), (3, 4))
    assert found[1, 2] == 4.5
    assert found[0, 0] == 7.0
    assert np.isfinite(found).sum() == 2
