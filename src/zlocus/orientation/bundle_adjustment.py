"""Bundle adjustment: the cameras of all images and the ground points of all ties in one adjustment (method, section
1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zlocus.core.options import OrientationOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.determinability import parameter_words
from zlocus.orientation.normal_equations import Problem, Solution, solve
from zlocus.orientation.parameter_groups import ParameterGroup, corrected_sensors, parameter_groups_of
from zlocus.orientation.self_calibration import calibration_groups
from zlocus.orientation.shift_adjustment import Adjustment, renumbered, without_outliers
from zlocus.orientation.triangulate import Observations, project_points, triangulate

ROUNDS = 3


@dataclass(frozen=True)
class CalibratedParameter:
    """A parameter of a self-calibration.

    views : numbers of the images that share it; name : with its unit at the end; words : the same in a sentence; value,
    sigma : what was added and its standard deviation, in that unit; is_held : whether it was held at 0, sigma is NaN
    then.
    """

    views: tuple[int, ...]
    name: str
    words: str
    value: float
    sigma: float
    is_held: bool

    @property
    def unit(self) -> str:
        """The unit with a space before it; empty for coefficients, which have none."""
        return f" {self.name.rsplit('_', 1)[-1]}" if "_" in self.name else ""


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """Result of a bundle adjustment.

    sensors : corrected; adjustment : of the ties that were kept, with shifts of 0; control : the given points;
    control_points : (k, 3) m, their positions after the adjustment, NaN for check points that fewer than two images
    show; control_residual : (j, 2) px, of `control.observations`; terrain_m : (n,) m, heights of the ties minus those
    of the terrain.
    """

    sensors: tuple[SensorModel, ...]
    groups: tuple[ParameterGroup, ...]
    solution: Solution
    adjustment: Adjustment
    control: GroundControl
    control_points: FloatArray
    control_residual: FloatArray
    terrain_m: FloatArray

    @property
    def calibration(self) -> tuple[CalibratedParameter, ...]:
        """The parameters of the self-calibration."""
        first, found = 0, []
        for group in self.groups:
            part = slice(first, first + len(group))
            first += len(group)
            values, sigmas = (
                group.described(each[part] * group.sigma)
                for each in (self.solution.parameters, self.solution.parameter_sigma)
            )
            for name, is_held in zip(group.names, self.solution.is_held[part], strict=True):
                if group.is_calibration:
                    words = parameter_words(group, name)
                    sigma = float("nan") if is_held else sigmas[name]
                    found.append(CalibratedParameter(group.views, name, words, values[name], sigma, bool(is_held)))
        return tuple(found)

    def with_calibration_alone(self, sensors: Sequence[SensorModel]) -> tuple[SensorModel, ...]:
        """The sensors as delivered, with the parameters that the self-calibration found, but with their own poses."""
        is_calibration = np.repeat([group.is_calibration for group in self.groups], [len(each) for each in self.groups])
        return corrected_sensors(self.groups, sensors, np.where(is_calibration, self.solution.parameters, 0.0))


def adjust_bundle(
    views: Sequence[View],
    observations: Observations,
    xyz: FloatArray,
    options: OrientationOptions,
    control: GroundControl | None = None,
    terrain: TerrainHeights | None = None,
) -> BundleAdjustment:
    """Correct all cameras so that the rays of all ties meet, within their priors and the control.

    xyz : (n, 3) m, first ground points of the ties. Observations whose residual exceeds 4 sigma (and `inlier_px`) are
    dropped, then everything is solved again; this is done twice. Check points take no part.
    """
    sensors = tuple(view.sensor for view in views)
    groups = (*parameter_groups_of(views, options), *calibration_groups(views, options))
    control = GroundControl.none() if control is None else control
    numbers = np.arange(len(xyz))
    parameters, corrected = np.zeros(sum(map(len, groups))), sensors
    for last in (*[False] * (ROUNDS - 1), True):
        xyz = triangulate(corrected, observations, xyz).xyz
        problem = problem_of(sensors, groups, observations, xyz, options, control, terrain)
        solution = solve(problem, parameters, xyz)
        parameters, xyz = solution.parameters, solution.xyz[: len(xyz)]
        corrected = corrected_sensors(groups, sensors, parameters)
        if not last:
            observations = without_outliers(observations, triangulate(corrected, observations, xyz), options.inlier_px)
            kept = np.unique(observations.point)
            numbers = numbers[kept]
            observations, xyz = renumbered(observations, xyz)
    ground_points = triangulate(corrected, observations, xyz)
    before = triangulate(sensors, observations, ground_points.xyz)
    adjustment = Adjustment(
        np.zeros((len(views), 2)), solution.n_determined, observations, ground_points, before.residual, numbers
    )
    terrain_m = np.empty(0) if terrain is None else ground_points.xyz[:, 2] - terrain.at(ground_points.xyz[:, :2])[0]
    on_ground = control_points(corrected, control, solution)
    residual = control.observations.xy - project_points(corrected, control.observations, on_ground)
    return BundleAdjustment(corrected, groups, solution, adjustment, control, on_ground, residual, terrain_m)


def control_points(sensors: Sequence[SensorModel], control: GroundControl, solution: Solution) -> FloatArray:
    """Positions (k, 3) m of control and check points after the adjustment.

    A control point has the position that the adjustment gave it, to which its coordinates contributed. A check point
    lies where the rays of the corrected cameras meet.
    """
    xyz = triangulate(sensors, control.observations, control.xyz).xyz
    xyz[~control.is_check] = solution.xyz[len(solution.xyz) - int((~control.is_check).sum()) :]
    return xyz


def problem_of(
    sensors: tuple[SensorModel, ...],
    groups: tuple[ParameterGroup, ...],
    tie_observations: Observations,
    xyz: FloatArray,
    options: OrientationOptions,
    control: GroundControl,
    terrain: TerrainHeights | None,
) -> Problem:
    """The adjustment problem, with the ties followed by the control points."""
    known = control.only(~control.is_check)
    observations = Observations(
        np.concatenate([tie_observations.view, known.observations.view]),
        np.concatenate([tie_observations.point, known.observations.point + len(xyz)]),
        np.concatenate([tie_observations.xy, known.observations.xy]),
    )
    sigma = np.where(np.isfinite(known.sigma_m), known.sigma_m, options.bundle_adjustment.sigma_control_m)
    bundle_options = options.bundle_adjustment
    return Problem(
        sensors,
        groups,
        observations,
        len(xyz),
        known.xyz,
        1.0 / sigma**2,
        bundle_options.sigma_control_px,
        terrain,
        bundle_options.sigma_dem_m,
    )
