"""How each image votes on the height of a cell: its correlation with the other images there, and where it is largest.

Windows are those of `zlocus.matching.point_match.cell_windows`: level, of mean 0 and length 1, so that the product of
two is their correlation.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.matching.height_checks import MAX_DIFFERENCE_WITHOUT_JUMP_STEPS

# An image votes for another height where its correlation is larger by this there: less is noise of plain ground.
MIN_GAIN = 0.1
# An image that votes for no other height agrees from this correlation on.
MIN_CORRELATION = 0.5
# Fewer images than this cannot out-vote one.
MIN_VOTERS = 3


class Vote(Enum):
    """What the correlation of an image with the others says of a height."""

    AGREES = "agrees"
    UNDECIDED = "undecided"  # it says no more for another height, and little for this one
    OUT_VOTED = "out-voted"  # it matches best elsewhere, and the others agree better here than there
    OVERRULED = "overruled"  # it matches best elsewhere, and so do the others


@dataclass(frozen=True)
class ImageVote:
    """The vote of one image.

    vote : see `Vote`; correlation : mean with the others at the height of the cell; peak : number of the height where
    it is largest; at_peak : how large; others, others_at_peak : mean correlation of the other images with each other,
    at the height of the cell and at that peak, NaN where there are fewer than two; n_others : how many they are.
    """

    vote: Vote
    correlation: float
    peak: int
    at_peak: float
    others: float
    others_at_peak: float
    n_others: int


def votes_of_images(
    windows: NDArray[np.floating], takes_part: NDArray[np.bool_], height: int
) -> list[ImageVote | None]:
    """The vote of every image on a height; None of images that do not take part, or show no window at that height.

    windows : (i, h, k), NaN where an image does not show them; takes_part : (i,), which images are not occluded;
    height : number of the height of the cell.
    """
    shown = ~np.isnan(windows[..., 0]) & takes_part[:, None]
    known = np.where(shown[..., None], windows, 0.0).astype(np.float64)
    total, count = known.sum(axis=0), shown.sum(axis=0)
    n_taking_part = int(shown[:, height].sum())
    image_votes: list[ImageVote | None] = []
    for i in range(len(windows)):
        if not shown[i, height] or n_taking_part < 2:
            image_votes.append(None)
            continue
        rest, n_rest = total - known[i], count - shown[i]
        own = _mean((known[i] * rest).sum(axis=-1), np.where(shown[i], n_rest, 0))
        # The sum of the products of all pairs is half of the square of the sum less the squares.
        squares = np.where(np.arange(len(windows))[:, None] == i, 0.0, shown).sum(axis=0)
        others = _mean(((rest * rest).sum(axis=-1) - squares) / 2, n_rest * (n_rest - 1) / 2)
        image_votes.append(_vote(own, others, height, n_taking_part))
    return image_votes


def _mean(total: FloatArray, count: NDArray[np.floating]) -> FloatArray:
    """Sums (h,) over numbers of values (h,); NaN where there are none."""
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _vote(own: FloatArray, others: FloatArray, height: int, n_taking_part: int) -> ImageVote:
    """The vote of an image. own, others : (h,) correlations, see `ImageVote`."""
    peak = int(np.nanargmax(own))
    gain = own[peak] - own[height]
    is_near = abs(peak - height) <= MAX_DIFFERENCE_WITHOUT_JUMP_STEPS
    if is_near or gain < MIN_GAIN:
        vote = Vote.AGREES if is_near or own[height] >= MIN_CORRELATION else Vote.UNDECIDED
    elif n_taking_part >= MIN_VOTERS and others[height] > others[peak]:
        vote = Vote.OUT_VOTED
    else:
        vote = Vote.OVERRULED
    return ImageVote(
        vote, float(own[height]), peak, float(own[peak]), float(others[height]), float(others[peak]), n_taking_part - 1
    )  # fmt: skip
