"""Decides which heights are kept, and says why others are not."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import CheckOptions
from zlocus.matching.quality import Quality
from zlocus.matching.semiglobal import SemiGlobalHeights
from zlocus.matching.subpixel import RefinedHeights

JUMP_STEPS = 3.0
AROUND = np.ones((3, 3), np.uint8)


def judge(
    heights: SemiGlobalHeights,
    refined: RefinedHeights,
    n_covering: NDArray[np.integer],
    n_seeing: NDArray[np.integer],
    apart: NDArray[np.float32],
    last_index: int,
    options: CheckOptions,
) -> NDArray[np.uint16]:
    """Reasons of every cell, (r, c) uint16.

    n_covering : images that cover the cell at any height; n_seeing : images that see the surface there; apart : (r, c)
    float32 steps, between the heights of two groups of pairs of images, around the cell (what matching from another
    reference image checks where there is one); last_index : highest height index of the scene.
    """
    quality = np.zeros(heights.best.shape, np.uint16)

    def mark(where: NDArray[np.bool_], reason: Quality) -> None:
        quality[where] |= np.uint16(reason)

    mark(n_covering < 2, Quality.UNSEEN)
    mark((n_covering >= 2) & (n_seeing < 2), Quality.OCCLUDED)
    seen = n_seeing >= 2
    mark(seen & ((heights.best <= 0) | (heights.best >= last_index)), Quality.RANGE_END)
    mark(seen & (refined.ncc < options.min_ncc), Quality.NO_MATCH)
    mark(seen & (refined.ncc < options.weak_ncc), Quality.WEAK)
    mark(heights.uniqueness < options.min_uniqueness, Quality.AMBIGUOUS)
    mark(cv2.dilate(refined.height, AROUND) - cv2.erode(refined.height, AROUND) > JUMP_STEPS, Quality.JUMP)
    mark(~refined.is_refined, Quality.UNREFINED)
    mark(seen & (apart > options.disputed_steps), Quality.DISPUTED)
    return quality
