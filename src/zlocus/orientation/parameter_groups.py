"""Parameter groups of the bundle adjustment: what is corrected of each kind of sensor, with prior standard
deviations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from zlocus.core.options import OrientationOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.sensors.correction import AffinelyShiftedModel, ShiftedModel
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.linescan import LineScanModel, RectifiedModel
from zlocus.sensors.location_grid import LocationGridModel
from zlocus.sensors.rpc import RpcModel
from zlocus.sensors.trajectory import Drift

Correct = Callable[[SensorModel, FloatArray], SensorModel]
Scanner = LineScanModel | RectifiedModel

# Ties determine a direction of the parameters if its information, per observation and in px2, exceeds this value over
# the number of images squared. Corrections in the image: see `shift_adjustment.MIN_SHIFT_INFORMATION`. Physical cameras
# have realistic priors, which need help only where there is no information at all.
MIN_INFORMATION_IN_IMAGE = 0.01
MIN_INFORMATION_IN_SPACE = 1e-6
SHIFT, AFFINE, POSE, FOCAL, DRIFT = "shift", "affine", "pose", "focal length", "drift"
SHIFT_NAMES = ("column_px", "row_px")
AFFINE_NAMES = ("column_by_column_px", "column_by_row_px", "row_by_column_px", "row_by_row_px")
POSE_NAMES = ("x_m", "y_m", "z_m", "turn_x_deg", "turn_y_deg", "turn_z_deg")
# Factors from the units of the parameters to those of the report, by the last word of the parameter's name.
UNITS = {"deg": 180.0 / np.pi, "ms": 1000.0}


@dataclass(frozen=True, eq=False)
class ParameterGroup:
    """Parameters that correct one image, or several images together.

    kind : see above; views : numbers of the images; names : (k,) of the parameters, which end in their unit; sigma :
    (k,) standard deviations beforehand, about zero, in m, rad, px and s; observations : see `MIN_INFORMATION_IN_IMAGE`;
    correct : a sensor model of one of the images and values (k,) in the units of `sigma`, to the corrected model.
    is_calibration : whether they are held unless the block determines them (see `undetermined_parameters`).
    """

    kind: str
    views: tuple[int, ...]
    names: tuple[str, ...]
    sigma: FloatArray
    min_information: float
    correct: Correct
    is_calibration: bool = False

    def __len__(self) -> int:
        return len(self.sigma)

    def described(self, values: FloatArray) -> dict[str, float]:
        """Values (k,) by the names of the parameters, in the units that the names end in."""
        return {
            name: float(value) * UNITS.get(name.rsplit("_", 1)[-1], 1.0)
            for name, value in zip(self.names, values, strict=True)
        }


def kind_of(sensor: SensorModel) -> str:
    """Kind of a sensor in reports: frame or linescan, or one that is corrected in its image: rpc, location_grid or
    other."""
    bare = uncorrected(sensor)
    kinds = ((FrameModel, "frame"), (Scanner, "linescan"), (RpcModel, "rpc"), (LocationGridModel, "location_grid"))
    return next((kind for model, kind in kinds if isinstance(bare, model)), "other")


def uncorrected(sensor: SensorModel) -> SensorModel:
    """The sensor model without corrections in its image."""
    while isinstance(sensor, ShiftedModel | AffinelyShiftedModel):
        sensor = sensor.base_sensor
    return sensor


def needs_bundle_adjustment(views: Sequence[View]) -> bool:
    """Whether a shift of each image is not enough, because some sensor has a pose."""
    return any(isinstance(view.sensor, FrameModel | Scanner) for view in views)


def parameter_groups_of(views: Sequence[View], options: OrientationOptions) -> tuple[ParameterGroup, ...]:
    """The parameter groups of a scene, without those of a self-calibration (see `calibration_groups`).

    Each image gets a shift (or an affine map) or a pose. All images of a trajectory share a drift.
    """
    frames = [i for i, view in enumerate(views) if isinstance(view.sensor, FrameModel)]
    scanners = [i for i, view in enumerate(views) if isinstance(view.sensor, Scanner)]
    in_image = sorted(set(range(len(views))) - set(frames) - set(scanners))
    image_group = affine_group if options.bundle_adjustment.rpc_correction == "affine" else shift_group
    groups = [image_group(i, views[i], options) for i in in_image]
    groups += [pose_group(i, options) for i in frames]
    groups += [drift_group(group, views, options) for group in same(scanners, views, same_trajectory)]
    return tuple(groups)


def shift_group(number: int, view: View, options: OrientationOptions) -> ParameterGroup:
    """The parameters of a shift of the image."""

    def correct(sensor: SensorModel, values: FloatArray) -> SensorModel:
        return ShiftedModel(sensor, float(values[0]), float(values[1]))

    return ParameterGroup(
        SHIFT, (number,), SHIFT_NAMES, np.full(2, options.sigma_shift_px), MIN_INFORMATION_IN_IMAGE, correct
    )


def affine_group(number: int, view: View, options: OrientationOptions) -> ParameterGroup:
    """The parameters of a shift that changes linearly over the image."""
    rows, cols = view.image.shape
    middle, half = np.array([(cols - 1) / 2, (rows - 1) / 2]), np.array([cols / 2, rows / 2])

    def correct(sensor: SensorModel, values: FloatArray) -> SensorModel:
        growth = values[2:].reshape(2, 2) / half
        constant = values[:2] - growth @ middle
        column, row = ((float(c), float(g[0]), float(g[1])) for c, g in zip(constant, growth, strict=True))
        return AffinelyShiftedModel(sensor, column, row)

    sigma = np.append(np.full(2, options.sigma_shift_px), np.full(4, options.bundle_adjustment.sigma_affine_px))
    return ParameterGroup(AFFINE, (number,), SHIFT_NAMES + AFFINE_NAMES, sigma, MIN_INFORMATION_IN_IMAGE, correct)


def pose_group(number: int, options: OrientationOptions) -> ParameterGroup:
    """The parameters of the position and attitude of a frame camera, along and about its axes."""

    def correct(sensor: SensorModel, values: FloatArray) -> SensorModel:
        assert isinstance(sensor, FrameModel), "groups fit their sensors"
        return sensor.corrected(values[:3], values[3:])

    return ParameterGroup(POSE, (number,), POSE_NAMES, pose_sigma(options), MIN_INFORMATION_IN_SPACE, correct)


def drift_group(numbers: Sequence[int], views: Sequence[View], options: OrientationOptions) -> ParameterGroup:
    """The parameters of a slow error of a trajectory: constant over a short exposure, a spline over a long one."""
    ends = [raw(views[i].sensor).lines.times[[0, -1]] for i in numbers]
    start, end = float(np.min(ends)), float(np.max(ends))
    n_knots = 1 + int(np.ceil((end - start) / options.bundle_adjustment.drift_knot_interval_s))
    drift = Drift.zero(start, end, n_knots)

    def correct(sensor: SensorModel, values: FloatArray) -> SensorModel:
        assert isinstance(sensor, Scanner), "groups fit their sensors"
        return sensor.corrected(drift.with_parameters(values))

    names = tuple(f"knot{k}_{name}" for k in range(n_knots) for name in POSE_NAMES)
    return ParameterGroup(
        DRIFT, tuple(numbers), names, np.tile(pose_sigma(options), n_knots), MIN_INFORMATION_IN_SPACE, correct
    )


def pose_sigma(options: OrientationOptions) -> FloatArray:
    """Prior standard deviations (6,) of a pose, m and rad."""
    bundle_options = options.bundle_adjustment
    return np.array([bundle_options.sigma_position_m] * 3 + [np.deg2rad(bundle_options.sigma_attitude_deg)] * 3)


def same(
    numbers: Sequence[int], views: Sequence[View], are_same: Callable[[SensorModel, SensorModel], bool]
) -> list[list[int]]:
    """Numbers of the images in groups whose sensors `are_same`."""
    groups: list[list[int]] = []
    for i in numbers:
        for group in groups:
            if are_same(views[group[0]].sensor, views[i].sensor):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def same_trajectory(sensor: SensorModel, other_sensor: SensorModel) -> bool:
    """Whether two line scanners have the same trajectory, as the three lines of one camera do."""
    assert isinstance(sensor, Scanner), "callers make sure"
    assert isinstance(other_sensor, Scanner), "callers make sure"
    first, second = raw(sensor).trajectory, raw(other_sensor).trajectory
    return all(
        np.array_equal(getattr(first, name), getattr(second, name)) for name in ("times", "centres", "rotations")
    )


def same_lens(sensor: SensorModel, other_sensor: SensorModel) -> bool:
    """Whether two frame cameras have the same interior orientation."""
    assert isinstance(sensor, FrameModel), "callers make sure"
    assert isinstance(other_sensor, FrameModel), "callers make sure"
    names = ("focal", "principal_point", "aspect", "skew", "distortion")
    return all(getattr(sensor, name) == getattr(other_sensor, name) for name in names)


def raw(sensor: SensorModel) -> LineScanModel:
    """The line scanner of a raw or rectified image."""
    assert isinstance(sensor, Scanner), "callers make sure"
    return sensor.raw_sensor if isinstance(sensor, RectifiedModel) else sensor


def corrected_sensors(
    groups: Sequence[ParameterGroup], sensors: Sequence[SensorModel], parameters: FloatArray
) -> tuple[SensorModel, ...]:
    """The sensors corrected by parameters (p,) of all groups, one after the other, in units of their sigma.

    A sensor whose parameters are all zero stays the same object.
    """
    corrected, first = list(sensors), 0
    for group in groups:
        values = parameters[first : first + len(group)] * group.sigma
        first += len(group)
        if values.any():
            for i in group.views:
                corrected[i] = group.correct(corrected[i], values)
    return tuple(corrected)
