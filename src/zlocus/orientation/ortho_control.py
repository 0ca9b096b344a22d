"""Control points from the places of an ortho-image that images show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from zlocus.core.footprints import ground_sample_distance
from zlocus.core.scene import View
from zlocus.orientation.control import GroundControl
from zlocus.orientation.ground_match import GroundMatches
from zlocus.orientation.triangulate import Observations

# An ortho-image is not better than this part of its cells, however well images agree with it.
MIN_SIGMA_CELLS = 0.1
# Every so many nodes of the lattice along a row, shifted from row to row, is a check point where two images show it.
CHECK_STEP, CHECK_SHIFT = 5, 2
COORDINATE_SIGMAS = 1.1774  # median length of two coordinates, in standard deviations of one


def control_of_matches(views: Sequence[View], matches: Mapping[int, GroundMatches], sigma_z_m: float) -> GroundControl:
    """Control and check points from the matches of the views with these numbers.

    A point of the lattice that several images show is one control point. Its standard deviation in plan follows from
    how well the places of an image agree; sigma_z_m : m, that of the heights.
    """
    if not matches:
        return GroundControl.none()
    lattice = np.concatenate([each.lattice for each in matches.values()])
    nodes, point = np.unique(lattice, axis=0, return_inverse=True)
    point = point.ravel().astype(np.int64)
    view = np.concatenate([np.full(len(each), number, np.int64) for number, each in matches.items()])
    n_seen = np.bincount(point, minlength=len(nodes))
    all_xyz = np.concatenate([each.xyz for each in matches.values()])
    xyz = np.column_stack([np.bincount(point, column, len(nodes)) / n_seen for column in all_xyz.T])
    of_view = np.concatenate(
        [np.full(len(each), plan_sigma_m(views[number], each)) for number, each in matches.items()]
    )
    sigma_plan = np.sqrt(np.bincount(point, of_view**2, len(nodes)) / n_seen)
    sigma = np.column_stack([sigma_plan, sigma_plan, np.full(len(nodes), sigma_z_m)])
    is_check = ((nodes[:, 0] + CHECK_SHIFT * nodes[:, 1]) % CHECK_STEP == 0) & (n_seen > 1)
    names = tuple(f"ortho_{east}_{north}" for east, north in nodes.tolist())
    xy = np.concatenate([each.xy for each in matches.values()])
    return GroundControl(names, xyz, sigma, is_check, Observations(view, point, xy))


def plan_sigma_m(view: View, matches: GroundMatches) -> float:
    """Standard deviation (m) of the points of an image in plan, along each axis, from how well they agree."""
    pixel_m = ground_sample_distance(view, float(np.median(matches.xyz[:, 2])))
    length = np.hypot(*matches.residual_px.T)
    return max(float(np.median(length)) / COORDINATE_SIGMAS * pixel_m, MIN_SIGMA_CELLS * matches.cell_m)


def joined(control: GroundControl, other_control: GroundControl) -> GroundControl:
    """The points of both."""
    observations = Observations(
        np.concatenate([control.observations.view, other_control.observations.view]),
        np.concatenate([control.observations.point, other_control.observations.point + len(control)]),
        np.concatenate([control.observations.xy, other_control.observations.xy]),
    )
    return GroundControl(
        (*control.names, *other_control.names),
        np.concatenate([control.xyz, other_control.xyz]),
        np.concatenate([control.sigma_m, other_control.sigma_m]),
        np.concatenate([control.is_check, other_control.is_check]),
        observations,
    )
