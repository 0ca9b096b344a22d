"""What tie points say of the cameras as delivered: which images nothing supports, and which cameras are doubtful."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import OrientationOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.shift_adjustment import Adjustment, adjust, renumbered, robust_sigma
from zlocus.orientation.triangulate import Observations

# An image takes part in the matching where so many tie points were found in it.
MIN_TIES_OF_IMAGE = 4
# An image contradicts the others where they leave less than this share of its tie points. Of images whose cameras are
# their own at least 0.74 were left (nineteen satellite images of ten months); of exchanged ones at most 0.35.
MIN_AGREEING_SHARE = 0.5
# So many others must remain that agree with each other, or nobody can tell which images are wrong.
MIN_AGREEING_IMAGES = 3
# Cameras are doubted where the median residual of their ties is larger, or where their images had to be moved farther,
# than those of any satellite, aircraft or drone that are in order.
MAX_USUAL_RESIDUAL_PX = 0.3
MAX_USUAL_SHIFT_PX = 60.0
# Share of the trusted tie points that may lie outside the heights for which the sensor models were made.
MAX_SHARE_OUTSIDE_RANGE = 0.01
# Two sensor models are said to be exchanged where the ties fit this much better with them exchanged: by their noise, or
# by the share that agrees. Looked for among so many images, with so many tie points.
MAX_NOISE_RATIO, MIN_GAIN_OF_SHARE = 0.5, 0.1
MAX_IMAGES_TO_EXCHANGE, TIES_TO_COMPARE = 6, 400
MEANINGFUL_NOISE_PX = 0.1


@dataclass(frozen=True)
class ExcludedImage:
    """An image that takes no part in the matching. reason : a sentence without its name."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name} takes no part: {self.reason}"


@dataclass(frozen=True)
class Doubt:
    """What makes a camera, or all of them, doubtful. is_grave : heights are likely to be wrong."""

    sentence: str
    is_grave: bool = False

    def as_dict(self) -> dict[str, Any]:
        """For run.json."""
        return {"sentence": self.sentence, "is_grave": self.is_grave}


def untied_images(found: Observations, n_views: int) -> NDArray[np.bool_]:
    """(i,) images in which too few tie points were found for them to take part. found : observations of all ties."""
    return np.asarray(np.bincount(found.view, minlength=n_views) < MIN_TIES_OF_IMAGE)


def agreeing_shares(found: Observations, adjustment: Adjustment, n_views: int) -> FloatArray:
    """(i,) share of the observations of each image that agree with those of the other images; 1 for those without any.

    found : all observations that were adjusted.
    """
    of_view = np.bincount(found.view, minlength=n_views)
    kept = np.bincount(adjustment.observations.view, minlength=n_views)
    return np.where(of_view > 0, kept / np.maximum(of_view, 1), 1.0)


def contradicting_views(shares: FloatArray) -> NDArray[np.int64]:
    """Numbers of the images that contradict the others, the worst first."""
    worst = np.argsort(shares, kind="stable")
    return np.asarray(worst[shares[worst] < MIN_AGREEING_SHARE], np.int64)


def doubts_about(
    views: Sequence[View],
    residual_px: Sequence[float],
    shift_px: Sequence[tuple[float, float]],
    heights: FloatArray,
) -> list[Doubt]:
    """Doubts about cameras after their correction.

    residual_px : (i,) median length of the ties' residuals of each image; shift_px : (i, 2) by which they were moved;
    heights : (n,) m, ellipsoidal, of the tie points that their neighbours confirm.
    """
    doubts = []
    for view, residual, shift in zip(views, residual_px, shift_px, strict=True):
        far = float(np.hypot(*shift))
        if residual > MAX_USUAL_RESIDUAL_PX:
            doubts.append(
                Doubt(
                    f"{view.name}: its tie points still lie {residual:.2f} px off after the correction (median), more "
                    "than cameras that are in order show. Try `zlocus orient`, or ask for better cameras."
                )
            )
        if far > MAX_USUAL_SHIFT_PX:
            doubts.append(
                Doubt(
                    f"{view.name}: its camera pointed {far:.0f} px off and was corrected, farther than such sensors "
                    "err. Check that the camera belongs to this image."
                )
            )
    return doubts + _outside_range(views, heights)


def _outside_range(views: Sequence[View], heights: FloatArray) -> list[Doubt]:
    """A doubt where tie points lie at heights for which the sensor models were not made."""
    bounds = [bound for view in views if (bound := view.sensor.height_bounds()) is not None]
    if not bounds or not len(heights):
        return []
    low, high = max(low for low, _ in bounds), min(high for _, high in bounds)
    outside = (heights < low) | (heights > high)
    if outside.mean() <= MAX_SHARE_OUTSIDE_RANGE:
        return []
    return [
        Doubt(
            f"{int(outside.sum())} of {len(heights)} tie points lie at heights of {heights.min():.0f} to "
            f"{heights.max():.0f} m, outside the {low:.0f} to {high:.0f} m for which the cameras were made. Check that "
            "each camera belongs to its image, and that none is exchanged with another.",
            is_grave=True,
        )
    ]


def exchanged_views(
    sensors: Sequence[SensorModel],
    found: Observations,
    xyz: FloatArray,
    candidates: Sequence[int],
    options: OrientationOptions,
) -> tuple[int, int] | None:
    """Two images whose sensor models seem to be exchanged: with each other's the ties fit clearly better.

    found, xyz : observations and first ground points (n, 3) m of the ties; candidates : numbers of the images to look
    at. Two images from one pass, whose rays lie in parallel planes, fit as well either way.
    """
    points = np.unique(found.point)
    few = found.kept(np.isin(found.point, points[:: max(len(points) // TIES_TO_COMPARE, 1)]))
    noise, share = _fit(sensors, few, xyz, options)
    if noise <= MEANINGFUL_NOISE_PX and share >= 1.0 - MIN_GAIN_OF_SHARE:
        return None
    best: tuple[int, int] | None = None
    for a, b in combinations(sorted(candidates)[:MAX_IMAGES_TO_EXCHANGE], 2):
        exchanged = list(sensors)
        exchanged[a], exchanged[b] = exchanged[b], exchanged[a]
        its_noise, its_share = _fit(exchanged, few, xyz, options)
        is_quieter = noise > MEANINGFUL_NOISE_PX and its_noise < MAX_NOISE_RATIO * noise and its_share >= share
        if is_quieter or its_share > share + MIN_GAIN_OF_SHARE:
            best, noise, share = (a, b), its_noise, its_share
    return best


def _fit(
    sensors: Sequence[SensorModel], found: Observations, xyz: FloatArray, options: OrientationOptions
) -> tuple[float, float]:
    """Noise of the ties (px) after shifts of all images, and the share of the observations that agree with them."""
    observations, start = renumbered(found, xyz)
    shifted = adjust(sensors, observations, start, replace(options, model="shift"))
    return robust_sigma(shifted.ground_points.residual), len(shifted.observations) / max(len(observations), 1)
