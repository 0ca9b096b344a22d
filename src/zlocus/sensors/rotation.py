"""Rotations of many cameras at once: angles and quaternions to matrices."""

from __future__ import annotations

import numpy as np

from zlocus.core.sensor_model import FloatArray


def from_photogrammetric(omega: FloatArray, phi: FloatArray, kappa: FloatArray) -> FloatArray:
    """Ground from image (n, 3, 3) of angles (n,) rad: R = Rx(omega) Ry(phi) Rz(kappa) (Kraus 2007, section 2.1).

    They turn the ground's axes, about x, then the moved y, then the moved z, into those of an image whose x points to
    the right, y up and z backwards.
    """
    return np.asarray(about(0, omega) @ about(1, phi) @ about(2, kappa))


def to_photogrammetric(ground_from_image: FloatArray) -> FloatArray:
    """Angles omega, phi, kappa (n, 3) rad of matrices (n, 3, 3), see `from_photogrammetric`."""
    r = ground_from_image
    omega, kappa = np.arctan2(-r[:, 1, 2], r[:, 2, 2]), np.arctan2(-r[:, 0, 1], r[:, 0, 0])
    return np.column_stack([omega, np.arcsin(np.clip(r[:, 0, 2], -1.0, 1.0)), kappa])


def from_navigation(roll: FloatArray, pitch: FloatArray, heading: FloatArray) -> FloatArray:
    """East, north, up from right, forward, up of an aircraft (n, 3, 3), from the angles (n,) rad of its axes.

    heading : clockwise from north; pitch : nose up; roll : right wing down; in this order about the moved axes
    down, right and forward (ARINC 705).
    """
    return np.asarray(about(2, -np.asarray(heading)) @ about(0, pitch) @ about(1, roll))


def from_quaternions(xyzw: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) of quaternions x, y, z, w (n, 4) of any length but zero."""
    x, y, z, w = (np.asarray(xyzw, float) / np.linalg.norm(xyzw, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def from_vectors(turns: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) that turn about vectors (n, 3) by their lengths, rad (Rodrigues' formula)."""
    turns = np.asarray(turns, float)
    angle = np.linalg.norm(turns, axis=1)
    quaternions = np.column_stack([0.5 * np.sinc(angle / (2 * np.pi))[:, None] * turns, np.cos(angle / 2)])
    return from_quaternions(quaternions)


def about(axis: int, angle: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) that turn about axis 0, 1 or 2 by angles (n,) rad, counter-clockwise seen from its tip."""
    angle = np.atleast_1d(np.asarray(angle, float))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn = np.zeros((len(angle), 3, 3))
    turn[:, axis, axis] = 1.0
    turn[:, first, first] = turn[:, second, second] = np.cos(angle)
    turn[:, second, first] = np.sin(angle)
    turn[:, first, second] = -turn[:, second, first]
    return turn
