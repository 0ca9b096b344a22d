"""Displacements of image lines, estimated from the residuals of ties.

What the corrected cameras leave of the residuals of ties is noise, and displacements that all ties near a line of an
image share (see `zlocus.sensors.line_shifts`). The displacements of every image are Gaussian processes of the line
(Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, equations 2.23 and 2.30). Their size and their
smoothness are those under which the residuals are likeliest; where a process explains no more than noise does, there
is none. Ground points give way along east and north. Their heights are held: what looks like a height in all images is
left as it is, because terrain looks the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, Scanning, bare
from zlocus.orientation.shift_adjustment import Adjustment, huber_weight, robust_sigma
from zlocus.orientation.triangulate import Observations, rows_of_views, summed
from zlocus.sensors.line_shifts import LineShifts

# Lines between two nodes: this many, or more in images so long that they would have more nodes.
MIN_SPACING, MAX_NODES = 25.0, 400
# Processes among which the likeliest is chosen: their standard deviation, px, and the distance over which displacements
# are alike, in nodes.
SIGMAS_PX, LENGTHS_NODES = (0.02, 0.05, 0.1, 0.2, 0.4), (2.0, 4.0, 8.0, 16.0)
# White part of a process, of its variance, so that its covariance can be inverted.
WHITE_SHARE = 1e-4
# How much likelier the residuals must be with displacements than without, as a logarithm.
MIN_LOG_ODDS = 10.0
# An image needs so many ties.
MIN_TIES = 30
ITERATIONS = 6
SMALLEST_DETERMINANT = 1e-9


@dataclass(frozen=True)
class _Process:
    """A Gaussian process at the nodes of an image: its inverse covariance (k, k), the logarithm of the latter's
    determinant, and the sum of the variances at all nodes."""

    precision: FloatArray
    log_determinant: float
    total_variance: float


def estimated_line_shifts(views: Sequence[View], adjustment: Adjustment) -> tuple[LineShifts | None, ...]:
    """Displacements of the lines of each view; None where there are none, and for cameras without lines.

    adjustment : of the ties, with the corrected cameras.
    """
    observations, ground_points = adjustment.observations, adjustment.ground_points
    rows = rows_of_views(observations, len(views))
    estimators = [_Estimator.of(view, observations.xy[mine, 1]) for view, mine in zip(views, rows, strict=True)]
    if not any(estimators):
        return no_line_shifts(views)
    horizontal = ground_points.by_ground[:, :, :2]
    finite = np.isfinite(np.column_stack([ground_points.residual, horizontal.reshape(-1, 4)]))
    is_usable = np.asarray(finite.all(axis=1), np.bool_)
    residual = np.where(is_usable[:, None], ground_points.residual, 0.0)
    horizontal = np.where(is_usable[:, None, None], horizontal, 0.0)
    shift = np.zeros_like(residual)
    left = residual
    for iteration in range(ITERATIONS):
        sigma = robust_sigma(left[is_usable])
        weight = np.where(is_usable, huber_weight(left, sigma), 0.0)
        left = residual - shift
        left = left - _explained_by_motion(left, horizontal, weight, observations.point, len(ground_points.xyz))
        for mine, estimator in zip(rows, estimators, strict=True):
            if estimator is not None:
                estimator.fit(left[mine] + shift[mine], weight[mine], sigma, may_choose=iteration == 0)
                shift[mine] = estimator.at_ties()
    return tuple(estimator.line_shifts() if estimator is not None else None for estimator in estimators)


def no_line_shifts(views: Sequence[View]) -> tuple[LineShifts | None, ...]:
    """No displacement of the lines of any view."""
    return (None,) * len(views)


def without_line_shifts(observations: Observations, line_shifts: Sequence[LineShifts | None]) -> Observations:
    """Observations where the image points would be if no line were displaced."""
    xy = observations.xy.copy()
    for number, of_view in enumerate(line_shifts):
        if of_view is not None:
            mine = observations.view == number
            xy[mine] -= of_view.at(observations.xy[mine, 1])
    return Observations(observations.view, observations.point, xy)


def _explained_by_motion(
    residual: FloatArray, horizontal: FloatArray, weight: FloatArray, point: NDArray[np.int64], n_points: int
) -> FloatArray:
    """The part (m, 2) px of the residuals that horizontal motions of the ground points explain.

    horizontal : (m, 2, 2) px per m, derivatives of the image points by east and north.
    """
    normal = summed(np.einsum("mji,mjk,m->mik", horizontal, horizontal, weight).reshape(-1, 4), point, n_points)
    normal = normal.reshape(-1, 2, 2)
    pull = summed(np.einsum("mji,mj,m->mi", horizontal, residual, weight), point, n_points)
    is_solvable = np.linalg.det(normal) > SMALLEST_DETERMINANT * np.trace(normal, axis1=1, axis2=2) ** 2
    motion = np.zeros_like(pull)
    motion[is_solvable] = np.linalg.solve(normal[is_solvable], pull[is_solvable][..., None])[..., 0]
    return np.asarray(np.einsum("mji,mi->mj", horizontal, motion[point]))


class _Estimator:
    """The displacements of one view.

    node : (m, 2) the nodes before and after the lines of its ties; share : (m, 2) how much each counts there.
    """

    def __init__(self, spacing: float, n_nodes: int, rows: FloatArray) -> None:
        self.spacing, self.n_nodes = spacing, n_nodes
        position = np.clip(rows / spacing, 0.0, n_nodes - 1 - 1e-9)
        before = np.floor(position).astype(np.int64)
        self.node = np.column_stack([before, before + 1])
        self.share = np.column_stack([1.0 - (position - before), position - before])
        self.chosen: list[_Process | None] = [None, None]
        self.shift = np.zeros((n_nodes, 2))

    @classmethod
    def of(cls, view: View, rows: FloatArray) -> _Estimator | None:
        """The estimator of a view with ties in lines `rows` (m,); None for cameras without lines or too few ties."""
        if view.sensor.height_bounds() is None or isinstance(bare(view.sensor), Scanning) or len(rows) < MIN_TIES:
            return None
        spacing = max(MIN_SPACING, view.image.shape[0] / MAX_NODES)
        return cls(spacing, int(np.ceil(view.image.shape[0] / spacing)) + 1, rows)

    def fit(self, residual: FloatArray, weight: FloatArray, sigma: float, may_choose: bool) -> None:
        """Fit the displacements to residuals (m, 2) px with weights (m,) and noise `sigma` px.

        may_choose : choose the processes first; without, those chosen before are used.
        """
        weighted = weight[:, None] / sigma**2 * self.share
        normal = np.zeros((self.n_nodes, self.n_nodes))
        for a in (0, 1):
            for b in (0, 1):
                np.add.at(normal, (self.node[:, a], self.node[:, b]), weighted[:, a] * self.share[:, b])
        for axis in (0, 1):
            pull = np.zeros(self.n_nodes)
            np.add.at(pull, self.node.ravel(), (weighted * residual[:, axis, None]).ravel())
            if may_choose:
                self.chosen[axis] = _likeliest(normal, pull)
            process = self.chosen[axis]
            if process is not None:
                # SciPy's linear algebra takes a quarter of a second to import. Most runs do not come here.
                from scipy.linalg import cho_factor, cho_solve

                self.shift[:, axis] = cho_solve(cho_factor(normal + process.precision), pull)

    def at_ties(self) -> FloatArray:
        """Displacements (m, 2) px of the ties."""
        return np.asarray((self.shift[self.node] * self.share[..., None]).sum(axis=1))

    def line_shifts(self) -> LineShifts | None:
        """The displacements; None where there are none."""
        return None if self.chosen == [None, None] else LineShifts(self.spacing, self.shift)


def _likeliest(normal: FloatArray, pull: FloatArray) -> _Process | None:
    """The process under which residuals are likeliest; None where they are nearly as likely without.

    normal : (k, k), pull : (k,), normal equations of the displacements at the nodes.
    """
    best, best_odds = None, MIN_LOG_ODDS
    for process in _processes(len(pull)):
        # With the pull p as one more row and column, the last row of the Cholesky factor L of N holds L^-1 p, the
        # square of which is p^T N^-1 p. The last element is larger than that, so that the matrix is positive definite.
        last = 1.0 + process.total_variance * (pull @ pull)
        bordered = np.block([[normal + process.precision, pull[:, None]], [pull, last]])
        factor = np.linalg.cholesky(bordered)
        log_determinant = 2.0 * np.log(np.diag(factor)[:-1]).sum()
        odds = 0.5 * (process.log_determinant - log_determinant + factor[-1, :-1] @ factor[-1, :-1])
        if odds > best_odds:
            best, best_odds = process, odds
    return best


def _processes(n_nodes: int) -> list[_Process]:
    """All processes that may be chosen."""
    node = np.arange(n_nodes, dtype=float)
    found = []
    for length in LENGTHS_NODES:
        correlation = np.exp(-0.5 * ((node[:, None] - node) / length) ** 2) + WHITE_SHARE * np.eye(n_nodes)
        inverse = np.asarray(np.linalg.inv(correlation), float)
        log_determinant, trace = -float(np.linalg.slogdet(correlation)[1]), float(np.trace(correlation))
        found += [
            _Process(
                inverse / sigma**2, log_determinant - 2.0 * n_nodes * float(np.log(sigma)), trace * sigma**2
            )
            for sigma in SIGMAS_PX
        ]  # fmt: skip
    return found
