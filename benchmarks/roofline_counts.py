"""Operations of each kernel per unit of work, counted from its source, and the least time that the machine needs.

The loops over cells, heights and pixels are counted as they are written. An operation is an addition, multiplication,
minimum, maximum, comparison, selection, shift, rounding or conversion of one value; float64 counts twice. Work done
once per block or line, loop overhead and addresses are not counted. Where a kernel computes a margin too, the counts
are multiplied by all cells over the cells of the result.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

from machine import Machine

BLOCK, SLACK = 32, 32


@dataclass(frozen=True)
class Count:
    """Operations and bytes of one unit of work.

    ops : operations of 32 bits; narrow : of uint16; roots : 1 / sqrt (a division counts as half of one); gathers :
    values read through an index; loads, stores : bytes of the other reads and writes, where a value that is widened
    counts in its wide form; memory : bytes that do not stay in the caches of a core.
    """

    ops: float = 0.0
    narrow: float = 0.0
    roots: float = 0.0
    gathers: float = 0.0
    loads: float = 0.0
    stores: float = 0.0
    memory: float = 0.0

    def __add__(self, other: Count) -> Count:
        return Count(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def __mul__(self, times: float) -> Count:
        return Count(*(a * times for a in astuple(self)))

    def bounds_ns(self, machine: Machine, size: int) -> dict[str, float]:
        """Least time of a unit by each possible limit, ns. size : bytes of the arrays that `memory` is read from."""
        return {
            "operations": self.ops / machine.arithmetic + self.narrow / machine.narrow,
            "roots": self.roots / machine.roots,
            "gathers": self.gathers / machine.gathers,
            "loads": self.loads / machine.loads,
            "stores": self.stores / machine.stores,
            "memory": self.memory / machine.bandwidth(size),
        }


# pixel_positions: x and y each c * (a + r * b) 3, + x0 1, + r * d 2, + z * v 2, min, max, floor, fraction: 12; index:
# 2 conversions, 1 product, 2 sums. Reads row, column, relief; writes 2 fractions and the index.
BILINEAR_POSITION = Count(ops=29, loads=12, stores=12)
# gather: reads the index and twice two pixels at once, which are written and read again; three times a + f * (b - a),
# with 2 fractions.
BILINEAR_GATHER = Count(ops=9, gathers=2, loads=12 + 16, stores=4 + 16)
RESAMPLE = BILINEAR_POSITION + BILINEAR_GATHER


def bordered(half: int) -> tuple[float, float, float]:
    """Cells over those of the block: of the plane with its margin, of its whole rows, and of these with padding."""
    width = BLOCK + 2 * half
    return width**2 / BLOCK**2, width / BLOCK, (BLOCK * width + SLACK) / BLOCK**2


def moments(windows: list[int]) -> Count:
    """Count of `window_moments` per cell and image."""
    _, rows, slack = bordered(windows[-1])
    found, done = Count(), 0
    for window in windows:
        # column_moments: three rows, 2 sums, 3 squares and their 2 sums; each further pair of rows 2 + 4, and the two
        # sums so far are read again.
        if not done:
            found += Count(ops=7, loads=12, stores=8) * slack
        found += Count(ops=6, loads=16, stores=8) * ((window - max(done, 1)) * slack)
        # Sums across of both, each value read for every sum it is in; beyond 5 x 5 they are written and read again.
        found += Count(ops=4 * window, loads=8 * (2 * window + 1)) * rows
        if window > 2:
            found += Count(loads=8, stores=8) * rows
        # value, spread 2, is_even 2, max, + added, selection; a root and a division.
        found += Count(ops=8, roots=1, stores=8) * rows
        done = window
    return found


def correlation(windows: list[int], n_views: int) -> Count:
    """Count of `add_pairs` per cell and pair of images."""
    coupled = n_views // 2 * 2 if windows == [1] else 0
    by_couples = coupled * (coupled - 2) // 2
    share = by_couples / (n_views * (n_views - 1) // 2)
    return couples() * share + single_pairs(windows) * (1 - share)


def couples() -> Count:
    """Count of `couple_products` and `add_couples` per cell and pair; each call handles four pairs."""
    _, rows, slack = bordered(1)
    # Three products and 2 sums a pair; twelve values read, four written.
    found = Count(ops=4 * 5, loads=48, stores=16) * slack
    # A pair: 2 sums across, - mean * mean, * scale: 5; joined 2, * scale 2, joined and added 2. Read are three sums a
    # pair, four means and scales, the total.
    found += Count(ops=4 * 5 + 6, loads=48 + 32 + 4, stores=4) * rows
    return found * 0.25


def single_pairs(windows: list[int]) -> Count:
    """Count of `column_products` and `add_correlation` per cell and pair."""
    _, rows, slack = bordered(windows[-1])
    found, done = Count(), 0
    for window in windows:
        # column_products: three products and 2 sums; each further pair of rows 2 + 2.
        if not done:
            found += Count(ops=5, loads=24, stores=4) * slack
        found += Count(ops=4, loads=20, stores=4) * ((window - max(done, 1)) * slack)
        # add_correlation: horizontal sums, then scale * scale * (cross - mean * mean) added: 5; four of both images and
        # the total are read. Beyond 7 x 7 the horizontal sums are written and read again.
        found += Count(ops=2 * window + 5, loads=4 * (2 * window + 1) + 20, stores=4) * rows
        if window > 3:
            found += Count(loads=4, stores=4) * rows
        done = window
    return found


def costs(n_views: int, windows: list[int], n_heights: int, with_greys: bool = True) -> Count:
    """Count of `tile_costs` per cell, step and image, where every view covers every cell."""
    plane, rows, _ = bordered(windows[-1])
    pairs, share = (n_views - 1) / 2, 1 / n_views
    # centred: one subtraction a value; the grey times its weight.
    image = RESAMPLE * plane + Count(ops=1, loads=4, stores=4) * plane + moments(windows)
    pair = correlation(windows, n_views)
    if with_greys:
        image += Count(ops=1, loads=4, stores=4) * rows
        # add_closeness: difference, its magnitude, difference, maximum, sum.
        pair += Count(ops=5, loads=12, stores=4) * rows
    # A step: total and counts set; whole_costs: 2 products, difference, comparison, selection, + 0.5, min, max,
    # conversion; heights_last: a byte read and written.
    step = (Count(stores=12) + Count(ops=9, loads=16, stores=5)) * rows
    step += Count(loads=1, stores=1, memory=1)
    # Once a block: pixels of the images, and `seen` of 3 x 4 bytes.
    return image + pair * pairs + step * share + Count(memory=16 / n_heights)


# path_cost: min, + P1, min, min, - least, + cost; minimum of the path; eight paths. Sums of four: 3, twice. Costs
# become uint16, twice a sweep (paths from W, the three others). Sums of the up sweep are added: 1. Reads: 3 path costs,
# 8 times; costs as uint16 four times, and once to turn them round; sums of the paths from W; sums to be turned round
# and those of the down sweep. Writes: 8 path costs, sums twice a sweep, turned costs, total. Memory: costs twice; sums
# written, then read and written.
SGM = Count(narrow=8 * 7 + 6 + 4 + 1, loads=48 + 8 + 1 + 4 + 4, stores=16 + 8 + 1 + 2, memory=2 + 2 + 4)
# One sweep, of four. run_along: two path costs of 5 and their minima, 12; offers 4; run_across: offers 4, sum 1;
# lay_costs 2, add_sums 3. 17 reads and 7 writes of uint16. Memory: costs 1, sums read 2 and written 2.
MGM_SWEEP = Count(narrow=12 + 4 + 5 + 5, loads=34, stores=14, memory=5)
MGM = MGM_SWEEP * 4
# least_sum: conversion, shift, |, min, next index: 5; other_minimum: 4 for the key, away 2, comparisons 4 and joining
# them 3, selection, min, next index: 16, of which 2 comparisons of uint16. Reads one value, then three.
WINNERS = Count(ops=5 + 14, narrow=2, loads=8, memory=2)


def profile(windows: list[int], n_views: int, n_offsets: int) -> Count:
    """Count of `tile_profile` per cell, offset and image."""
    plane, rows, _ = bordered(windows[-1])
    # level: sum, difference, division; once for all images.
    level = Count(ops=2, roots=0.5, loads=4, stores=4) * (plane / n_views)
    # positions_along, x and y: three bilinear forms of 6, u * (b + u * c) added 4, min, max: 24.
    position = Count(ops=2 * 24, loads=2 * 12, stores=2 * 4)
    # spline_weights, x and y: floor, f, g; 3 + 5 + 5 + 3. pixel_indices: 5. spline_gather: five times 4 products and 3
    # sums.
    weights = Count(ops=2 * 19, loads=2 * 4, stores=2 * 20) + Count(ops=5, loads=8, stores=4)
    gather = Count(ops=35, gathers=16, loads=4 + 32, stores=4)
    # The plane less its middle; scale times whether it is seen: comparison, conversion, product.
    image = (position + weights + gather + Count(ops=1, loads=4, stores=4)) * plane + moments(windows)
    image += Count(ops=3, loads=8, stores=4) * (rows * len(windows))
    # Mean over the pairs: 1; once: pixels, `seen`, and the result.
    mean = Count(ops=1, loads=8, stores=4, memory=4) * (len(windows) / n_views)
    return level + image + correlation(windows, n_views) * ((n_views - 1) / 2) + mean + Count(memory=16 / n_offsets)


# add_tap: the step less two slopes 5, away 1, weight 3 + 2, sums 3; reads two cells, two slopes, two sums. 25 of them,
# then a division and a sum. Memory: surface, two slopes, result, once, for five rows of each stay in cache.
SMOOTH = Count(ops=14, loads=24, stores=8) * 25 + Count(ops=1, roots=0.5, loads=12, stores=12, memory=16)
# Place, floor, fraction in float64: 6; borders 4 comparisons, second min; two maxima, a + f * (b - a) - gain 4. Four
# values are read; -1e30 is written first. Memory: surface, result, twice (set, swept).
VISIBILITY = Count(ops=2 * 3 + 4 + 1 + 2 + 4, gathers=4, stores=8, memory=12)
# step_cells: x and y in float64: 8; 4 comparisons of float64: 8, joined 3, + 1, selection; lengthen: sum, comparison,
# 3 selections, difference and sum. Reads and writes the run; then reads four and writes four of int32.
REACH = Count(ops=8 + 8 + 3 + 2 + 7, loads=4 + 16, stores=4 + 16)
# filter_columns: down 2, up 2, gain 1; reads two rows, two, one. transposed: one read, one write. Each twice. Memory:
# three sweeps over the image a filter, and the turned images.
SPLINE = Count(ops=5, loads=20, stores=12, memory=24) * 2 + Count(loads=4, stores=4, memory=8) * 2
# Level in float64 from the surface: product, sum, difference, 2 each, division, 2 conversions. Positions as in
# `profile`; fractions: floor and difference, x and y; index 5. Least and greatest of the surface. Memory: surface,
# image, result.
ORTHO = (
    Count(ops=8 + 48 + 4 + 5 + 2, roots=1, loads=4 + 24 + 8 + 8 + 8, stores=4 + 8 + 16 + 4, memory=12)
    + BILINEAR_GATHER
    + Count(loads=4, stores=4)
)
