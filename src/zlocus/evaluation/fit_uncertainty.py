"""Uncertainty of a fit whose residuals are correlated in space, or between points of one pass of a satellite."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray

# Areas along each side of the scene within which residuals may be correlated in any way.
AREAS_PER_SIDE = (10, 6, 4)
MIN_GROUPS = 8
# Points further apart in time were measured in other passes.
PASS_GAP_S = 600.0


def covariance_of(
    score: FloatArray, jacobian: FloatArray, relative: FloatArray, time_s: FloatArray
) -> tuple[FloatArray, int]:
    """Covariance (k, k) m2 of a fit that makes the sum of scores 0, and the number of groups that it is from.

    score : (n, k) of each place; jacobian : (k, k) of their sum by the unknowns; relative : (n, 2) places, from -1 to 1
    along the longer side; time_s : (n,) s, NaN where unknown.

    Residuals of one group may be correlated in any way, those of different groups are taken as independent (Liang and
    Zeger 1986, Biometrika 73, eq. 5 and 6), with the usual factor for few groups, g / (g - k). Groups are the places
    themselves, areas of three sizes, and passes. Of those with enough groups, each unknown gets its largest variance:
    neighbours that err together raise it, whatever the length over which they do.
    """
    inverse, (n_places, n_unknowns) = np.linalg.pinv(jacobian), score.shape
    groupings = [np.arange(n_places), *(areas(relative, n) for n in AREAS_PER_SIDE)]
    if n_places and np.isfinite(time_s).all():
        groupings.append(passes(time_s))
    covariances, counts = [np.zeros_like(jacobian)], [0]
    for groups in groupings:
        n = int(groups.max()) + 1 if n_places else 0
        if n < min(MIN_GROUPS, n_places) or n <= n_unknowns:
            continue
        sums = np.stack([np.bincount(groups, column, n) for column in score.T], axis=1)
        covariances.append(inverse @ (sums.T @ sums) @ inverse.T * n / (n - n_unknowns))
        counts.append(n)
    variances = np.array([np.diag(covariance) for covariance in covariances])
    largest = int(np.argmax(variances.sum(axis=1)))
    factor = np.sqrt(variances.max(axis=0) / np.where(variances[largest] > 0, variances[largest], 1.0))
    return covariances[largest] * np.outer(factor, factor), counts[largest]


def areas(relative: FloatArray, per_side: int) -> NDArray[np.int64]:
    """Number of the area of each place (n,), from 0 on without gaps; `per_side` along the longer side."""
    cell = area_cells(relative, per_side)
    return np.asarray(np.unique(cell[:, 0] * per_side + cell[:, 1], return_inverse=True)[1].ravel(), np.int64)


def area_cells(relative: FloatArray, per_side: int) -> NDArray[np.int64]:
    """Column and row (n, 2) of the area of each place; see `areas`."""
    return np.clip(np.floor((relative + 1) / 2 * per_side), 0, per_side - 1).astype(np.int64)


def passes(time_s: FloatArray) -> NDArray[np.int64]:
    """Number of the pass of each place (n,): a new one begins where nothing was measured for `PASS_GAP_S`."""
    order = np.argsort(time_s, kind="stable")
    numbers = np.concatenate([[0], np.cumsum(np.diff(time_s[order]) > PASS_GAP_S)]).astype(np.int64)
    found = np.empty(len(time_s), np.int64)
    found[order] = numbers
    return found
