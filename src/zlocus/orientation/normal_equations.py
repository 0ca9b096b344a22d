"""Normal equations of the joint orientation: Gauss-Newton with Huber's loss, ground points eliminated.

The ground points leave the normal equations by the Schur complement (Triggs et al. 2000, *Bundle adjustment - a modern
synthesis*, section 6.1); what is left, one block per camera, is solved by SciPy. Variance
components (Koch and Kusche 2002, *Regularization of geopotential determination from satellite data by variance
components*) tell which kinds of corrections the ties ask for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.control import TerrainHeights
from zlocus.orientation.parameter_groups import ParameterGroup, corrected_sensors
from zlocus.orientation.shift_adjustment import HUBER_SIGMAS, huber_weight, robust_sigma
from zlocus.orientation.triangulate import Observations, ground_jacobian, project_points, summed

MAX_ITERATIONS = 40
TOLERANCE_PX = 1e-3
# Variances of corrections are estimated again, with the corrections, until none changes by a larger share.
VARIANCE_TOLERANCE = 0.1
VARIANCE_ROUNDS = 12
# Corrections of one kind say how large they are where ties show at least so many of them.
MIN_DETERMINED_PARAMETERS = 0.5
MIN_VARIANCE = 1e-12
# Derivatives are taken again after a step that moves image points by more.
RELINEARISE_PX = 5.0
# Of a parameter's sigma, for its derivative.
DIFFERENCE = 0.05
# Errors that the ties of an image have in common (of matching, of lenses, of what blocks do not model): however many
# ties there are, together they count as one that is off by this. Otherwise thousands of them would move a camera by
# many times that where they hardly hold it, against all that is known beforehand.
COMMON_PX = 0.03


@dataclass(frozen=True, eq=False)
class Problem:
    """What is adjusted.

    sensors : as delivered; blocks : of their parameters; observations : image points of ties, then of control points;
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
        """(m,) which image points are those of ties."""
        return np.asarray(self.observations.point < self.n_ties)

    @property
    def n_points(self) -> int:
        """Ties and control points."""
        return self.n_ties + len(self.control_xyz)

    @property
    def n_parameters(self) -> int:
        """Of all groups."""
        return sum(map(len, self.groups))

    @property
    def is_controlled(self) -> bool:
        """Whether anything is known of the ground."""
        return bool(len(self.control_xyz)) or self.terrain is not None

    @property
    def kinds(self) -> NDArray[np.int64]:
        """(p,) numbers of the kinds of parameters: those of one kind of block that have one standard deviation."""
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
    """Information of ground points beforehand: precision (n, 3, 3) px2 per m2 and pull (n, 3) px2 per m towards it."""

    precision: FloatArray
    pull: FloatArray


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations of the parameters once ground points are eliminated: normal (p, p) px2, pull (p,) px2; mixed :
    sparse (p, 3 n); covariance (n, 3, 3) m2 per px2, 0 where a point is not fixed; pull_of_points (n, 3) px2 per m."""

    normal: FloatArray
    pull: FloatArray
    mixed: Any
    covariance: FloatArray
    pull_of_points: FloatArray


@dataclass(frozen=True, eq=False)
class WeakDirections:
    """Directions of the parameters that ties hardly show. They would take up the small common errors of all ties,
    enlarged; so what ties say of them is left out, and priors and control decide.

    ahead, back : (p, k), whose product ahead @ back.T takes the share of the weak directions from a pull of the ties.
    """

    ahead: FloatArray
    back: FloatArray

    def without(self, full: Reduced, ties: Reduced) -> tuple[FloatArray, FloatArray]:
        """Normal matrix (p, p) and pull (p,) of everything, without what ties say of the weak directions."""
        left = ties.normal - self.ahead @ (self.back.T @ ties.normal)
        observations = left - (left @ self.back) @ self.ahead.T
        return full.normal - ties.normal + observations, full.pull - self.ahead @ (self.back.T @ ties.pull)


@dataclass(frozen=True, eq=False)
class PriorVariance:
    """How large parameters are thought to be.

    variance : (p,) in units of their sigma squared; n_rounds : of estimation so far; is_settled : whether it ended;
    is_held : (p,), see `Solution`.
    """

    variance: FloatArray
    n_rounds: int
    is_settled: bool
    is_held: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the adjustment ended.

    parameters : (p,) in units of their sigma; parameter_sigma : (p,), of those found, in the same units; is_held : (p,)
    which are zero because ties and control ask for none of their kind; xyz : (n, 3) m, ties, then control points;
    residual : (m, 2) px; sigma0_px : noise of one image coordinate of a tie, from the residuals of all ties kept and
    their redundancy; n_determined : how many directions of the parameters the ties show; n_steps : taken.
    """

    parameters: FloatArray
    parameter_sigma: FloatArray
    is_held: NDArray[np.bool_]
    xyz: FloatArray
    residual: FloatArray
    sigma0_px: float
    redundancy: int
    n_determined: int
    n_steps: int


def solve(problem: Problem, parameters: FloatArray, xyz: FloatArray) -> Solution:
    """Gauss-Newton from parameters (p,) and ground points of the ties xyz (n, 3) m, NaN where they are not known."""
    xyz = np.concatenate([xyz, problem.control_xyz])
    linear, weak, moved_px, n_steps = None, None, np.inf, 0
    ahead = PriorVariance(np.ones(len(parameters)), 0, False, np.zeros(len(parameters), bool))
    while True:
        sensors = corrected_sensors(problem.groups, problem.sensors, parameters)
        if linear is None or moved_px > RELINEARISE_PX:
            linear, weak = linearise(problem, parameters, xyz), None
        residual = problem.observations.xy - project_points(sensors, problem.observations, xyz)
        sigma, weight = weights(problem, residual, linear)
        of_ties = np.where(problem.is_tie, weight, 0.0)
        full = reduced(problem, linear, residual, weight, ground_information(problem, xyz, sigma))
        ties = reduced(problem, linear, residual, of_ties, None) if problem.is_controlled else full
        weak = weak_directions(problem, linear, of_ties, ties.normal) if weak is None else weak
        normal, pull = weak.without(full, ties)
        covariance = covariance_of(normal, sigma, ahead.variance)
        if n_steps == MAX_ITERATIONS or (ahead.is_settled and moved_px < TOLERANCE_PX):
            break
        if moved_px < TOLERANCE_PX:
            ahead = estimated(problem, ahead, parameters, np.diag(covariance))
            covariance = covariance_of(normal, sigma, ahead.variance)
        step = covariance @ (pull / sigma**2 - parameters / ahead.variance)
        rest = full.pull_of_points - (full.mixed.T @ step).reshape(-1, 3)
        parameters = parameters + step
        moved_px = float(np.abs(linear.by_parameters @ step).max(initial=0.0))
        xyz = xyz + np.einsum("nij,nj->ni", full.covariance, rest)
        n_steps += 1
    n_determined = len(parameters) - weak.ahead.shape[1]
    used = of_ties > 0.0
    redundancy = 2 * int(used.sum()) - 3 * len(np.unique(problem.observations.point[used])) - n_determined
    sigma0 = np.sqrt((residual[used] ** 2).sum() / redundancy) if redundancy > 0 else np.nan
    parameters = np.where(ahead.is_held, 0.0, parameters)
    found = parameters, np.sqrt(np.diag(covariance)), ahead.is_held
    return Solution(*found, xyz, residual, float(sigma0), redundancy, n_determined, n_steps)


def covariance_of(normal: FloatArray, sigma: float, variance: FloatArray) -> FloatArray:
    """Of the parameters (p, p), in units of their sigma: normal (p, p) px2 of image coordinates, sigma px their noise;
    variance (p,) beforehand."""
    return np.asarray(linalg.inv(normal / sigma**2 + np.diag(1.0 / variance)))


def estimated(problem: Problem, ahead: PriorVariance, parameters: FloatArray, after: FloatArray) -> PriorVariance:
    """How large parameters (p,) are thought to be, from how large they came out. after : (p,) their variances now.

    The variance of a kind is the sum of its squares over how many of its parameters are shown, at most 1. Parameters no
    larger than what noise makes of them get less every time, until none is shown: ties ask for no correction of that
    kind, and it is held at zero. All other kinds are given their sigma again: less of it would leave a part of their
    errors.
    """
    kinds, variance = problem.kinds, ahead.variance
    n_shown = np.bincount(kinds, 1.0 - after / variance, len(kinds))[kinds]
    is_shown = n_shown > MIN_DETERMINED_PARAMETERS
    squares = np.bincount(kinds, parameters**2, len(kinds))[kinds]
    new = np.where(is_shown, np.clip(squares / np.where(is_shown, n_shown, 1.0), MIN_VARIANCE, 1.0), variance)
    n_rounds = ahead.n_rounds + 1
    changed = np.abs(np.log(new / variance)).max(initial=0.0)
    if changed > VARIANCE_TOLERANCE and n_rounds < VARIANCE_ROUNDS:
        return PriorVariance(new, n_rounds, False, ahead.is_held)
    is_held = ~is_shown & (variance < 1.0)
    return PriorVariance(np.where(is_held, new, 1.0), n_rounds, True, is_held)


def weights(problem: Problem, residual: FloatArray, linear: Linearised) -> tuple[float, FloatArray]:
    """Noise of the ties' image coordinates (px), and the weight (m,) of each image point against theirs; 0 where
    nothing can be computed."""
    ties = problem.is_tie
    usable = linear.usable & np.isfinite(residual).all(axis=1)
    sigma = robust_sigma(residual[ties & usable])
    n_per_view = (ties & usable).sum() / max(len(np.unique(problem.observations.view[ties & usable])), 1)
    scale = np.where(ties, 1.0, sigma / problem.control_px)
    base = np.where(ties, 1.0 / (1.0 + n_per_view * (COMMON_PX / sigma) ** 2), scale**2)
    weight = base * huber_weight(residual * scale[:, None], sigma)
    return sigma, np.where(usable, weight, 0.0)


def linearise(problem: Problem, parameters: FloatArray, xyz: FloatArray) -> Linearised:
    """Derivatives of all image points, by differences; xyz : (n, 3) m."""
    sensors = corrected_sensors(problem.groups, problem.sensors, parameters)
    by_ground = ground_jacobian(sensors, problem.observations, xyz)
    here = project_points(sensors, problem.observations, xyz)
    rows_of = [np.flatnonzero(problem.observations.view == i) for i in range(len(sensors))]
    values, rows, columns = [np.empty(0)], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    first = 0
    for group in problem.groups:
        for k in range(first, first + len(group)):
            changed = parameters.copy()
            changed[k] += DIFFERENCE
            for i in group.views:
                at = xyz[problem.observations.point[rows_of[i]]]
                moved = corrected_sensor(problem, changed, i).image_from_ground(at) - here[rows_of[i]]
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


def corrected_sensor(problem: Problem, parameters: FloatArray, view: int) -> SensorModel:
    """The sensor of one view with all blocks that it belongs to."""
    sensor, first = problem.sensors[view], 0
    for group in problem.groups:
        if view in group.views:
            sensor = group.correct(sensor, parameters[first : first + len(group)] * group.sigma)
        first += len(group)
    return sensor


def ground_information(problem: Problem, xyz: FloatArray, sigma: float) -> GroundInformation:
    """What control points and the terrain say at ground points xyz (n, 3) m. sigma : px, as of now.

    Heights of the terrain get Huber's weight: trees, houses and mistakes of the terrain stand out of it.
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
    problem: Problem, linear: Linearised, residual: FloatArray, weight: FloatArray, ground: GroundInformation | None
) -> Reduced:
    """Normal equations without the ground points: A - E C^-1 E^T, with A the parameters' block, E that of parameters by
    points and C that of the points. ground : None leaves out what is known of them, times px2.

    Points that their rays (and the ground) do not fix are left out, with their image points.
    """
    point, n = problem.observations.point, problem.n_points
    scaled = weight[:, None, None] * linear.by_ground
    own = summed(np.einsum("mji,mjk->mik", scaled, linear.by_ground).reshape(-1, 9), point, n).reshape(-1, 3, 3)
    covariance = inverses(own if ground is None else own + ground.precision)
    fixed = np.isfinite(covariance[:, 0, 0])
    covariance = np.where(fixed[:, None, None], covariance, 0.0)
    used = np.where(fixed[point], weight, 0.0)
    pulls = used[:, None] * np.nan_to_num(residual)
    by_points = np.einsum("mji,mj->mi", linear.by_ground, pulls)
    pull_of_points = summed(by_points, point, n)
    if ground is not None:
        pull_of_points = pull_of_points + np.where(fixed[:, None], ground.pull, 0.0)
    weighted = sparse.diags_array(np.repeat(used, 2)) @ linear.by_parameters
    mixed = weighted.T @ spread(linear.by_ground, point, n)
    eliminated = mixed @ sparse.bsr_array((covariance, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
    normal = (linear.by_parameters.T @ weighted - eliminated @ mixed.T).toarray()
    pull = linear.by_parameters.T @ pulls.ravel() - eliminated @ pull_of_points.ravel()
    return Reduced(normal, pull, mixed, covariance, pull_of_points)


def spread(by_ground: FloatArray, point: NDArray[np.int64], n_points: int) -> Any:
    """Derivatives (m, 2, 3) as a sparse matrix (2 m, 3 n)."""
    rows = np.broadcast_to(np.arange(2 * len(point)).reshape(-1, 2, 1), by_ground.shape)
    columns = np.broadcast_to((3 * point)[:, None, None] + np.arange(3), by_ground.shape)
    shape = (2 * len(point), 3 * n_points)
    return sparse.csr_array((by_ground.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def weak_directions(problem: Problem, linear: Linearised, weight: FloatArray, normal: FloatArray) -> WeakDirections:
    """Directions whose information from ties, per image point, is next to nothing (see
    `groups.MIN_INFORMATION_IN_IMAGE`).

    normal : (p, p) of the ties alone.
    """
    squared = linear.by_parameters.multiply(linear.by_parameters).T @ np.repeat(weight, 2)
    observations = np.concatenate([np.full(len(group), group.observations) for group in problem.groups])
    scale = np.sqrt(squared * observations)
    linked = scale > 0.0
    inverse = np.where(linked, 1.0 / np.where(linked, scale, 1.0), 0.0)
    n_views = max(len(np.unique(problem.observations.view[weight > 0.0])), 1)
    scaled = normal * inverse[:, None] * inverse
    _, vectors = linalg.eigh(scaled, subset_by_value=(-np.inf, 1.0 / n_views**2))
    return WeakDirections(scale[:, None] * vectors, inverse[:, None] * vectors)


def inverses(matrix: FloatArray) -> FloatArray:
    """Inverses (n, 3, 3) of symmetric matrices; NaN where there is none."""
    scale = np.trace(matrix, axis1=1, axis2=2)
    solvable = np.linalg.det(matrix) > 1e-12 * scale**3
    inverse = np.full(matrix.shape, np.nan)
    inverse[solvable] = np.linalg.inv(matrix[solvable])
    return inverse
