"""Joint orientation: the cameras of all images and the ground points of all ties at once (method section 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zlocus.core.options import OrientationOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.normal_equations import Problem, Solution, solve
from zlocus.orientation.parameter_groups import Block, blocks_of, corrected_sensors
from zlocus.orientation.shift_adjustment import Adjustment, consistent, renumbered
from zlocus.orientation.triangulate import Observations, project_points, triangulate

ROUNDS = 3


@dataclass(frozen=True, eq=False)
class JointAdjustment:
    """The corrected cameras and what they rest on.

    sensors : corrected; adjusted : the ties kept, see `Adjustment`, with shifts of 0; control : the points given;
    control_points : (k, 3) m where their image points put them, check points by them alone, NaN where one image sees a
    check point; control_residual : (j, 2) px of `control.seen`; terrain_m : (n,) m, heights of the ties less those of
    the terrain.
    """

    sensors: tuple[SensorModel, ...]
    blocks: tuple[Block, ...]
    solution: Solution
    adjusted: Adjustment
    control: GroundControl
    control_points: FloatArray
    control_residual: FloatArray
    terrain_m: FloatArray


def adjust_jointly(
    views: Sequence[View],
    seen: Observations,
    xyz: FloatArray,
    options: OrientationOptions,
    control: GroundControl | None = None,
    terrain: TerrainHeights | None = None,
) -> JointAdjustment:
    """Cameras that make the rays of all ties meet, where their priors and the control leave them.

    xyz : (n, 3) m, first ground points of the ties. Observations further than 4 sigma (and at least `inlier_px`) from
    where the rest of their tie puts them are dropped, then everything is solved again, twice. Check points take no
    part.
    """
    sensors, blocks = tuple(view.sensor for view in views), blocks_of(views, options)
    control = GroundControl.none() if control is None else control
    numbers = np.arange(len(xyz))
    parameters, corrected = np.zeros(sum(map(len, blocks))), sensors
    for last in (*[False] * (ROUNDS - 1), True):
        xyz = triangulate(corrected, seen, xyz).xyz
        problem = problem_of(sensors, blocks, seen, xyz, options, control, terrain)
        solution = solve(problem, parameters, xyz)
        parameters, xyz = solution.parameters, solution.xyz[: len(xyz)]
        corrected = corrected_sensors(blocks, sensors, parameters)
        if not last:
            seen = consistent(seen, triangulate(corrected, seen, xyz), options.inlier_px)
            kept = np.unique(seen.point)
            numbers = numbers[kept]
            seen, xyz = renumbered(seen, xyz)
    points = triangulate(corrected, seen, xyz)
    before = triangulate(sensors, seen, points.xyz)
    adjusted = Adjustment(np.zeros((len(views), 2)), solution.n_seen, seen, points, before.residual, numbers)
    terrain_m = np.empty(0) if terrain is None else points.xyz[:, 2] - terrain.at(points.xyz[:, :2])[0]
    on_ground = control_points(corrected, control, solution)
    residual = control.seen.xy - project_points(corrected, control.seen, on_ground)
    return JointAdjustment(corrected, blocks, solution, adjusted, control, on_ground, residual, terrain_m)


def control_points(sensors: Sequence[SensorModel], control: GroundControl, solution: Solution) -> FloatArray:
    """Where control and check points lie, (k, 3) m: a control point where the adjustment put it, which its coordinates
    had a say in; a check point where the rays of the corrected cameras meet."""
    xyz = triangulate(sensors, control.seen, control.xyz).xyz
    xyz[~control.is_check] = solution.xyz[len(solution.xyz) - int((~control.is_check).sum()) :]
    return xyz


def problem_of(
    sensors: tuple[SensorModel, ...],
    blocks: tuple[Block, ...],
    ties: Observations,
    xyz: FloatArray,
    options: OrientationOptions,
    control: GroundControl,
    terrain: TerrainHeights | None,
) -> Problem:
    """Ties and control points in one list."""
    known = control.only(~control.is_check)
    seen = Observations(
        np.concatenate([ties.view, known.seen.view]),
        np.concatenate([ties.point, known.seen.point + len(xyz)]),
        np.concatenate([ties.xy, known.seen.xy]),
    )
    sigma = np.where(np.isfinite(known.sigma_m), known.sigma_m, options.joint.sigma_control_m)
    joint = options.joint
    return Problem(
        sensors, blocks, seen, len(xyz), known.xyz, 1.0 / sigma**2, joint.sigma_control_px, terrain, joint.sigma_dem_m
    )
