"""What a ranking says to somebody who chooses or buys images: which to keep, which to drop, and which is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import SelectionOptions
from zlocus.core.scene import View
from zlocus.matching.match_curve import FAIR
from zlocus.matching.pair_labels import LabelledTies

# An image is to be dropped where its labels are poor at more than this share of the points with every other image.
MAX_POOR_SHARE = 0.5
# A height takes two images, and a third one shows what one of the two does not.
WANTED_IMAGES = 3


@dataclass(frozen=True)
class SharedPoints:
    """Tie points that both images of a pair show.

    n_shared : (i, i) int64, how many there are; n_poor : (i, i) int64, at how many of them the pair is labelled poor.
    """

    n_shared: NDArray[np.int64]
    n_poor: NDArray[np.int64]

    @classmethod
    def of(cls, labelled_ties: Sequence[LabelledTies], views: Sequence[View]) -> SharedPoints:
        """Count the points of all tiles. views : of the scene, to which the numbers in `labelled_ties` refer."""
        counted = cls(*(np.zeros((len(views), len(views)), np.int64) for _ in range(2)))
        for part in labelled_ties:
            shown = np.stack([_is_inside(views[number], part.xyz) for number in part.views], axis=1)
            is_shared = shown[:, :, None] & shown[:, None, :] & ~np.eye(len(part.views), dtype=np.bool_)
            at = np.ix_(part.views, part.views)
            counted.n_shared[at] += is_shared.sum(axis=0)
            counted.n_poor[at] += (is_shared & (part.labels < FAIR)).sum(axis=0)
        return counted

    @property
    def least_poor_share(self) -> NDArray[np.float64]:
        """Share of the points at which an image is labelled poor against the image that it goes best with, (i,); NaN
        where it shares no point with another one."""
        share = np.where(self.n_shared > 0, self.n_poor / np.maximum(self.n_shared, 1), np.inf)
        least = share.min(axis=1, initial=np.inf)
        return np.where(np.isinf(least), np.nan, least)


def _is_inside(view: View, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which ground points (n, 3) m lie inside an image, (n,) bool."""
    col, row = view.sensor.image_from_ground(xyz).T
    rows, cols = view.image.shape
    return np.asarray((col >= 0) & (col <= cols - 1) & (row >= 0) & (row <= rows - 1))


def advice(
    shared_points: SharedPoints, rates: NDArray[np.float64], names: Sequence[str], options: SelectionOptions
) -> list[str]:
    """Sentences that say which images to keep, which to drop and which to buy.

    rates : (i, 2), parallax rate of each image (m of ground for each m of height), from which the angles between the
    rays follow.
    """
    poor, numbers = shared_points.least_poor_share, range(len(names))
    dropped = [i for i in numbers if poor[i] > MAX_POOR_SHARE]
    unknown = [i for i in numbers if np.isnan(poor[i])]
    kept = [i for i in numbers if i not in (*dropped, *unknown)]
    sentences = [f"Keep {', '.join(names[i] for i in kept)}."] if kept else []
    if dropped:
        of_each = ", ".join(f"{names[i]} ({100 * poor[i]:.0f} %)" for i in dropped)
        sentences.append(
            f"Drop {of_each}: at so many of the points that they share, no match can be had even with the image that "
            "goes best with it."
        )
    if unknown:
        sentences.append(
            f"Nothing can be said of {', '.join(names[i] for i in unknown)}: no tie point lies in it and in another "
            "image."
        )
    apart = np.linalg.norm(rates[kept][:, None] - rates[kept][None], axis=-1)
    angles_deg = np.degrees(np.arctan(apart[np.triu_indices(len(kept), 1)]))
    return [*sentences, missing_image(len(kept), angles_deg, options)]


def missing_image(n_images: int, angles_deg: NDArray[np.float64], options: SelectionOptions) -> str:
    """One sentence: from where an image would help that is not there.

    n_images : how many are kept; angles_deg : (p,) between the rays of each two of them, finite; p is at least 1 where
    two or more are kept.
    """
    low, best, high = options.min_angle_deg, options.best_angle_deg, options.max_angle_deg
    if n_images < 2:
        return f"Buy images that match: two or more, whose rays differ by {low:g} to {high:g} degrees."
    if angles_deg.max() < low:
        return (
            f"Buy an image that looks from about {best:g} degrees away: the rays of these differ by "
            f"{angles_deg.max():.1f} degrees at most, so that their heights are imprecise."
        )
    if angles_deg.min() > high:
        return (
            f"Buy an image between these: their rays differ by {angles_deg.min():.1f} degrees and more, and beyond "
            f"{high:g} degrees walls and crowns look too different."
        )
    if n_images < WANTED_IMAGES:
        return "Buy a third image from the other side of one of these: it shows what the other one does not see."
    return f"No direction is missing: the rays of {n_images} images differ by up to {angles_deg.max():.1f} degrees."
