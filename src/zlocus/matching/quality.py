"""Quality flags: the reasons why a cell has no height, or a doubtful one."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class Quality(IntFlag):
    """Bits of `quality.tif`. A cell with one of the first eight has no height; the others are warnings."""

    OUTSIDE = 1  # outside the area that was asked for, or inside a mask
    UNSEEN = 2  # fewer than two images cover the cell at the ground's height, or agree on a height above it
    OCCLUDED = 4  # fewer than two images see the surface here; in the others it is occluded
    RANGE_END = 8  # the best match is at an end of the height range; the true height may lie beyond it
    NO_MATCH = 16  # the images do not agree at any height, or the heights at the edge of the overlap are noise
    FAILED = 32  # the tile could not be processed
    INCONSISTENT = 64  # the height failed the cross-consistency check with the other images (image space only)
    IMPRECISE = 128  # the standard deviation of the height is too large, see checks.max_sigma_m
    WEAK = 256  # the images agree poorly
    AMBIGUOUS = 512  # another height fits nearly as well
    JUMP = 1024  # next to a jump in height
    UNREFINED = 2048  # uncertain, and without sub-step refinement: the height is that of the semi-global constraint
    FILLED = 4096  # no match; the height is interpolated from the neighbours
    DISPUTED = 8192  # uncertain, and two groups of image pairs find different heights around the cell
    IMAGE_EXCLUDED = 16384  # an image that may show the cell was not used: its mask covers it, or it is too oblique
    PLANE = 32768  # without texture of its own; the height is that of a plane fitted to the whole segment
    # Both bits together, which no other cell has: water, whose height is the level of its whole surface.
    WATER = FILLED | PLANE
    # Both at once: masks left fewer than two images.
    MASKED = UNSEEN | IMAGE_EXCLUDED


# As docs/reference/quality.md has them; a test keeps them the same.
MEANINGS = {
    Quality.OUTSIDE: "outside the area that was asked for, or inside a mask",
    Quality.UNSEEN: "fewer than two images cover the cell at the ground's height, or agree on a height above it",
    Quality.OCCLUDED: "fewer than two images see the surface here; in the others it is occluded",
    Quality.RANGE_END: "the best match is at an end of the height range; the true height may lie beyond it",
    Quality.NO_MATCH: "the images do not agree at any height, or the heights at the edge of the overlap are noise",
    Quality.FAILED: "the tile could not be processed",
    Quality.INCONSISTENT: "the height failed the cross-consistency check with the other images (image space only)",
    Quality.IMPRECISE: "the standard deviation of the height is too large, see checks.max_sigma_m",
    Quality.WEAK: "the images agree poorly",
    Quality.AMBIGUOUS: "another height fits nearly as well",
    Quality.JUMP: "next to a jump in height",
    Quality.UNREFINED: "uncertain, and without sub-step refinement: the height is that of the semi-global constraint",
    Quality.FILLED: "no match; the height is interpolated from the neighbours",
    Quality.DISPUTED: "uncertain, and two groups of image pairs find different heights around the cell",
    Quality.IMAGE_EXCLUDED: "an image that may show the cell was not used: its mask covers it, or it is too oblique",
    Quality.PLANE: "without texture of its own; the height is that of a plane fitted to the whole segment",
    Quality.WATER: "water; the height is the level of its whole surface (the bits FILLED and PLANE together)",
}

EMPTY = (
    Quality.OUTSIDE | Quality.UNSEEN | Quality.OCCLUDED | Quality.RANGE_END | Quality.NO_MATCH | Quality.FAILED
    | Quality.INCONSISTENT | Quality.IMPRECISE
)  # fmt: skip


def is_water(quality: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """(r, c) bool: cells of water surfaces that were levelled, by their flags. quality : (r, c) uint16."""
    return np.asarray((quality & np.uint16(Quality.WATER)) == np.uint16(Quality.WATER))


def flags_of(code: int) -> list[Quality]:
    """The flags in a value of quality.tif, WATER in place of its two bits."""
    if (code & Quality.WATER) == Quality.WATER:
        return [*(flag for flag in Quality if code & flag and not flag & Quality.WATER), Quality.WATER]
    return [flag for flag in Quality if code & flag]


def with_filled(quality: NDArray[np.uint16], is_filled: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """(r, c) uint16: flags of a surface whose gaps were filled. A filled cell has no plane of its own any more."""
    return np.where(is_filled, (quality | np.uint16(Quality.FILLED)) & ~np.uint16(Quality.PLANE), quality)


def is_empty(quality: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """(r, c) bool: cells without a height, by their flags. A filled cell has one. quality : (r, c) uint16."""
    return np.asarray(((quality & EMPTY) != 0) & ((quality & Quality.FILLED) == 0))
