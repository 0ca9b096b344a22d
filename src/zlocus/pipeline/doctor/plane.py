"""The plane on which most tie points of a local frame lie, such as a wall; z should be perpendicular to it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from zlocus.core.scene import Scene, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.scene_file import read_scene_file
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.tie_heights import supported
from zlocus.pipeline.doctor.findings import POOR, Finding
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.frame_axes import rotation_to_axes

TRIPLES, SEED, FEWEST_TIES = 500, 0, 50
ENOUGH_TIES = 2000  # that choose among the planes, about: up to twice as many
# A tie point lies on the plane within this share of the median distance of all ties from their centre; and the share of
# ties that must lie on it.
NEAR_SHARE, LEAST_ON_PLANE = 0.02, 0.3
# A finding is made where cells are tilted by more than this angle against the wall.
MOST_TILT_DEG = 15.0


def plane_findings(scene: Scene, inputs: Sequence[Path], orientation: Orientation) -> list[Finding]:
    """A finding where another direction of z would suit the scene better, given in the axes of the input file."""
    centres = [view.sensor.centre for view in scene.views if isinstance(view.sensor, FrameModel)]
    ties = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    if not is_local(scene.crs) or not centres or len(ties) < FEWEST_TIES:
        return []
    normal, share = main_plane(ties)
    normal *= np.sign(normal @ (np.mean(centres, axis=0) - ties.mean(axis=0)))
    tilt = float(np.rad2deg(np.arccos(np.clip(normal[2], -1.0, 1.0))))
    if share < LEAST_ON_PLANE or tilt < MOST_TILT_DEG:
        return []
    frame = read_scene_file(inputs[0]).frame
    if frame is not None and frame.up is not None:
        normal = rotation_to_axes(frame.up, frame.north).T @ normal
    up = ", ".join(f"{v:.3f}" for v in normal + 0.0)
    return [
        Finding(
            POOR,
            f"{100 * share:.0f} % of the tie points lie on a plane that is tilted by {tilt:.0f} degrees against the "
            f"frame's. If the surface of that plane is wanted, write frame: {{local: true, up: [{up}]}} in the scene "
            "file.",
        )
    ]


def main_plane(xyz: FloatArray) -> tuple[FloatArray, float]:
    """Unit normal (3,) of the plane on which most points (n, 3) lie, and the share of these points.

    The best of many planes through three points each, fitted to the points that lie on it.
    """
    triples = xyz[np.random.default_rng(SEED).integers(len(xyz), size=(TRIPLES, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, starts = normals[length > 0] / length[length > 0, None], triples[length > 0, 0]
    near = NEAR_SHARE * float(np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)))
    few = xyz[:: max(len(xyz) // ENOUGH_TIES, 1)]
    k = (np.abs(few @ normals.T - (starts * normals).sum(axis=1)) < near).sum(axis=0).argmax()
    best = xyz[np.abs((xyz - starts[k]) @ normals[k]) < near]
    normal = np.linalg.svd(best - best.mean(axis=0), full_matrices=False)[2][2]
    return normal, float((np.abs((xyz - best.mean(axis=0)) @ normal) < near).mean())
