"""Which parameters of a self-calibration a block determines, and what the others cannot be told from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zlocus.core.sensor_model import FloatArray, SensorModel, Stationed
from zlocus.orientation.parameter_groups import POSE, POSE_NAMES, ParameterGroup

# A parameter is determined if ties and control reduce its standard deviation to less than this share.
MAX_SIGMA_SHARE = 0.3
# Without control, neither is a parameter determined that correlates more than this with the flying height, however
# small its standard deviation: small errors that all ties share would change all heights. Measured on blocks of a drone
# over flat ground: the focal length reaches 0.98 with nadir images that are tilted by 1 degree, 0.87 with 3 degrees,
# 0.89 with two flying heights, and 0.4 with oblique images.
MAX_HEIGHT_CORRELATION = 0.85
# From this correlation on, the reason is that the parameter cannot be told from its partner.
CLEAR_CORRELATION = 0.8
# The question is asked with attitudes that are free: standard deviations so many times larger. What they are known to
# beforehand are errors of single images, while those of a mounting are the same in all images, and would be taken for
# errors of the lens.
FREE_ATTITUDE = 100.0
# Variance of a parameter that is held, by its variance beforehand.
HELD_VARIANCE = 1e-12
FLYING_HEIGHT = "the flying height above the ground"
POSE_WORDS = dict(
    zip(
        POSE_NAMES,
        (
            "the positions along the image rows", "the positions along the image columns",
            "the positions along the optical axes", "the attitudes about the image rows",
            "the attitudes about the image columns", "the attitudes about the optical axes",
        ),
        strict=True,
    )
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class HeldParameter:
    """A parameter of a self-calibration that is held, because the block does not determine it.

    group, name : of the parameter; index : among all parameters; sigma_share : standard deviation that ties and control
    leave, by that beforehand; partner : what the parameter correlates most with; correlation : with that.
    """

    group: ParameterGroup
    name: str
    index: int
    sigma_share: float
    partner: str
    correlation: float

    def sentence(self, names: Sequence[str]) -> str:
        """Why it is held. names : of all views."""
        held = (
            f"The {parameter_words(self.group, self.name)} of {images_in_words(self.group.views, names)} is held: the "
            f"tie points (and control) leave {100 * self.sigma_share:.0f} % of its standard deviation"
        )
        if abs(self.correlation) < CLEAR_CORRELATION:
            return f"{held}. It correlates most with {self.partner} ({self.correlation:.2f})."
        return f"{held}, and they do not tell it from {self.partner} (correlation {self.correlation:.2f})."


def images_in_words(views: Sequence[int], names: Sequence[str]) -> str:
    """The images of a camera in a sentence. views : their numbers; names : of all views."""
    first, last = names[views[0]], names[views[-1]]
    return first if len(views) == 1 else f"{len(views)} images ({first} to {last})"


def parameter_words(group: ParameterGroup, name: str) -> str:
    """A parameter of a self-calibration in words."""
    axis = next((axis for axis in ("column", "row") if name == f"principal_{axis}_px"), None)
    return group.kind if axis is None else f"{axis} of the {group.kind}"


@dataclass(frozen=True, eq=False)
class BlockHeights:
    """How the block rises with the parameters, in m per sigma, (p,) each.

    ground : mean height of the ties; cameras : mean height of the frame cameras.
    """

    ground: FloatArray
    cameras: FloatArray


@dataclass(frozen=True, eq=False)
class BlockInformation:
    """What a block tells about its parameters, in units of their sigmas and without what is known beforehand.

    used : (p, p), with which the adjustment is solved; whole : (p, p), with that of the ties in the directions that
    they hardly determine, which shows what correlates; is_controlled : whether control points or a terrain hold the
    heights.
    """

    used: FloatArray
    whole: FloatArray
    is_controlled: bool


def undetermined_parameters(
    groups: Sequence[ParameterGroup], block_information: BlockInformation, heights: BlockHeights
) -> tuple[HeldParameter, ...]:
    """The parameters of the self-calibration that are held, the least determined first.

    One parameter is held after the other, because each may free those that it correlates with.

    Source of the rule: parameters without a significant reduction, or with high correlations, are to be removed (Fraser
    1997, Digital camera self-calibration, ISPRS Journal 52 (4), 149-159, sections on parameter correlation).
    """
    names = [(group, name) for group in groups for name in group.names]
    judged = np.array([group.is_calibration for group, _ in names], bool)
    if not judged.any():
        return ()
    is_attitude = np.array([group.kind == POSE and name.endswith("_deg") for group, name in names])
    deviation, held = np.where(is_attitude, FREE_ATTITUDE, 1.0), []
    while judged.any():
        share = np.sqrt(np.diag(covariance_from(block_information.used, deviation)))
        covariance = covariance_from(block_information.whole, deviation)
        is_weak = judged & (share > MAX_SIGMA_SHARE)
        if not block_information.is_controlled:
            above_ground = heights.cameras - heights.ground
            correlations = [
                correlation_with(covariance, i, above_ground) if judged[i] else 0.0 for i in range(len(names))
            ]
            is_weak |= judged & (np.abs(correlations) > MAX_HEIGHT_CORRELATION)
        if not is_weak.any():
            break
        worst = int(np.argmax(np.where(is_weak, share, 0.0)))
        group, name = names[worst]
        partner, correlation = closest_partner(groups, worst, covariance, judged, heights)
        held.append(HeldParameter(group, name, worst, float(share[worst]), partner, correlation))
        judged[worst], deviation[worst] = False, 0.0
    return tuple(held)


def covariance_from(information: FloatArray, deviation: FloatArray) -> FloatArray:
    """Covariance matrix (p, p) of parameters from information (p, p) and standard deviations beforehand (p,), which may
    be 0: (N + S^-2)^-1 = S (S N S + 1)^-1 S."""
    from scipy import linalg

    scaled = deviation[:, None] * information * deviation + np.eye(len(deviation))
    return np.asarray(deviation[:, None] * linalg.inv(scaled) * deviation)


def closest_partner(
    groups: Sequence[ParameterGroup], index: int, covariance: FloatArray, judged: FloatArray, heights: BlockHeights
) -> tuple[str, float]:
    """What a parameter correlates most with, in words, and the correlation.

    Candidates are the flying height, the other parameters of the self-calibration (judged : (p,) bool), and the mean of
    each parameter of the poses. covariance : (p, p).
    """
    names = [(group, name) for group in groups for name in group.names]
    candidates: dict[str, FloatArray] = {FLYING_HEIGHT: heights.cameras - heights.ground}
    for other, (group, name) in enumerate(names):
        if judged[other] and other != index:
            candidates[f"the {parameter_words(group, name)}"] = np.eye(len(names))[other]
    for pose_name, words in POSE_WORDS.items():
        candidates[words] = np.array([float(group.kind == POSE and name == pose_name) for group, name in names])
    found = {words: correlation_with(covariance, index, direction) for words, direction in candidates.items()}
    partner = max(found, key=lambda words: abs(found[words]))
    return partner, found[partner]


def correlation_with(covariance: FloatArray, index: int, direction: FloatArray) -> float:
    """Correlation of a parameter with a linear function (p,) of all parameters; 0 where that does not vary."""
    variance = covariance[index, index] * (direction @ covariance @ direction)
    return float(covariance[index] @ direction / np.sqrt(variance)) if variance > 0.0 else 0.0


def mean_camera_heights(groups: Sequence[ParameterGroup], sensors: Sequence[SensorModel]) -> FloatArray:
    """Derivatives (p,) of the mean height of the frame cameras by all parameters, m per sigma."""
    poses, by_parameters = max(sum(group.kind == POSE for group in groups), 1), []
    for group in groups:
        rises = np.zeros(len(group))
        if group.kind == POSE:
            sensor = sensors[group.views[0]]
            assert isinstance(sensor, Stationed), "a camera with a pose knows where it is"
            for k in range(3):
                moved = group.correct(sensor, group.sigma * (np.arange(len(group)) == k))
                assert isinstance(moved, Stationed), "its correction knows it too"
                rises[k] = (moved.station_height() - sensor.station_height()) / poses
        by_parameters.append(rises)
    return np.concatenate(by_parameters) if by_parameters else np.empty(0)
