"""orientation.json: results of the orientation per image, sensor and control point (see docs/how-to/orient.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zlocus.core.scene import Scene
from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.parameter_groups import ParameterGroup
from zlocus.orientation.tie_residuals import Residuals

if TYPE_CHECKING:
    from zlocus.orientation.bundle_adjustment import BundleAdjustment

DIGITS, DIGITS_OF_COEFFICIENTS = 6, 9


def orientation_record(orientation: Orientation, scene: Scene) -> dict[str, Any]:
    """The results as JSON holds them."""
    record = {"crs": scene.crs.to_string(), **orientation.as_dict()}
    if orientation.bundle_adjustment is None:
        return record
    bundle_adjustment, names = orientation.bundle_adjustment, [view.name for view in scene.views]
    solution = bundle_adjustment.solution
    record |= {
        "sigma0_px": rounded(solution.sigma0_px),
        "redundancy": solution.redundancy,
        "n_parameters": len(solution.parameters),
        "n_parameters_determined": solution.n_determined,
        "n_steps": solution.n_steps,
        "sensors": sensors_record(orientation, bundle_adjustment),
        "corrections": corrections_record(bundle_adjustment, names),
    }
    if len(bundle_adjustment.control):
        record["control"] = control_record(bundle_adjustment)
    if len(bundle_adjustment.terrain_m):
        record["terrain"] = terrain_record(bundle_adjustment.terrain_m)
    return record


def sensors_record(orientation: Orientation, bundle_adjustment: BundleAdjustment) -> dict[str, Any]:
    """Residuals of the images of each kind of sensor."""
    adjustment, record = bundle_adjustment.adjustment, {}
    kinds = np.array([view.sensor for view in orientation.views])
    for kind in np.unique(kinds):
        mine = kinds[adjustment.observations.view] == kind
        record[str(kind)] = {
            "n_views": int((kinds == kind).sum()),
            "n_ties": int(mine.sum()),
            "residual_before_px": Residuals.of(adjustment.before_px[mine]).as_dict(),
            "residual_after_px": Residuals.of(adjustment.after_px[mine]).as_dict(),
        }
    return record


def corrections_record(bundle_adjustment: BundleAdjustment, names: list[str]) -> list[dict[str, Any]]:
    """Correction of each parameter group, with its standard deviations after and before the adjustment."""
    record: list[dict[str, Any]] = []
    first, undetermined = 0, bundle_adjustment.solution.held_parameters
    for group in bundle_adjustment.groups:
        part = slice(first, first + len(group))
        first += len(group)
        held = bundle_adjustment.solution.is_held[part]
        values = (
            bundle_adjustment.solution.parameters[part] * group.sigma,
            np.where(held, np.nan, bundle_adjustment.solution.parameter_sigma[part]) * group.sigma,
            group.sigma,
        )
        added, after, before = (described(group, value) for value in values)
        record.append(
            {
                "kind": group.kind,
                "views": [names[i] for i in group.views],
                "added": added,
                "sigma_after": after,
                "sigma_before": before,
            }
        )
        reasons = {each.name: each.sentence(names) for each in undetermined if each.group is group}
        if reasons:
            record[-1]["held_because"] = reasons
    return record


def described(group: ParameterGroup, values: FloatArray) -> dict[str, float | None]:
    """Values (k,) of a parameter group by name, rounded."""
    digits = DIGITS_OF_COEFFICIENTS if group.is_calibration else DIGITS
    return {name: rounded(value, digits) for name, value in group.described(values).items()}


def control_record(bundle_adjustment: BundleAdjustment) -> dict[str, Any]:
    """Errors of control and check points: adjusted position less known position."""
    control, error = bundle_adjustment.control, bundle_adjustment.control_points - bundle_adjustment.control.xyz
    points = {}
    for i, name in enumerate(control.names):
        mine = control.observations.point == i
        points[name] = {
            "role": "check" if control.is_check[i] else "control",
            "n_images": int(mine.sum()),
            "error_m": [rounded(v) for v in error[i]],
            "residual_px": Residuals.of(bundle_adjustment.control_residual[mine]).as_dict()["rms"],
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
    """Statistics of the ties' heights less those of the terrain."""
    known = off_m[np.isfinite(off_m)]
    if not len(known):
        return {"n": 0}
    median = float(np.median(known))
    nmad = 1.4826 * float(np.median(np.abs(known - median)))
    return {"n": len(known), "median_m": rounded(median), "nmad_m": rounded(nmad)}


def rounded(value: float, digits: int = DIGITS) -> float | None:
    """A number for JSON; None in place of NaN and infinity."""
    return round(float(value), digits) if np.isfinite(value) else None
