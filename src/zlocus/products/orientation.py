"""orientation.json: what the orientation found, per image, sensor and control point (see docs/how-to/orient.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from zlocus.core.scene import Scene
from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.bundle_adjustment import JointAdjustment
from zlocus.orientation.orientation import Orientation, Residuals
from zlocus.orientation.parameter_groups import Block

DIGITS = 6


def orientation_record(found: Orientation, scene: Scene) -> dict[str, Any]:
    """The report as JSON can hold it."""
    record = {"crs": scene.crs.to_string(), **found.as_dict()}
    if found.joint is None:
        return record
    joint, names = found.joint, [view.name for view in scene.views]
    solution = joint.solution
    record |= {
        "sigma0_px": rounded(solution.sigma0_px),
        "redundancy": solution.redundancy,
        "n_parameters": len(solution.parameters),
        "n_parameters_seen": solution.n_seen,
        "n_steps": solution.n_steps,
        "sensors": sensors_record(found, joint),
        "corrections": corrections_record(joint, names),
    }
    if len(joint.control):
        record["control"] = control_record(joint)
    if len(joint.terrain_m):
        record["terrain"] = terrain_record(joint.terrain_m)
    return record


def sensors_record(found: Orientation, joint: JointAdjustment) -> dict[str, Any]:
    """Residuals of all images of a kind of sensor."""
    adjusted, record = joint.adjusted, {}
    kinds = np.array([view.sensor for view in found.views])
    for kind in np.unique(kinds):
        mine = kinds[adjusted.seen.view] == kind
        record[str(kind)] = {
            "n_views": int((kinds == kind).sum()),
            "n_ties": int(mine.sum()),
            "residual_before_px": Residuals.of(adjusted.before_px[mine]).as_dict(),
            "residual_after_px": Residuals.of(adjusted.after_px[mine]).as_dict(),
        }
    return record


def corrections_record(joint: JointAdjustment, names: list[str]) -> list[dict[str, Any]]:
    """What was added to the parameters of each block, with standard deviations after and before."""
    record, first = [], 0
    for block in joint.blocks:
        part = slice(first, first + len(block))
        first += len(block)
        held = joint.solution.is_held[part]
        values = (
            joint.solution.parameters[part] * block.sigma,
            np.where(held, np.nan, joint.solution.parameter_sigma[part]) * block.sigma,
            block.sigma,
        )
        added, after, before = (described(block, value) for value in values)
        record.append(
            {
                "kind": block.kind,
                "views": [names[i] for i in block.views],
                "added": added,
                "sigma_after": after,
                "sigma_before": before,
            }
        )
    return record


def described(block: Block, values: FloatArray) -> dict[str, float | None]:
    """Values (k,) of a block by name, rounded."""
    return {name: rounded(value) for name, value in block.described(values).items()}


def control_record(joint: JointAdjustment) -> dict[str, Any]:
    """Errors of control and check points: where the adjustment put them less where they are known to be."""
    control, error = joint.control, joint.control_points - joint.control.xyz
    points = {}
    for i, name in enumerate(control.names):
        mine = control.seen.point == i
        points[name] = {
            "role": "check" if control.is_check[i] else "control",
            "n_images": int(mine.sum()),
            "error_m": [rounded(v) for v in error[i]],
            "residual_px": Residuals.of(joint.control_residual[mine]).as_dict()["rms"],
        }
    summary = {}
    for role, wanted in (("control", ~control.is_check), ("check", control.is_check)):
        known = error[wanted & np.isfinite(error).all(axis=1)]
        if len(known):
            summary[role] = {
                "n": len(known),
                "mean_m": [rounded(v) for v in known.mean(axis=0)],
                "rms_m": [rounded(v) for v in np.sqrt((known**2).mean(axis=0))],
            }
    return summary | {"points": points}


def terrain_record(off_m: FloatArray) -> dict[str, Any]:
    """Heights of the ties less those of the terrain."""
    known = off_m[np.isfinite(off_m)]
    if not len(known):
        return {"n": 0}
    median = float(np.median(known))
    nmad = 1.4826 * float(np.median(np.abs(known - median)))
    return {"n": len(known), "median_m": rounded(median), "nmad_m": rounded(nmad)}


def rounded(value: float) -> float | None:
    """A number for JSON."""
    return round(float(value), DIGITS) if np.isfinite(value) else None
