"""Plausibility of the delivered cameras: images that no tie supports, cameras that contradict others or look wrong."""

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

# An image takes part in the matching if it has at least so many tie points.
MIN_TIES_OF_IMAGE = 4
# An image contradicts the others if less than this share of its tie points agrees with them. With correct cameras at
# least 0.74 agreed (nineteen satellite images of ten months); with exchanged cameras at most 0.35.
MIN_AGREEING_SHARE = 0.5
# So many other images must agree with each other, or it cannot be known which images are wrong.
MIN_AGREEING_IMAGES = 3
# Cameras are doubted if the median residual of their ties, or the shift of their image, is larger than correct cameras
# of satellites, aircraft and drones show.
MAX_USUAL_RESIDUAL_PX = 0.3
MAX_USUAL_SHIFT_PX = 60.0
# Share of the trusted tie points that may lie outside the heights for which the sensor models were made.
MAX_SHARE_OUTSIDE_RANGE = 0.01
# Two sensor models count as exchanged if exchanging them reduces the noise of the ties to this share, or raises the
# share of ties that agree by this much. So many images are tried, with so many tie points.
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
    """A reason to doubt one camera, or all. is_grave : heights are likely to be wrong."""

    sentence: str
    is_grave: bool = False

    def as_dict(self) -> dict[str, Any]:
        """For run.json."""
        return {"sentence": self.sentence, "is_grave": self.is_grave}


def untied_images(observations: Observations, n_views: int) -> NDArray[np.bool_]:
    """Images (i,) with too few tie points to take part. observations : of all ties."""
    return np.asarray(np.bincount(observations.view, minlength=n_views) < MIN_TIES_OF_IMAGE)


def agreeing_shares(observations: Observations, adjustment: Adjustment, n_views: int) -> FloatArray:
    """Share (i,) of each image's observations that agree with those of the other images; 1 for images without any.

    observations : all that were adjusted; adjustment : which of them it kept.
    """
    of_view = np.bincount(observations.view, minlength=n_views)
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
    is_corrected: bool = True,
) -> list[Doubt]:
    """Doubts about the cameras.

    residual_px : (i,) median length of the residuals of each image's ties; shift_px : (i, 2), by which the images were
    moved; heights : (n,) m, ellipsoidal, of the trusted tie points; is_corrected : whether a correction was asked for.
    """
    doubts = []
    for view, residual, shift in zip(views, residual_px, shift_px, strict=True):
        far = float(np.hypot(*shift))
        if residual > MAX_USUAL_RESIDUAL_PX:
            doubts.append(Doubt(f"{view.name}: {_off(residual, is_corrected)}"))
        if far > MAX_USUAL_SHIFT_PX:
            doubts.append(
                Doubt(
                    f"{view.name}: its camera pointed {far:.0f} px off and was corrected, farther than such sensors "
                    "err. Check that the camera belongs to this image."
                )
            )
    return doubts + _outside_range(views, heights)


def _off(residual_px: float, is_corrected: bool) -> str:
    """What a large median residual of an image's ties means."""
    if is_corrected:
        return (
            f"its tie points still lie {residual_px:.2f} px off after the correction (median), more than cameras that "
            "are in order show. Try `zlocus orient`, or ask for better cameras."
        )
    return (
        f"its tie points lie {residual_px:.2f} px off with the camera as delivered (median), for no correction was "
        "asked for. `zlocus orient` corrects cameras."
    )


def _outside_range(views: Sequence[View], heights: FloatArray) -> list[Doubt]:
    """A doubt if tie points lie at heights for which the sensor models were not made."""
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
    observations: Observations,
    xyz: FloatArray,
    candidates: Sequence[int],
    options: OrientationOptions,
) -> tuple[int, int] | None:
    """Numbers of two images whose sensor models seem to be exchanged: with each other's, the ties fit clearly better.

    observations, xyz : of the ties, with first ground points (n, 3) m; candidates : numbers of the images to try. Two
    images from one pass, whose rays lie in parallel planes, fit equally well either way.
    """
    points = np.unique(observations.point)
    few = observations.kept(np.isin(observations.point, points[:: max(len(points) // TIES_TO_COMPARE, 1)]))
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
    sensors: Sequence[SensorModel], observations: Observations, xyz: FloatArray, options: OrientationOptions
) -> tuple[float, float]:
    """Noise of the ties (px) after shifts of all images, and the share of the observations that agree with them."""
    observations, start = renumbered(observations, xyz)
    shifted = adjust(sensors, observations, start, replace(options, model="shift"))
    return robust_sigma(shifted.ground_points.residual), len(shifted.observations) / max(len(observations), 1)
