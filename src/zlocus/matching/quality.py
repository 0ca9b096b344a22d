"""Why a cell has, lacks or deserves less trust in its height."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class Quality(IntFlag):
    """Bits of `quality.tif`. The first eight empty a cell, the others only warn."""

    OUTSIDE = 1  # not asked for: outside the area, or inside a mask
    UNSEEN = 2  # fewer than two images cover the cell at the ground's height, or support a height above it
    HIDDEN = 4  # fewer than two images see the surface there, the others are behind it
    RANGE_END = 8  # best match at an end of the height range: the true height may lie beyond it
    NO_MATCH = 16  # images do not agree at any height, or heights at the border are noise
    FAILED = 32  # its tile could not be processed
    UNCONFIRMED = 64  # no other image finds the same height when matched back (image space only)
    IMPRECISE = 128  # its standard deviation is larger than asked for (checks.most_sigma_m)
    WEAK = 256  # images agree poorly
    AMBIGUOUS = 512  # another height fits nearly as well
    JUMP = 1024  # next to a jump in height
    UNREFINED = 2048  # height to a fraction of a step only: sub-step refinement did not converge
    FILLED = 4096  # no match: interpolated from its neighbours
    DISPUTED = 8192  # two halves of the pairs of images find different heights around
    LEFT_OUT = 16384  # an image that may show the cell took no part: it sees it too obliquely for the tables
    PLANE = 32768  # too plain to be matched alone: height of a plane fitted to all of a plain segment


EMPTY = (
    Quality.OUTSIDE | Quality.UNSEEN | Quality.HIDDEN | Quality.RANGE_END | Quality.NO_MATCH | Quality.FAILED
    | Quality.UNCONFIRMED | Quality.IMPRECISE
)  # fmt: skip


def is_empty(quality: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Whether a cell has no height, from its reasons. quality : (r, c) uint16."""
    return np.asarray(((quality & EMPTY) != 0) & ((quality & Quality.FILLED) == 0))
