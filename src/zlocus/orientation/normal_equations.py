"""Normal equations of the bundle adjustment: Gauss-Newton with Huber's loss, ground points eliminated.

The ground points leave the normal equations by the Schur complement (Triggs et al. 2000, *Bundle adjustment - a modern
synthesis*, section 6.1); the rest, a few parameters per camera, is solved by SciPy. Variance
components (Koch and Kusche 2002, *Regularization of geopotential determination from satellite data by variance
components*) show which kinds of corrections the ties require.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.control import TerrainHeights
from zlocus.orientation.determinability import (
    HELD_VARIANCE,
    BlockHeights,
    BlockInformation,
    HeldParameter,
    mean_camera_heights,
    undetermined_parameters,
)
from zlocus.orientation.information import (
    MAX_DENSE_PARAMETERS,
    DenseInformation,
    Information,
    WeakDirections,
    diagonal_matrix,
    weak_directions,
)
from zlocus.orientation.parameter_groups import ParameterGroup, corrected_sensors
from zlocus.orientation.shift_adjustment import HUBER_SIGMAS, huber_weight, robust_sigma
from zlocus.orientation.triangulate import Observations, ground_jacobian, project_points, rows_of_views, summed

MAX_ITERATIONS = 100
TOLERANCE_PX = 1e-3
# Variances of corrections are estimated again, with the corrections, until none changes by a larger share.
VARIANCE_TOLERANCE = 0.1
VARIANCE_ROUNDS = 12
# The variance of a kind of corrections is estimated where ties determine at least so many of its parameters.
MIN_DETERMINED_PARAMETERS = 0.5
MIN_VARIANCE = 1e-12
# Derivatives are computed again after a step that moves image points by more.
RELINEARISE_PX = 5.0
# Step of a parameter for its derivative, in units of its sigma.
DIFFERENCE = 0.05
# Error that the ties of an image have in common (of matching, of lenses, of what the parameters do not model). All ties
# of an image together count as one tie with this error, however many there are. Otherwise thousands of ties would move
# a camera by many times this error in directions that they hardly determine, against its prior.
COMMON_PX = 0.03


@dataclass(frozen=True, eq=False)
class Problem:
    """The adjustment problem.

    sensors : as delivered; groups : of their parameters; observations : image points of ties, then of control points;
    n_ties : the first so many ground points are ties; control_xyz, control_precision : (k, 3) m and 1/m2 of the others;
    control_px : sigma of their image points; terrain : heights that ties should have, with their sigma in m.
    """

    sensors: tuple[SensorModel, ...]
    groups: tuple[ParameterGroup, ...]
    observations: Observations
    n_ties: int
    control_xyz: FloatArray
    control_precision: FloatArray
    control_px: float
    terrain: TerrainHeights | None
    terrain_m: float

    @property
    def is_tie(self) -> NDArray[np.bool_]:
        """Image points (m,) of ties, not of control points."""
        return np.asarray(self.observations.point < self.n_ties)

    @property
    def n_points(self) -> int:
        """Number of ties and control points."""
        return self.n_ties + len(self.control_xyz)

    @property
    def n_parameters(self) -> int:
        """Of all groups."""
        return sum(map(len, self.groups))

    @property
    def is_controlled(self) -> bool:
        """Whether there are control points or terrain heights."""
        return bool(len(self.control_xyz)) or self.terrain is not None

    @property
    def is_dense(self) -> bool:
        """Whether the matrices of the parameters are dense: in small problems, and where images share parameters of a
        self-calibration, whose correlations are compared."""
        return self.n_parameters <= MAX_DENSE_PARAMETERS or any(group.is_calibration for group in self.groups)

    @property
    def kinds(self) -> NDArray[np.int64]:
        """Number (p,) of the kind of each parameter: one kind of group and one standard deviation are one kind."""
        kinds = [(group.kind, sigma) for group in self.groups for sigma in group.sigma]
        return np.array([kinds.index(kind) for kind in kinds], np.int64)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Derivatives of image points.

    by_parameters : sparse (2 m, p) px per sigma of each parameter; by_ground : (m, 2, 3) px per m; usable : (m,) where
    all of them are finite.
    """

    by_parameters: Any
    by_ground: FloatArray
    usable: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class GroundInformation:
    """Prior information of ground points: precision (n, 3, 3) px2 per m2, and pull (n, 3) px2 per m towards the
    prior."""

    precision: FloatArray
    pull: FloatArray


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """Normal equations of the parameters once ground points are eliminated: normal (p, p) px2, dense or sparse (see
    `Problem.is_dense`); pull (p,) px2; mixed : sparse (p, 3 n); covariance (n, 3, 3) m2 per px2, 0 where a point is not
    fixed; pull_of_points (n, 3) px2 per m."""

    normal: Any
    pull: FloatArray
    mixed: Any
    covariance: FloatArray
    pull_of_points: FloatArray


@dataclass(frozen=True, eq=False)
class PriorVariance:
    """Prior variances of the parameters, which are estimated together with them.

    variance : (p,) in units of their sigma squared; n_rounds : of estimation so far; has_converged : whether it ended;
    is_held : (p,), see `Solution`; held_parameters : see `Solution`, None before the first estimation.
    """

    variance: FloatArray
    n_rounds: int
    has_converged: bool
    is_held: NDArray[np.bool_]
    held_parameters: tuple[HeldParameter, ...] | None = None

    @property
    def is_undetermined(self) -> NDArray[np.bool_]:
        """Which parameters (p,) are held because the block does not determine them."""
        return np.asarray(np.isin(np.arange(len(self.variance)), [each.index for each in self.held_parameters or ()]))


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of the normal equations.

    parameters : (p,) in units of their sigma; parameter_sigma : (p,), of those found, in the same units; is_held : (p,)
    which are held at zero because ties and control require none of their kind or do not determine them; held_parameters
    : the latter, of a self-calibration; xyz : (n, 3) m, ties, then control points; residual : (m, 2) px; sigma0_px :
    noise of one image coordinate of a tie, from the residuals of all ties kept and their redundancy; n_determined :
    number of directions of the parameters that the ties determine; n_steps : number of steps.
    """

    parameters: FloatArray
    parameter_sigma: FloatArray
    is_held: NDArray[np.bool_]
    held_parameters: tuple[HeldParameter, ...]
    xyz: FloatArray
    residual: FloatArray
    sigma0_px: float
    redundancy: int
    n_determined: int
    n_steps: int


def solve(problem: Problem, parameters: FloatArray, xyz: FloatArray) -> Solution:
    """Solve an adjustment problem by Gauss-Newton steps.

    parameters : (p,) to start from; xyz : (n, 3) m, first ground points of the ties, NaN where they are not known.
    """
    xyz = np.concatenate([xyz, problem.control_xyz])
    linearised, weak, moved_px, n_steps = None, None, np.inf, 0
    prior_variance = PriorVariance(np.ones(len(parameters)), 0, False, np.zeros(len(parameters), bool))
    while True:
        sensors = corrected_sensors(problem.groups, problem.sensors, parameters)
        if linearised is None or moved_px > RELINEARISE_PX:
            linearised, weak = linearise(problem, parameters, xyz), None
        residual = problem.observations.xy - project_points(sensors, problem.observations, xyz)
        sigma, weight = weights(problem, residual, linearised)
        of_ties = np.where(problem.is_tie, weight, 0.0)
        full = reduced(problem, linearised, residual, weight, ground_information(problem, xyz, sigma))
        ties = reduced(problem, linearised, residual, of_ties, None) if problem.is_controlled else full
        weak = weak_directions_of_ties(problem, linearised, of_ties, ties.normal) if weak is None else weak
        information = weak.information_without(full.normal, ties.normal)
        pull = weak.pull_without(full.pull, ties.pull)
        covariance = information.covariance(sigma, prior_variance.variance)
        if n_steps == MAX_ITERATIONS or (prior_variance.has_converged and moved_px < TOLERANCE_PX):
            break
        if moved_px < TOLERANCE_PX:
            if prior_variance.held_parameters is None:
                held = held_parameters(problem, sensors, full, information, sigma)
                prior_variance = replace(prior_variance, held_parameters=held)
            prior_variance = estimated_variance(problem, prior_variance, parameters, covariance.variances)
            covariance = information.covariance(sigma, prior_variance.variance)
        step = covariance.times(pull / sigma**2 - parameters / prior_variance.variance)
        rest = full.pull_of_points - (full.mixed.T @ step).reshape(-1, 3)
        parameters = parameters + step
        moved_px = float(np.abs(linearised.by_parameters @ step).max(initial=0.0))
        xyz = xyz + np.einsum("nij,nj->ni", full.covariance, rest)
        n_steps += 1
    n_determined = len(parameters) - weak.n
    used = of_ties > 0.0
    redundancy = 2 * int(used.sum()) - 3 * len(np.unique(problem.observations.point[used])) - n_determined
    sigma0 = np.sqrt((residual[used] ** 2).sum() / redundancy) if redundancy > 0 else np.nan
    if redundancy > 0:
        # Residuals are smaller than the noise, because parameters and ground points follow a part of it.
        covariance = information.covariance(sigma * np.sqrt(2 * used.sum() / redundancy), prior_variance.variance)
    parameters = np.where(prior_variance.is_held, 0.0, parameters)
    of_parameters = np.sqrt(covariance.variances), prior_variance.is_held, prior_variance.held_parameters or ()
    return Solution(parameters, *of_parameters, xyz, residual, float(sigma0), redundancy, n_determined, n_steps)


def estimated_variance(
    problem: Problem, prior_variance: PriorVariance, parameters: FloatArray, after: FloatArray
) -> PriorVariance:
    """Prior variances of the parameters, estimated from the parameters (p,) of the last round.

    after : (p,) variances of the parameters now. The variance of a kind is the sum of its squared parameters over the
    number of its determined parameters, at most 1. Where parameters are no larger than their noise, the variance
    shrinks in every round until none of them is determined: the ties require no correction of that kind, and it is held
    at zero. All other kinds get their full sigma again, because a smaller one would leave a part of their errors.
    """
    kinds, variance = problem.kinds, prior_variance.variance
    n_shown = np.bincount(kinds, 1.0 - after / variance, len(kinds))[kinds]
    is_shown = n_shown > MIN_DETERMINED_PARAMETERS
    squares = np.bincount(kinds, parameters**2, len(kinds))[kinds]
    new = np.where(is_shown, np.clip(squares / np.where(is_shown, n_shown, 1.0), MIN_VARIANCE, 1.0), variance)
    n_rounds, undetermined = prior_variance.n_rounds + 1, prior_variance.is_undetermined
    new = np.where(undetermined, HELD_VARIANCE, new)
    changed = np.abs(np.log(new / variance)).max(initial=0.0)
    if changed > VARIANCE_TOLERANCE and n_rounds < VARIANCE_ROUNDS:
        return PriorVariance(new, n_rounds, False, prior_variance.is_held, prior_variance.held_parameters)
    is_held = undetermined | (~is_shown & (variance < 1.0))
    return PriorVariance(np.where(is_held, new, 1.0), n_rounds, True, is_held, prior_variance.held_parameters)


def held_parameters(
    problem: Problem,
    sensors: Sequence[SensorModel],
    equations: ReducedEquations,
    information: Information,
    sigma: float,
) -> tuple[HeldParameter, ...]:
    """The parameters of a self-calibration that are held, see `undetermined_parameters`. sigma : noise now, px."""
    if not isinstance(information, DenseInformation):  # there is no self-calibration, see `Problem.is_dense`
        return ()
    known = BlockInformation(information.normal / sigma**2, equations.normal / sigma**2, problem.is_controlled)
    return undetermined_parameters(problem.groups, known, block_heights(problem, sensors, equations))


def block_heights(problem: Problem, sensors: Sequence[SensorModel], equations: ReducedEquations) -> BlockHeights:
    """How ground and cameras rise with the parameters: the ground points follow the cameras by C^-1 E^T."""
    mean_height = np.zeros((problem.n_points, 3))
    mean_height[: problem.n_ties] = equations.covariance[: problem.n_ties, 2] / max(problem.n_ties, 1)
    return BlockHeights(-(equations.mixed @ mean_height.ravel()), mean_camera_heights(problem.groups, sensors))


def weights(problem: Problem, residual: FloatArray, linearised: Linearised) -> tuple[float, FloatArray]:
    """Noise of the image coordinates of ties (px), and the weight (m,) of each image point relative to those of ties.

    The weight is 0 where a residual or derivative is not finite.
    """
    ties = problem.is_tie
    usable = linearised.usable & np.isfinite(residual).all(axis=1)
    sigma = robust_sigma(residual[ties & usable])
    n_per_view = (ties & usable).sum() / max(len(np.unique(problem.observations.view[ties & usable])), 1)
    scale = np.where(ties, 1.0, sigma / problem.control_px)
    base = np.where(ties, 1.0 / (1.0 + n_per_view * (COMMON_PX / sigma) ** 2), scale**2)
    weight = base * huber_weight(residual * scale[:, None], sigma)
    return sigma, np.where(usable, weight, 0.0)


def linearise(problem: Problem, parameters: FloatArray, xyz: FloatArray) -> Linearised:
    """Derivatives of all image points by parameters and ground points, by differences; xyz : (n, 3) m."""
    sensors = corrected_sensors(problem.groups, problem.sensors, parameters)
    by_ground = ground_jacobian(sensors, problem.observations, xyz)
    here = project_points(sensors, problem.observations, xyz)
    rows_of, groups_of = rows_of_views(problem.observations, len(sensors)), groups_of_views(problem)
    values, rows, columns = [np.empty(0)], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    first = 0
    for group in problem.groups:
        for k in range(first, first + len(group)):
            changed = parameters.copy()
            changed[k] += DIFFERENCE
            for i in group.views:
                at = xyz[problem.observations.point[rows_of[i]]]
                moved = corrected_sensor(problem, changed, i, groups_of[i]).image_from_ground(at) - here[rows_of[i]]
                values.append(moved.ravel() / DIFFERENCE)
                rows.append((2 * rows_of[i][:, None] + np.arange(2)).ravel())
                columns.append(np.full(2 * len(at), k))
        first += len(group)
    value, row = np.concatenate(values), np.concatenate(rows)
    usable = np.asarray(np.isfinite(by_ground).all(axis=(1, 2)))
    usable[row[~np.isfinite(value)] // 2] = False
    shape = (2 * len(problem.observations), len(parameters))
    matrix = sparse.csr_array((np.nan_to_num(value), (row, np.concatenate(columns))), shape=shape)
    return Linearised(matrix, np.where(usable[:, None, None], by_ground, 0.0), usable)


def groups_of_views(problem: Problem) -> list[list[tuple[ParameterGroup, int]]]:
    """For each view the groups that it belongs to, with the number of their first parameter."""
    groups: list[list[tuple[ParameterGroup, int]]] = [[] for _ in problem.sensors]
    first = 0
    for group in problem.groups:
        for view in group.views:
            groups[view].append((group, first))
        first += len(group)
    return groups


def corrected_sensor(
    problem: Problem, parameters: FloatArray, view: int, groups: Sequence[tuple[ParameterGroup, int]]
) -> SensorModel:
    """The sensor of one view, corrected by all parameter groups that it belongs to. groups : see `groups_of_views`."""
    sensor = problem.sensors[view]
    for group, first in groups:
        sensor = group.correct(sensor, parameters[first : first + len(group)] * group.sigma)
    return sensor


def ground_information(problem: Problem, xyz: FloatArray, sigma: float) -> GroundInformation:
    """Information of control points and of the terrain at ground points xyz (n, 3) m. sigma : noise now, px.

    Heights of the terrain get Huber's weight, because trees, houses and errors of the terrain stand out of it.
    """
    precision, pull = np.zeros((len(xyz), 3, 3)), np.zeros((len(xyz), 3))
    missed = problem.control_xyz - xyz[problem.n_ties :]
    precision[problem.n_ties :] = np.eye(3) * problem.control_precision[:, None]
    pull[problem.n_ties :] = problem.control_precision * missed
    if problem.terrain is not None:
        ties = xyz[: problem.n_ties]
        z, slope = problem.terrain.at(ties[:, :2])
        off = ties[:, 2] - z
        known = np.isfinite(off) & np.isfinite(slope).all(axis=1)
        away = np.abs(np.where(known, off, 0.0))
        weight = known / np.maximum(away / (HUBER_SIGMAS * problem.terrain_m), 1.0) / problem.terrain_m**2
        normal = np.where(known[:, None], np.column_stack([-slope, np.ones(len(ties))]), 0.0)
        precision[: problem.n_ties] += weight[:, None, None] * normal[:, :, None] * normal[:, None, :]
        pull[: problem.n_ties] -= (weight * np.where(known, off, 0.0))[:, None] * normal
    return GroundInformation(sigma**2 * precision, sigma**2 * pull)


def reduced(
    problem: Problem,
    linearised: Linearised,
    residual: FloatArray,
    weight: FloatArray,
    ground_information: GroundInformation | None,
) -> ReducedEquations:
    """Normal equations without the ground points: A - E C^-1 E^T, with A the block of the parameters, E that of
    parameters by points, and C that of the points. ground_information : None leaves out the information about the
    ground.

    Points that their rays (and the ground) do not fix are left out, with their image points.
    """
    point, n = problem.observations.point, problem.n_points
    scaled = weight[:, None, None] * linearised.by_ground
    own = summed(np.einsum("mji,mjk->mik", scaled, linearised.by_ground).reshape(-1, 9), point, n).reshape(-1, 3, 3)
    covariance = inverses(own if ground_information is None else own + ground_information.precision)
    fixed = np.isfinite(covariance[:, 0, 0])
    covariance = np.where(fixed[:, None, None], covariance, 0.0)
    used = np.where(fixed[point], weight, 0.0)
    pulls = used[:, None] * np.nan_to_num(residual)
    by_points = np.einsum("mji,mj->mi", linearised.by_ground, pulls)
    pull_of_points = summed(by_points, point, n)
    if ground_information is not None:
        pull_of_points = pull_of_points + np.where(fixed[:, None], ground_information.pull, 0.0)
    weighted = diagonal_matrix(np.repeat(used, 2)) @ linearised.by_parameters
    mixed = weighted.T @ spread(linearised.by_ground, point, n)
    eliminated = mixed @ sparse.bsr_array((covariance, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
    normal = linearised.by_parameters.T @ weighted - eliminated @ mixed.T
    normal = normal.toarray() if problem.is_dense else normal.tocsr()
    pull = linearised.by_parameters.T @ pulls.ravel() - eliminated @ pull_of_points.ravel()
    return ReducedEquations(normal, pull, mixed, covariance, pull_of_points)


def spread(by_ground: FloatArray, point: NDArray[np.int64], n_points: int) -> Any:
    """Derivatives (m, 2, 3) by ground points as a sparse matrix (2 m, 3 n)."""
    rows = np.broadcast_to(np.arange(2 * len(point)).reshape(-1, 2, 1), by_ground.shape)
    columns = np.broadcast_to((3 * point)[:, None, None] + np.arange(3), by_ground.shape)
    shape = (2 * len(point), 3 * n_points)
    return sparse.csr_array((by_ground.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def weak_directions_of_ties(
    problem: Problem, linearised: Linearised, weight: FloatArray, normal: Any
) -> WeakDirections:
    """Directions in which ties have almost no information per image point. normal : (p, p) of the ties alone."""
    squared = linearised.by_parameters.multiply(linearised.by_parameters).T @ np.repeat(weight, 2)
    min_information = np.concatenate([np.full(len(group), group.min_information) for group in problem.groups])
    n_views = max(len(np.unique(problem.observations.view[weight > 0.0])), 1)
    return weak_directions(normal, np.sqrt(squared * min_information), n_views)


def inverses(matrix: FloatArray) -> FloatArray:
    """Inverses (n, 3, 3) of symmetric matrices (n, 3, 3); NaN where a matrix is singular."""
    scale = np.trace(matrix, axis1=1, axis2=2)
    solvable = np.linalg.det(matrix) > 1e-12 * scale**3
    inverse = np.full(matrix.shape, np.nan)
    inverse[solvable] = np.linalg.inv(matrix[solvable])
    return inverse
