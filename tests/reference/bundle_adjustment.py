"""Plain twins of the bundle adjustment's linear algebra: dense matrices, every derivative by central differences."""

from __future__ import annotations

import numpy as np

from zlocus.orientation.parameter_groups import corrected_sensors
from zlocus.orientation.triangulate import project_points


def all_projections(problem, parameters, xyz):
    """(2 m,) px of every image point."""
    sensors = corrected_sensors(problem.groups, problem.sensors, parameters)
    return project_points(sensors, problem.observations, xyz).ravel()


def central(function, at, step):
    """(m, k) derivatives of a function of (k,) numbers."""
    columns = []
    for k in range(len(at)):
        ahead, behind = at.copy(), at.copy()
        ahead[k] += step
        behind[k] -= step
        columns.append((function(ahead) - function(behind)) / (2 * step))
    return np.column_stack(columns)


def dense_jacobians(problem, parameters, xyz):
    """Derivatives (2 m, p) by the parameters and (2 m, 3 n) by the ground points."""
    by_parameters = central(lambda p: all_projections(problem, p, xyz), parameters, 1e-2)
    by_ground = central(lambda g: all_projections(problem, parameters, g.reshape(-1, 3)), xyz.ravel(), 0.05)
    return by_parameters, by_ground


def dense_reduced(by_parameters, by_ground, weight, residual, precision, pull):
    """Normal matrix and right side of the parameters, by the inverse of the points' whole matrix.

    weight : (m,); precision : (n, 3, 3) and pull (n, 3) of what is known of the points.
    """
    w = np.repeat(weight, 2)
    own = by_ground.T @ (w[:, None] * by_ground)
    for i, own_precision in enumerate(precision):
        own[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += own_precision
    mixed = by_parameters.T @ (w[:, None] * by_ground)
    own_pull = by_ground.T @ (w * residual.ravel()) + pull.ravel()
    inverse = np.linalg.inv(own)
    normal = by_parameters.T @ (w[:, None] * by_parameters) - mixed @ inverse @ mixed.T
    return normal, by_parameters.T @ (w * residual.ravel()) - mixed @ inverse @ own_pull
