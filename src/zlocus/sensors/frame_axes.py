"""Rotations that turn given directions into the axes of a local frame."""

from __future__ import annotations

import numpy as np

from zlocus.core.sensor_model import FloatArray

OPPOSITE_TOLERANCE, PARALLEL_TOLERANCE = 1e-12, 1e-6


def rotation_to_z(up: tuple[float, float, float]) -> FloatArray:
    """The smallest rotation (3, 3) that turns a direction into the z axis; for -z half a turn about x."""
    x, y, z = np.array(up) / np.max(np.abs(up))
    x, y, z = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    if z < -1.0 + OPPOSITE_TOLERANCE:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula about the axis up x z, with 1 + cosine = 1 + z.
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + z))


def rotation_to_axes(up: tuple[float, float, float], north: tuple[float, float, float] | None) -> FloatArray:
    """The rotation (3, 3) that turns `up` into the z axis, and the part of `north` at right angles to it into the y
    axis.

    Without `north` it is the smallest rotation.
    """
    rotation = rotation_to_z(up)
    if north is None:
        return rotation
    x, y, _ = rotation @ (np.array(north) / np.max(np.abs(north)))
    x, y = np.array([x, y]) / np.hypot(x, y)
    return np.asarray(np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]]) @ rotation)


def is_along(up: tuple[float, float, float], north: tuple[float, float, float]) -> bool:
    """Whether two directions are parallel or opposite, to rounding, or the second is zero."""
    if not any(north):
        return True
    one, other = (np.array(v) / np.max(np.abs(v)) for v in (up, north))
    return bool(np.linalg.norm(np.cross(one, other)) < PARALLEL_TOLERANCE)
