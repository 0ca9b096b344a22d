"""Correction of one camera by points of known ground: what a bundle adjustment of many cameras does, for one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from zlocus.core.options import OrientationOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.parameter_groups import corrected_sensors, parameter_groups_of
from zlocus.orientation.shift_adjustment import huber_weight, robust_sigma

MAX_STEPS = 20
TOLERANCE_PX = 1e-3
# Step of a parameter for its derivative, in units of its sigma.
DIFFERENCE = 0.05
# From so many points on, the correction of an RPC may change linearly over the image.
MIN_AFFINE_POINTS = 60


@dataclass(frozen=True, eq=False)
class Resection:
    """A corrected camera. sensor : corrected; residual : (n, 2) px, of the points; sigma_px : robust standard deviation
    of one image coordinate."""

    sensor: SensorModel
    residual: FloatArray
    sigma_px: float


def resected(view: View, xyz: FloatArray, xy: FloatArray, options: OrientationOptions) -> Resection:
    """Correct the camera of a view by its image points of known ground, within the priors of the bundle adjustment.

    An RPC is shifted in its image, or by an affine map where there are many points; other cameras get another pose.
    xyz : (n, 3) m; xy : (n, 2) px. Points that disagree are weighted down (Huber's loss).
    """
    correction = "affine" if len(xyz) >= MIN_AFFINE_POINTS else "shift"
    of_one = replace(options.bundle_adjustment, rpc_correction=correction, self_calibration=(), sigma_focal_px=None)
    groups = parameter_groups_of((view,), replace(options, bundle_adjustment=of_one))
    parameters = np.zeros(sum(map(len, groups)))

    def places(values: FloatArray) -> FloatArray:
        return corrected_sensors(groups, (view.sensor,), values)[0].image_from_ground(xyz)

    for _ in range(MAX_STEPS):
        here = places(parameters)
        residual = xy - here
        sigma = robust_sigma(residual)
        columns = [
            (places(parameters + step) - here).ravel() / DIFFERENCE for step in np.eye(len(parameters)) * DIFFERENCE
        ]
        jacobian = np.column_stack(columns)
        weight = np.repeat(huber_weight(residual, sigma), 2) / sigma**2
        usable = np.isfinite(jacobian).all(axis=1) & np.isfinite(residual.ravel())
        jacobian, pull = jacobian[usable], np.where(usable, residual.ravel() * weight, 0.0)[usable]
        normal = jacobian.T @ (jacobian * weight[usable, None]) + np.eye(len(parameters))
        step = np.linalg.solve(normal, jacobian.T @ pull - parameters)
        parameters = parameters + step
        if np.abs(jacobian @ step).max(initial=0.0) < TOLERANCE_PX:
            break
    (sensor,) = corrected_sensors(groups, (view.sensor,), parameters)
    residual = xy - sensor.image_from_ground(xyz)
    return Resection(sensor, residual, robust_sigma(residual))
