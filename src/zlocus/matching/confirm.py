"""Matching back: whether the heights that two images found for themselves are the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.gc3 import ImageSpace, shift_rates

ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class MatchedImage:
    """What was found for the pixels of an image.

    height : (r, c) float32 hypotheses, NaN where empty; middle : of the hypotheses that were searched.
    """

    space: ImageSpace
    height: NDArray[np.float32]
    middle: float

    def px_per_unit(self, other: str) -> float:
        """Equivalent disparity against another view of a unit of the hypothesis; NaN where they share no ground."""
        (view,) = (view for view in self.space.views if view.name == other)
        rates = shift_rates(self.space, view, self.middle)
        return float(np.median(rates[np.isfinite(rates)])) if np.isfinite(rates).any() else float("nan")


@dataclass(frozen=True)
class Confirmation:
    """How many other images agree with each height, see something farther (through it), or nearer (which hides it):
    each (r, c) uint8."""

    agreeing: NDArray[np.uint8]
    farther: NDArray[np.uint8]
    nearer: NDArray[np.uint8]

    @property
    def is_confirmed(self) -> NDArray[np.bool_]:
        """(r, c): where more images agree than look through it; so at least one does."""
        return np.asarray(self.agreeing > self.farther)


def confirm(
    mine: MatchedImage, others: Sequence[MatchedImage], tolerance_px: float
) -> Iterator[tuple[slice, Confirmation]]:
    """Compare every height of an image with those of the others, where they show the same ground; some rows of the
    image after others.

    A height becomes a ground point, which is at a pixel (the nearest) and at a hypothesis of each other image; that
    image's own hypothesis there agrees when it differs by no more than `tolerance_px` of equivalent disparity of the
    two. Pixels without a height have no say.
    """
    sharing = [(other, rate) for other in others if np.isfinite(rate := other.px_per_unit(mine.space.reference.name))]
    for row in range(0, len(mine.height), ROWS_AT_ONCE):
        rows = slice(row, min(row + ROWS_AT_ONCE, len(mine.height)))
        part = mine.height[rows]
        counts, known = np.zeros((3, *part.shape), np.uint8), np.isfinite(part)
        ground = mine.space.ground(row, part)[known]
        for other, px_per_unit in sharing:
            differs = difference(other, ground) * px_per_unit
            for count, where in zip(
                counts, (np.abs(differs) <= tolerance_px, differs < -tolerance_px, differs > tolerance_px), strict=True
            ):
                count[known] += where
        yield rows, Confirmation(counts[0], counts[1], counts[2])


def difference(image: MatchedImage, ground: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hypotheses by which an image's heights are nearer to it than ground points (n, 3) m; NaN where it has none.
    -> (n,)"""
    at = image.space.frame_from_ground(ground)
    rows, cols = image.height.shape
    with np.errstate(invalid="ignore"):
        col, row = np.rint(at[:, 0]), np.rint(-at[:, 1])
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    own = np.full(len(ground), np.nan)
    own[inside] = image.height[row[inside].astype(int), col[inside].astype(int)]
    return np.asarray(own - at[:, 2])
