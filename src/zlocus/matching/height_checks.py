"""Quality flags of the heights: which cells have no height or a doubtful one, and why."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import CheckOptions
from zlocus.matching.quality import Quality
from zlocus.matching.semiglobal import SemiGlobalHeights
from zlocus.matching.subpixel import RefinedHeights

# Height difference between neighbouring cells from which on both are marked as next to a jump.
MAX_DIFFERENCE_WITHOUT_JUMP_STEPS = 3.0
NEIGHBOURS = np.ones((3, 3), np.uint8)
# The images do not agree where their mean correlation over a window of this side is too low. On plain ground the
# correlation of one cell is noise, and says nothing against a height that the cells around it share.
AROUND_CELLS = 9
# Less than the share of one cell of such a window, so that nothing is divided by 0.
LEAST_SHARE = np.float32(1e-3)


def judge(
    heights: SemiGlobalHeights,
    refined: RefinedHeights,
    n_covering: NDArray[np.integer],
    n_seeing: NDArray[np.integer],
    group_distance: NDArray[np.float32],
    sigma_steps: NDArray[np.float32],
    last_index: int,
    options: CheckOptions,
) -> NDArray[np.uint16]:
    """Quality flags of every cell, (r, c) uint16, see `Quality`.

    n_covering : (r, c), images that cover the cell at any height; n_seeing : (r, c), images that see the surface there;
    group_distance : (r, c) float32 steps, distance between the heights of two groups of image pairs around the cell
    (it takes the place of a cross-consistency check, which needs a reference image); sigma_steps : (r, c) float32,
    standard deviations of the heights; last_index : highest height index of the scene.

    DISPUTED and UNREFINED are signs of a wrong height that many right heights show, too. The standard deviation weighs
    all signs at once; where it is small they warn of nothing.
    """
    quality = np.zeros(heights.best.shape, np.uint16)

    def mark(where: NDArray[np.bool_], reason: Quality) -> None:
        quality[where] |= np.uint16(reason)

    mark(n_covering < 2, Quality.UNSEEN)
    mark((n_covering >= 2) & (n_seeing < 2), Quality.OCCLUDED)
    is_seen = n_seeing >= 2
    local_range = cv2.dilate(refined.height, NEIGHBOURS) - cv2.erode(refined.height, NEIGHBOURS)
    is_at_jump = local_range > MAX_DIFFERENCE_WITHOUT_JUMP_STEPS
    is_unlike = mean_around(refined.ncc, is_seen) < options.min_ncc
    is_unlike |= is_at_jump & (refined.ncc < options.min_ncc)
    mark(is_seen & ((heights.best <= 0) | (heights.best >= last_index)), Quality.RANGE_END)
    mark(is_seen & is_unlike, Quality.NO_MATCH)
    mark(is_seen & (refined.ncc < options.weak_ncc), Quality.WEAK)
    mark(heights.uniqueness < options.min_uniqueness, Quality.AMBIGUOUS)
    mark(is_at_jump, Quality.JUMP)
    is_uncertain = sigma_steps > options.uncertain_sigma_steps
    mark(is_uncertain & ~refined.is_refined, Quality.UNREFINED)
    mark(is_uncertain & is_seen & (group_distance > options.disputed_steps), Quality.DISPUTED)
    return quality


def mean_around(values: NDArray[np.float32], is_counted: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Mean over the window around every cell, (r, c) float32, of the cells that count; 0 where none does.

    values : (r, c); is_counted : (r, c) bool.
    """
    window, weight = (AROUND_CELLS, AROUND_CELLS), is_counted.astype(np.float32)
    total = cv2.blur(np.where(is_counted, values, np.float32(0.0)), window)
    return np.asarray(total / np.maximum(cv2.blur(weight, window), LEAST_SHARE), np.float32)
