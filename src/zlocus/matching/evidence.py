"""Evidence: log-likelihood ratios of what image pairs look like at right and at wrong heights, learned from the images.

A correlation of 0.6 is strong evidence on ground with texture, and none at all on a plain road. How much correlation,
local contrast and grey difference say between these images is therefore counted: at the heights that were already found
for the cells of a tile (of the coarser level, or of an earlier pass), and at heights of the same cells that are wrong
because they lie far from them. The logarithm of the ratio of the two frequencies is the evidence of one pair for one
height. A plain window, a pair whose grey values do not compare, or a blurred patch has the same frequencies at right
and at wrong heights, so that it says nothing.

Nearly all heights that can be counted are those of smooth ground. Their frequencies alone would say that the windows of
a tree, which are less alike, are at no height right. Among windows with texture, some right heights are therefore taken
to be those of rough surfaces, see `rough_ratios`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import on_cells
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import CostParameters, SlopeArrays, tile_costs
from zlocus.matching.kernels.evidence import N_LIKENESS, TABLE_SHAPE, EvidenceTable, Learning, TableAndCounts
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.level_records import LevelResult, PyramidLevel
from zlocus.matching.local_contrast import rounded
from zlocus.matching.occlusion import MANY_VIEWS, PAIR, usual_number
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews

# Cost of one natural unit of mean evidence of one pair. Windows of neighbouring cells overlap, so that their evidence
# is counted several times: small windows overlap less, and each of their units is worth more.
UNIT_COST, SMALL_WINDOW_UNIT_COST = 14.0, 18.0
# From each level to the next coarser one a unit costs so many times more: a roof or a crown has fewer cells there that
# pay for its jumps, and one that is lost there stays lost.
UNIT_FACTOR_PER_LEVEL = 1.25
# The evidence of n pairs counts n ** PAIR_EXPONENT times their mean: pairs share images, so that they err together.
PAIR_EXPONENT = 0.3
# Of the pairs that see a height, those count that speak most for it, until they are this share of the weight of all. A
# pair that does not show what the others do, because of an occlusion or a change between two dates, speaks against the
# right height too. Where many views cover the cells, half of them may be occluded, and none is excluded: there only a
# smaller share of the pairs shows the surface.
BEST_SHARE, BEST_SHARE_OF_MANY = 0.7, 0.3
# Cost of a height without evidence is at most this, so that evidence against a height has room below 255.
MAX_MIDDLE_COST = 160.0
# Evidence of one pair is at most this, natural units.
MAX_LOG_RATIO = 5.0
# The part of the evidence that the grey difference adds to that of likeness and contrast counts by this: grey values
# of neighbouring heights are alike, so that the two are not independent.
GREY_SHARE = 0.5
# This share of the right heights is that of rough surfaces, such as trees, which are too seldom counted. It grows from
# nothing in the first of these bins of contrast, that of noise, to the whole share in the second.
ROUGH_SHARE, FIRST_ROUGH_CONTRAST, FULL_ROUGH_CONTRAST = 0.4, 4, 9
# On rough surfaces the mean likeness and grey difference of right heights are so far from those of wrong heights, as a
# share of the way to those that were counted; half as far where a bin of contrast has no more counts than the prior of
# so many bins.
ROUGH_DISTANCE, ROUGH_PRIOR_BINS = 0.8, 50
# Bins of contrast that no window filled have this many counts in every bin, and features vary by no less than this.
LEAST_COUNT, LEAST_VARIANCE_OF_FEATURE = 1e-9, 1e-4
# Counts that every bin gets at right heights before the images are looked at, where all blocks of a tile are counted;
# wrong heights get the same frequency. More counts make rare features, such as those of trees, say less.
PRIOR_COUNTS = 40.0
# Each likeness of a pair of views gets so many counts more, in the frequencies of all pairs: pairs that were counted in
# few cells are worth as much as the others.
COUNTS_OF_ALL_PAIRS = 200.0
# No pair is worth less, so that weights exist where no pair says anything.
LEAST_WORTH = 1e-3
# A cell is not learned from where the heights of 3 x 3 cells differ by so many steps: one of them is wrong, or there is
# a jump.
MAX_STEPS_ACROSS = 6.0
# From fewer cells nothing is learned: bins would stay empty, and heights would depend on how the ground is cut into
# tiles (with tiles of 128 x 128 cells 1.3 % of the cells move by more than half a step under a halo twice as wide).
MIN_TRUSTED_CELLS = 20_000
# Tiles of fewer finest cells would learn at their finest level only, between coarser heights that were found without
# evidence: of a town in 40 000 cells 2.05 % of the heights are then off by more than 10 m, and 1.86 % without evidence.
MIN_CELLS_OF_TILE = 4 * MIN_TRUSTED_CELLS
# The noise of an image is the variance that this share of its small windows is below. Windows are NOISE_EVERY pixels
# apart.
NOISE_SHARE, NOISE_WINDOW, NOISE_EVERY, LEAST_VARIANCE = 0.05, (5, 5), 2, 1e-7
# Only every second, fourth, eighth or sixteenth block of a level is counted where so many cells remain. A cell counts
# once for each pair of views, so that where more than so many views cover the cells, fewer cells are enough.
LEAST_CELLS, VIEWS_OF_LEAST_CELLS = 80_000, 12
# Wrong heights, of which there are many more than right ones, are counted at every fourth height index.
WRONG_EVERY = 4
# Of every 2^k blocks of a row the same one is counted as in the row above, shifted by the k-th of these.
ROW_SHIFTS = (0, 1, 2, 3, 4)
# Usual grey differences are counted first, in 2^k times fewer blocks. Each pair of views gets so many differences more
# that are like those of all pairs.
UNIT_LOG_EVERY, GREY_DIFFERENCES_OF_ALL_PAIRS = 2, 1000.0

NO_TABLE = EvidenceTable(
    log_ratios=np.zeros(0, np.float32), noise_variance=np.float32(1.0), unit=np.float32(0.0),
    small_window_unit=np.float32(0.0), highest=np.float32(0.0), neutral=np.float32(0.0),
    pair_exponent=np.float32(0.0), max_cost=np.float32(0.0), grey_unit=np.zeros((0, 0), np.float32),
    worth=np.zeros((0, 0), np.float32), best_share=np.float32(1.0),
)  # fmt: skip
NO_COUNTS = Learning(
    np.zeros((0, 0), np.float32),
    np.int64(0),
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros((0, 0, 0), np.int64),
    np.zeros((0, 0, 0), np.int64),
    np.zeros((0, 0), np.float64),
)
NO_EVIDENCE = TableAndCounts(NO_TABLE, NO_COUNTS)


@dataclass(frozen=True)
class TaughtHeights:
    """Heights that the evidence of a level is learned from.

    height : (r, c) float32, slope indices, NaN where none is trusted; level : number of the level, 0 is the finest.
    """

    height: NDArray[np.float32]
    level: int


def learned_evidence(
    slope_views: TileViews,
    slope_arrays: SlopeArrays,
    lattice: HeightLattice,
    windows: NDArray[np.int64],
    visible: VisibleHeights,
    parameters: CostParameters,
    taught_heights: TaughtHeights,
) -> TableAndCounts:
    """The table of a level, counted at heights that are known already.

    slope_views, slope_arrays, lattice, windows, visible, parameters : as for the costs, see `tile_costs`.
    """
    n_views = len(slope_views.layout)
    n_covering = usual_number(visible, np.isfinite(taught_heights.height))
    log_every = log_of_sampling(taught_heights.height.size, n_covering)
    noise, grey_unit = noise_variance(slope_views), np.ones((n_views, n_views), np.float32)

    def counted(log_every: int, wrong_every: int) -> Learning:
        reference = sampled_blocks(taught_heights.height, lattice.block, log_every)
        learning = nothing_counted(n_views, reference, wrong_every)
        counting = TableAndCounts(NO_TABLE._replace(noise_variance=noise, grey_unit=grey_unit), learning)
        volume = np.zeros(lattice.size, np.uint8)
        tile_costs(
            slope_views.arrays, slope_arrays, lattice.layout, windows, visible, parameters, counting, volume
        )  # fmt: skip
        return learning

    if n_views > PAIR:
        of_few = counted(min(log_every + UNIT_LOG_EVERY, len(ROW_SHIFTS) - 1), wrong_every=0)
        grey_unit = grey_units(of_few.grey_roots, of_few.right_of_pair.sum(axis=2))
    learning = counted(log_every, WRONG_EVERY)
    of_right, of_wrong = (counts[:-1].reshape(TABLE_SHAPE) for counts in (learning.right, learning.wrong))
    ratios, neutral = log_ratios(of_right, of_wrong, PRIOR_COUNTS / 2**log_every)
    table = np.append(ratios.ravel(), np.float32(0.0)).astype(np.float32)
    factor = UNIT_FACTOR_PER_LEVEL**taught_heights.level
    found = EvidenceTable(
        log_ratios=table,
        noise_variance=noise,
        unit=np.float32(UNIT_COST * factor),
        small_window_unit=np.float32(SMALL_WINDOW_UNIT_COST * factor),
        highest=np.float32(ratios.max()),
        neutral=np.float32(neutral),
        pair_exponent=np.float32(PAIR_EXPONENT),
        max_cost=np.float32(MAX_MIDDLE_COST),
        grey_unit=grey_unit,
        worth=worth_of_pairs(learning.right_of_pair, learning.wrong_of_pair),
        best_share=np.float32(best_share_of(n_covering)),
    )
    return TableAndCounts(found, NO_COUNTS)


def best_share_of(n_covering: float) -> float:
    """The share of the pairs that counts as evidence where so many views cover the cells: see BEST_SHARE."""
    return BEST_SHARE if n_covering < MANY_VIEWS else BEST_SHARE_OF_MANY


def nothing_counted(n_views: int, reference: NDArray[np.float32], wrong_every: int) -> Learning:
    """Counts of 0, for heights (r, c) that count as right, and wrong heights at one of so many indices (0: none)."""
    # One more bin, because a likeness is counted at the nearest bin.
    of_bins, of_pair = int(np.prod(TABLE_SHAPE)) + 1, (n_views, n_views)
    right, wrong = np.zeros(of_bins, np.int64), np.zeros(of_bins, np.int64)
    right_of_pair, wrong_of_pair = (np.zeros((*of_pair, N_LIKENESS), np.int64) for _ in range(2))
    return Learning(reference, np.int64(wrong_every), right, wrong, right_of_pair, wrong_of_pair, np.zeros(of_pair))


def grey_units(grey_roots: NDArray[np.float64], n_differences: NDArray[np.int64]) -> NDArray[np.float32]:
    """Usual grey difference of each pair of views, as a multiple of that of all pairs, (i, i) float32.

    grey_roots : (i, i), sums of the roots of the grey differences at right heights; n_differences : (i, i), how many
    they are. Only views in ascending order are counted. Images of one pass differ less than those of different days:
    in units of its own a difference says as much in each pair.
    """
    of_all = grey_roots.sum() / max(n_differences.sum(), 1)
    if of_all == 0:
        return np.ones(grey_roots.shape, np.float32)
    more = GREY_DIFFERENCES_OF_ALL_PAIRS
    unit = ((grey_roots + more * of_all) / (n_differences + more) / of_all) ** 2
    upper = np.triu(unit, 1)
    return np.asarray(upper + upper.T + np.eye(len(unit)), np.float32)


def log_ratios(
    right: NDArray[np.int64], wrong: NDArray[np.int64], prior_counts: float
) -> tuple[NDArray[np.float32], float]:
    """Log-likelihood ratios of the bins from their counts, and the value that stands for no evidence.

    right, wrong : `TABLE_SHAPE`, counts; prior_counts : see PRIOR_COUNTS. The ratios are shifted so that their mean at
    wrong heights is 0: a pair in which a view is occluded adds 0, and must be worth as much as a pair that compares
    what does not belong together.
    """
    of_right, of_wrong = smoothed_counts(right), smoothed_counts(wrong)
    n_right, n_wrong = max(of_right.sum(), 1.0), max(of_wrong.sum(), 1.0)
    prior = prior_counts / n_right
    whole = np.log((of_right / n_right + prior) / (of_wrong / n_wrong + prior))
    right_of_any_grey, wrong_of_any_grey = (
        np.broadcast_to(counts.sum(axis=2, keepdims=True), counts.shape) for counts in (of_right, of_wrong)
    )
    without_grey = np.log((right_of_any_grey / n_right + prior) / (wrong_of_any_grey / n_wrong + prior))
    ratios = without_grey + GREY_SHARE * (whole - without_grey)
    share = rough_share()
    ratios = np.log((1 - share) * np.exp(ratios) + share * rough_ratios(of_right, of_wrong, prior_counts))
    ratios = np.clip(ratios, -MAX_LOG_RATIO, MAX_LOG_RATIO)
    neutral = -float((of_wrong * ratios).sum() / n_wrong)
    return (ratios + neutral).astype(np.float32), neutral


def rough_share() -> NDArray[np.float64]:
    """Share of right heights that are those of rough surfaces, by bin of contrast, (c, 1, 1, 1): see ROUGH_SHARE."""
    contrast, bins = np.arange(TABLE_SHAPE[0]), FULL_ROUGH_CONTRAST - FIRST_ROUGH_CONTRAST
    share = ROUGH_SHARE * np.clip((contrast - FIRST_ROUGH_CONTRAST) / bins, 0.0, 1.0)
    return np.asarray(share[:, None, None, None])


def rough_ratios(
    of_right: NDArray[np.float64], of_wrong: NDArray[np.float64], prior_counts: float
) -> NDArray[np.float64]:
    """Likelihood ratios of right heights of rough surfaces, over wrong heights, `TABLE_SHAPE`.

    of_right, of_wrong : `TABLE_SHAPE`, smoothed counts; prior_counts : see PRIOR_COUNTS. Among windows of one contrast,
    the frequency of a likeness and grey difference at wrong heights is tilted by an exponential function of the two
    (Esscher 1932), so that their means move towards those of right heights, see ROUGH_DISTANCE. Where both have the
    same means, as in plain windows, the ratio is 1. It does not fall to nothing where no counted window was as little
    alike, so that the more alike of two heights of a tree is still the more likely one.
    """
    of_features = (2, 3)
    likeness = np.linspace(-1.0, 1.0, TABLE_SHAPE[3])[None, :]
    grey = np.linspace(0.0, 1.0, TABLE_SHAPE[2])[:, None]
    n_right = of_right.sum(axis=of_features, keepdims=True)
    right, wrong = (
        (counts + LEAST_COUNT) / (counts + LEAST_COUNT).sum(axis=of_features, keepdims=True)
        for counts in (of_right, of_wrong)
    )
    distance = ROUGH_DISTANCE * n_right / (n_right + ROUGH_PRIOR_BINS * prior_counts)
    exponent = np.zeros(TABLE_SHAPE)
    for feature in (likeness, grey):
        mean_right, mean_wrong = ((share * feature).sum(axis=of_features, keepdims=True) for share in (right, wrong))
        variance = (wrong * (feature - mean_wrong) ** 2).sum(axis=of_features, keepdims=True)
        slope = distance * (mean_right - mean_wrong) / (variance + LEAST_VARIANCE_OF_FEATURE)
        exponent += slope * (feature - mean_wrong)
    tilt = np.exp(exponent - exponent.max(axis=of_features, keepdims=True))
    return np.asarray(tilt / (wrong * tilt).sum(axis=of_features, keepdims=True))


def worth_of_pairs(right: NDArray[np.int64], wrong: NDArray[np.int64]) -> NDArray[np.float32]:
    """How well each pair of views tells right heights from wrong ones, natural units, (i, i) float32.

    right, wrong : (i, i, k), how often each likeness of a pair occurs at them; only those of views in ascending order
    are counted. The worth is the divergence of the two frequencies (Jeffreys 1946): the mean log-likelihood ratio at
    right heights less that at wrong ones. Two images of one pass are worth more than two of different days.
    """
    of_right, of_wrong = (
        counts + COUNTS_OF_ALL_PAIRS * (counts.sum(axis=(0, 1)) + 1) / (counts.sum() + counts.shape[2])
        for counts in (right, wrong)
    )
    of_right, of_wrong = (counts / counts.sum(axis=2, keepdims=True) for counts in (of_right, of_wrong))
    divergence = ((of_right - of_wrong) * np.log(of_right / of_wrong)).sum(axis=2)
    upper = np.triu(np.maximum(divergence, LEAST_WORTH), 1)
    return np.asarray(upper + upper.T, np.float32)


def smoothed_counts(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Counts of which each bin shares some with its neighbours along contrast, grey difference and likeness."""
    wide = np.pad(counts.astype(np.float64), [(1, 1), (0, 0), (0, 0), (0, 0)], mode="edge")
    smooth = (2 * wide[1:-1] + wide[:-2] + wide[2:]) / 4
    for _ in range(2):
        wide = np.pad(smooth, [(0, 0), (0, 0), (1, 1), (1, 1)], mode="edge")
        inner = wide[:, :, 1:-1, 1:-1]
        beside = wide[:, :, :-2, 1:-1] + wide[:, :, 2:, 1:-1] + wide[:, :, 1:-1, :-2] + wide[:, :, 1:-1, 2:]
        smooth = (4 * inner + beside) / 8
    return smooth


def noise_variance(slope_views: TileViews) -> np.float32:
    """Variance of the noise of the images of a level, in units of the grey variance of an image: of the windows with
    the least texture."""
    found = []
    for offset, rows, cols in slope_views.layout:
        grey = slope_views.arrays.pixels[offset : offset + rows * cols].reshape(rows, cols)
        mean, squares = cv2.blur(grey, NOISE_WINDOW), cv2.blur(grey * grey, NOISE_WINDOW)
        variance = (squares - mean * mean)[::NOISE_EVERY, ::NOISE_EVERY]
        variance = variance[variance > LEAST_VARIANCE]
        if variance.size:
            found.append(float(np.quantile(variance, NOISE_SHARE)))
    return np.float32(rounded(float(np.mean(found)))) if found else np.float32(LEAST_VARIANCE)


def log_of_sampling(n_cells: int, n_covering: float) -> int:
    """k, where one of 2^k blocks of a level of so many cells is counted, which so many views cover."""
    n_pairs, n_enough = n_covering * (n_covering - 1.0), VIEWS_OF_LEAST_CELLS * (VIEWS_OF_LEAST_CELLS - 1)
    least_cells = LEAST_CELLS * min(1.0, n_enough / max(n_pairs, 1.0))
    return max((k for k in range(len(ROW_SHIFTS)) if n_cells >> k >= least_cells), default=0)


def sampled_blocks(reference: NDArray[np.float32], block: int, log_every: int) -> NDArray[np.float32]:
    """Reference heights (r, c) of one of 2^log_every blocks, NaN elsewhere."""
    row, col = np.arange(reference.shape[0]) // block, np.arange(reference.shape[1]) // block
    is_taken = (col[None, :] + ROW_SHIFTS[log_every] * row[:, None]) % 2**log_every == 0
    return np.where(is_taken, reference, np.float32(np.nan)).astype(np.float32)


def trusted_heights(result: LevelResult) -> NDArray[np.float32]:
    """Heights of a level that its evidence can be learned from, (r, c) level indices, NaN at jumps."""
    height = result.heights.vertex
    around = np.ones((3, 3), np.uint8)
    across = cv2.dilate(height, around) - cv2.erode(height, around)
    return np.where(across < MAX_STEPS_ACROSS, height, np.float32(np.nan)).astype(np.float32)


def heights_to_learn_from(
    result: LevelResult, level: PyramidLevel, slope_surface: SlopeSurface
) -> TaughtHeights | None:
    """Heights that the evidence of a level is learned from; none outside the tile's core.

    result : of an earlier pass over the level, or of the next coarser one. None where it has too few such heights.
    """
    trusted = trusted_heights(result)
    if result.level.number != level.number:
        trusted = np.float32(2.0) * on_cells(trusted, result.level.window, level.window)
    of_core = np.full(level.shape, np.nan, np.float32)
    of_core[level.core] = (trusted - slope_surface.cells)[level.core]
    return TaughtHeights(of_core, level.number) if np.isfinite(of_core).sum() >= MIN_TRUSTED_CELLS else None
