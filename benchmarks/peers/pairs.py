"""Rectified pairs for matchers, and surfaces from their disparities: `python pairs.py prepare|merge JOB`.

A matcher searches along the rows of two images; it has no cameras and cannot merge pairs. Both are done for it: pairs
are resampled onto a plane (see `rectifying.py`), the points of each pair that both images show are put on the grid (the
highest in a cell), a cell takes the median of all pairs, and a gap the nearest height. The cost counts as that of the
matcher.
"""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from rectifying import (
    Rectified,
    cameras_above,
    disparity_range,
    gridded,
    ground_points,
    on_plane,
    parallax,
    rectified,
    shown,
    write_surface,
)
from zlocus.core.scene import View
from zlocus.io.scene_file import open_scene


@dataclass(frozen=True)
class Plane:
    """A pair on its plane. moved : parallax in metres per metre of height; middle : height of the plane, m."""

    views: tuple[View, View]
    shifts: tuple[np.ndarray, np.ndarray]
    frame: Rectified
    moved: np.ndarray
    middle: float


@dataclass(frozen=True)
class Area:
    """Area of the surface. bounds : west, south, east, north, m."""

    crs: str
    bounds: tuple[float, float, float, float]


def planes(job: dict[str, Any]) -> list[Plane]:
    """The plane of each pair of a job."""
    area, middle = area_of(job), sum(job["heights"]) / 2
    opened = open_scene([Path(path) for path in job["inputs"]])
    views = dict(zip(job["images"], opened.views, strict=True))
    found = []
    for pair in job["pairs"]:
        seen = tuple(views[name] for name in pair["views"])
        shifts = tuple(np.array(job["shifts"][name]) for name in pair["views"])
        moved = parallax(area, seen, shifts, middle)
        found.append(Plane(seen, shifts, rectified(area, moved), moved, middle))  # type: ignore[arg-type]
    return found


def area_of(job: dict[str, Any]) -> Area:
    return Area(job["crs"], tuple(job["bounds"]))


def prepare(path: Path) -> None:
    """Write both rectified images of each pair and its range of disparities."""
    job = json.loads(path.read_text())
    for pair, plane in zip(job["pairs"], planes(job), strict=True):
        for side, view, shift in zip(("left", "right"), plane.views, plane.shifts, strict=True):
            cv2.imwrite(pair[side], on_plane(view, shift, plane.frame, plane.middle).astype(np.float32))
        low, high = job["heights"]
        # The parallax of frames grows faster above the plane than below.
        curved = ((high - low) / 2) ** 2 / cameras_above(plane.views, plane.middle)
        pair["first"], pair["count"] = disparity_range((low, high), plane.moved, curved)
    path.write_text(json.dumps(job, indent=1))


def merge(path: Path) -> None:
    """Write the surface: the median over all pairs."""
    job = json.loads(path.read_text())
    surfaces = []
    for pair, plane in zip(job["pairs"], planes(job), strict=True):
        is_shown = shown(plane.views, plane.shifts, plane.frame, plane.middle)
        disparity = np.where(is_shown, np.load(pair["disparity"]), np.nan)
        xyz = ground_points(
            disparity, plane.views[0], plane.shifts[0], plane.frame, plane.moved, plane.middle,
            cameras_above(plane.views, plane.middle),
        )  # fmt: skip
        surfaces.append(gridded(area_of(job), xyz))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # cells that no pair sees
        surface = np.nanmedian(np.stack(surfaces), axis=0)
    write_surface(area_of(job), surface, Path(job["surface"]))


if __name__ == "__main__":
    {"prepare": prepare, "merge": merge}[sys.argv[1]](Path(sys.argv[2]))
