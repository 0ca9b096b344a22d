"""Write `transforms.json`, as nerfstudio and instant-ngp read it, and the tie points as `sparse_pc.ply`.

A pose leads from the camera's axes (right, up, backwards, those of OpenGL) to the local frame. Pixels: the centre of
the first one is (0.5, 0.5). Source: nerfstudio's documentation, "Data conventions".
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.io.importers.colmap import ORIGIN_PX
from zlocus.products.exported_images import FOLDER, ExportedView
from zlocus.products.exported_points import ExportedPoints
from zlocus.sensors.distortion import BrownDistortion, FisheyeDistortion
from zlocus.sensors.frame import FrameModel

TRANSFORMS, POINTS = "transforms.json", "sparse_pc.ply"
# From the axes of zlocus's cameras (right, down, forwards) to those of OpenGL.
OPENGL = np.diag([1.0, -1.0, -1.0])
PLY_POINT = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])


def can_be_said(sensor: FrameModel) -> bool:
    """Whether `transforms.json` has words for the lens and the skew of a frame camera.

    It has none for skew, and none for rational lenses: there, k4 is the next coefficient of the numerator.
    """
    lens = sensor.distortion
    if isinstance(lens, BrownDistortion) and (lens.k4 or lens.k5 or lens.k6):
        return False
    return sensor.skew == 0.0 and isinstance(lens, BrownDistortion | FisheyeDistortion | None)


def write_transforms(
    folder: Path, exported_views: Sequence[ExportedView], exported_points: ExportedPoints | None
) -> None:
    """Write the cameras of all images, each with its own interior orientation, and the points beside them."""
    frames = [frame_of(each) for each in exported_views]
    models = {frame["camera_model"] for frame in frames}
    # nerfstudio takes one model for all frames; an ideal lens is one whose coefficients are 0.
    if len(models) > 1 and "OPENCV_FISHEYE" not in models:
        for frame in frames:
            frame["camera_model"] = "OPENCV"
    document: dict[str, Any] = {"camera_model": frames[0]["camera_model"], "frames": frames}
    if exported_points is not None:
        document["ply_file_path"] = POINTS
        write_ply(folder / POINTS, exported_points)
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    (folder / TRANSFORMS).write_text(text, encoding="utf-8")


def frame_of(exported: ExportedView) -> dict[str, Any]:
    """The entry of an image."""
    sensor, (rows, cols) = exported.sensor, exported.shape
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = sensor.rotation.T @ OPENGL, sensor.centre
    column, row = (value + ORIGIN_PX for value in sensor.principal_point)
    lens = sensor.distortion
    model = "OPENCV_FISHEYE" if isinstance(lens, FisheyeDistortion) else "PINHOLE" if lens is None else "OPENCV"
    entry: dict[str, Any] = {
        "file_path": f"{FOLDER}/{exported.file}", "camera_model": model, "w": cols, "h": rows, "fl_x": sensor.focal,
        "fl_y": sensor.focal * sensor.aspect, "cx": column, "cy": row, "transform_matrix": pose.tolist(),
    }  # fmt: skip
    if isinstance(lens, BrownDistortion | FisheyeDistortion):
        coefficients = {each.name: getattr(lens, each.name) for each in fields(lens)}
        always = ("k1", "k2") if isinstance(lens, FisheyeDistortion) else ("k1", "k2", "p1", "p2")
        entry |= {name: value for name, value in coefficients.items() if value or name in always}
    return entry


def write_ply(path: Path, exported_points: ExportedPoints) -> None:
    """Write points with their colours as binary PLY."""
    records = np.empty(len(exported_points), PLY_POINT)
    records["xyz"], records["rgb"] = exported_points.xyz, exported_points.rgb
    names = [*(f"float {axis}" for axis in "xyz"), *(f"uchar {colour}" for colour in ("red", "green", "blue"))]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(records)}"]
    header += [*(f"property {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(header).encode("ascii") + records.tobytes())
