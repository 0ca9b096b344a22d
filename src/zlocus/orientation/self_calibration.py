"""Self-calibration of frame cameras: parameters that the images of a camera share, corrected with their poses.

The parameters are those of Brown 1971, Photogrammetric Engineering 37 (8), 855-866, with OpenCV's signs and units:
focal length, principal point, radial (k1, k2, k3) and tangential distortion (p1, p2). For fisheye lenses k1, k2 and k3
are the coefficients of their own polynomial. The read-out time of a rolling shutter is one more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from zlocus.core.errors import ConfigError
from zlocus.core.options import OrientationOptions
from zlocus.core.options.orientation_options import ALL_PARAMETERS, BundleAdjustmentOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.parameter_groups import FOCAL, MIN_INFORMATION_IN_SPACE, ParameterGroup, same, same_lens
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel

Calibrate = Callable[[FrameModel, FloatArray], FrameModel]

PRINCIPAL_POINT, READOUT = "principal point", "read-out time"
DISTORTION = {
    "k1": "radial distortion k1", "k2": "radial distortion k2", "k3": "radial distortion k3",
    "p1": "tangential distortion p1", "p2": "tangential distortion p2",
}  # fmt: skip
# Power of the distance from the principal point with which each coefficient moves image points, and largest factor.
POWER = {"k1": (3, 1.0), "k2": (5, 1.0), "k3": (7, 1.0), "p1": (2, 3.0), "p2": (2, 3.0)}

# Points along each side of an image at which cameras are compared.
CHANGE_POINTS = 9


def check_self_calibration(views: Sequence[View], options: OrientationOptions) -> None:
    """Refuse parameters that are requested by name and that a camera of the scene does not have.

    Raises
    ------
    ConfigError
        A lens has another kind of distortion, or no camera has a rolling shutter.
    """
    frames = [view for view in views if isinstance(view.sensor, FrameModel)]
    requested = set(options.bundle_adjustment.self_calibration) - {"all"}
    for view in frames:
        assert isinstance(view.sensor, FrameModel), "only these were chosen"
        missing = [name for name in DISTORTION if name in requested and not has_coefficient(view.sensor, name)]
        if missing:
            raise ConfigError(
                f"The lens of {view.name} has a distortion without {' and '.join(missing)}. Remove these from "
                "orientation.bundle_adjustment.self_calibration, or write all, which takes those that each lens has."
            )
    if frames and "readout" in requested and not any(has_rolling_shutter(view.sensor) for view in frames):
        raise ConfigError(
            "No camera of the scene has a rolling_shutter, whose read-out time could be corrected. Add rolling_shutter "
            "to the cameras, or remove readout from orientation.bundle_adjustment.self_calibration."
        )


def calibration_groups(views: Sequence[View], options: OrientationOptions) -> tuple[ParameterGroup, ...]:
    """The parameter groups of the self-calibration: one for each camera and requested parameter.

    Images of equal interior orientation share all parameters but the read-out time, which those share whose read-out
    time is equal too.
    """
    bundle_options = options.bundle_adjustment
    requested = bundle_options.self_calibration
    names = ALL_PARAMETERS if "all" in requested else requested
    frames = [i for i, view in enumerate(views) if isinstance(view.sensor, FrameModel)]
    moving = [i for i in frames if has_rolling_shutter(views[i].sensor)]
    groups = [
        interior_group(name, numbers, views, bundle_options)
        for numbers in same(frames, views, same_lens)
        for name in names
        if name not in DISTORTION or has_coefficient(views[numbers[0]].sensor, name)
        if name != "readout"
    ]
    if "readout" in names:
        sigma = np.array([bundle_options.sigma_readout_ms / 1000.0])
        groups += [
            calibration_group(READOUT, numbers, ("readout_ms",), sigma, _with_readout)
            for numbers in same(moving, views, same_shutter)
        ]
    return tuple(groups)


def interior_group(
    name: str, numbers: Sequence[int], views: Sequence[View], options: BundleAdjustmentOptions
) -> ParameterGroup:
    """The group of a parameter of the interior orientation. numbers : of the images of the camera."""
    view = views[numbers[0]]
    sensor = view.sensor
    assert isinstance(sensor, FrameModel), "callers make sure"
    if name == "focal":
        share = options.sigma_focal_px
        sigma_focal = share if share is not None else options.sigma_focal_share * sensor.focal
        return calibration_group(FOCAL, numbers, ("focal_px",), np.array([sigma_focal]), _with_focal)
    if name == "principal_point":
        sigma = np.full(2, options.sigma_principal_point_px)
        columns = ("principal_column_px", "principal_row_px")
        return calibration_group(PRINCIPAL_POINT, numbers, columns, sigma, _with_principal_point)
    power, factor = POWER[name]
    radius = corner_distance_px(sensor, view.image.shape) / sensor.focal
    sigma = np.array([options.sigma_distortion_px / (sensor.focal * factor * radius**power)])

    def with_coefficient(sensor: FrameModel, values: FloatArray) -> FrameModel:
        distortion = BrownDistortion() if sensor.distortion is None else sensor.distortion
        changed = {name: getattr(distortion, name) + float(values[0])}
        return replace(sensor, distortion=replace(distortion, **changed))  # type: ignore[type-var]

    return calibration_group(DISTORTION[name], numbers, (name,), sigma, with_coefficient)


def calibration_group(
    kind: str, numbers: Sequence[int], names: tuple[str, ...], sigma: FloatArray, calibrate: Calibrate
) -> ParameterGroup:
    """A group of parameters that some frame cameras share. calibrate : corrects a camera by values (k,)."""

    def correct(sensor: SensorModel, values: FloatArray) -> SensorModel:
        assert isinstance(sensor, FrameModel), "groups fit their sensors"
        return calibrate(sensor, values)

    return ParameterGroup(kind, tuple(numbers), names, sigma, MIN_INFORMATION_IN_SPACE, correct, is_calibration=True)


def _with_focal(sensor: FrameModel, values: FloatArray) -> FrameModel:
    return replace(sensor, focal=sensor.focal + float(values[0]))


def _with_principal_point(sensor: FrameModel, values: FloatArray) -> FrameModel:
    return sensor.moved(float(values[0]), float(values[1]))


def _with_readout(sensor: FrameModel, values: FloatArray) -> FrameModel:
    rolling_shutter = sensor.rolling_shutter
    assert rolling_shutter is not None, "groups fit their sensors"
    readout_s = rolling_shutter.readout_s + float(values[0])
    return replace(sensor, rolling_shutter=replace(rolling_shutter, readout_s=readout_s))


def interior_change_px(views: Sequence[View], other_views: Sequence[View], z: float) -> float:
    """Largest distance (px) by which image points move from some cameras to others of equal poses, beyond the mean
    motion of their image, which errors of poses explain too.

    views, other_views : the same images; z : height of the ground, m. Points that only one of the cameras sees are left
    out.
    """
    largest = 0.0
    for view, other_view in zip(views, other_views, strict=True):
        rows, columns = (np.linspace(0.0, n - 1.0, CHANGE_POINTS) for n in view.image.shape)
        column, row = np.meshgrid(columns, rows)
        xy = np.column_stack([column.ravel(), row.ravel()])
        moved = other_view.sensor.image_from_ground(view.sensor.ground_from_image(xy, np.full(len(xy), z))) - xy
        moved = moved[np.isfinite(moved).all(axis=1)]
        if len(moved):
            largest = max(largest, float(np.hypot(*(moved - moved.mean(axis=0)).T).max()))
    return largest


def has_coefficient(sensor: SensorModel, name: str) -> bool:
    """Whether the lens of a frame camera has a coefficient of distortion; an ideal lens has those of Brown."""
    assert isinstance(sensor, FrameModel), "callers make sure"
    return hasattr(BrownDistortion() if sensor.distortion is None else sensor.distortion, name)


def has_rolling_shutter(sensor: SensorModel) -> bool:
    """Whether a camera moves while it takes an image."""
    return isinstance(sensor, FrameModel) and sensor.rolling_shutter is not None


def same_shutter(sensor: SensorModel, other_sensor: SensorModel) -> bool:
    """Whether two frame cameras have the same interior orientation and the same rolling shutter."""
    assert isinstance(sensor, FrameModel), "callers make sure"
    assert isinstance(other_sensor, FrameModel), "callers make sure"
    one, other = sensor.rolling_shutter, other_sensor.rolling_shutter
    assert one is not None, "callers make sure"
    assert other is not None, "callers make sure"
    return same_lens(sensor, other_sensor) and (one.readout_s, one.rows) == (other.readout_s, other.rows)


def corner_distance_px(sensor: FrameModel, shape: tuple[int, int]) -> float:
    """Distance (px) from the principal point to the farthest corner of an image. shape : rows and columns."""
    column, row = sensor.principal_point
    return float(np.hypot(max(column, shape[1] - 1 - column), max(row, shape[0] - 1 - row)))
