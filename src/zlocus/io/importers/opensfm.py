"""Import `reconstruction.json` of OpenSfM and OpenDroneMap.

Axes: those of the camera are right, down, forwards, as in zlocus. The world is a tangent frame (east, north, up) at
`reference_lla`, so poses are converted to the map by way of geocentric axes. Pixels: coordinates are counted from the
centre of the image and divided by its larger side.
Source: OpenSfM's documentation, "Geometric models" and "Reporting".
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.requests import ImportRequest
from zlocus.core.sensor_model import FloatArray
from zlocus.io.importers.base import (
    ImportedCameras,
    ImportedExposure,
    find_camera_file,
    image_size,
    read_number,
    read_numbers,
    rotation_matrix,
)
from zlocus.io.importers.earth import map_poses, scene_file_crs
from zlocus.io.safe_documents import read_json
from zlocus.io.safe_text import EXPORT_AGAIN
from zlocus.sensors.earth_frame import WGS84, WGS84_EARTH, east_north_up

FILES = ("reconstruction.json", "opensfm/reconstruction.json", "opensfm_reconstruction.json")
# Projection, kind of distortion, and its coefficients in zlocus's names.
LENSES = {
    "perspective": ("brown", ("k1", "k2")),
    "radial": ("brown", ("k1", "k2")),
    "simple_radial": ("brown", ("k1",)),
    "brown": ("brown", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}
MAX_ROTATION_RAD = 1e3  # radians, of an axis of rotation


def read_opensfm(request: ImportRequest) -> ImportedCameras:
    """The shots of a reconstruction, in a map, or with `--local` in the tangent frame.

    Raises
    ------
    InputError
        The file is missing or damaged, has several parts, another projection, or no place on the Earth.
    """
    path = find_camera_file(request.source, FILES, "OpenSfM reconstruction")
    document = _only_part(read_json(path), path)
    cameras = {
        name: _camera(entry, path, f"camera {quoted(name)}")
        for name, entry in _table(document, "cameras", path).items()
    }
    exposures = [_exposure(name, entry, cameras, path) for name, entry in _table(document, "shots", path).items()]
    if request.local:
        return ImportedCameras(path, tuple(exposures))
    reference = document.get("reference_lla")
    if not isinstance(reference, dict):
        raise InputError(f"{path} has no reference_lla, so its place on the Earth is not known. Give --local.")
    lla = [read_number(reference.get(k), path, f"reference_lla.{k}") for k in ("longitude", "latitude", "altitude")]
    if not (abs(lla[0]) <= 360 and abs(lla[1]) <= 90 and abs(lla[2]) < 1e5):
        raise InputError(
            f"{path}: reference_lla is no place on the Earth: {', '.join(f'{v:g}' for v in lla)}. {EXPORT_AGAIN}"
        )
    origin, axes = _tangent(np.array(lla))
    poses = map_poses(WGS84, request.crs, origin)
    placed = []
    for shot in exposures:
        centre, rotation = poses.pose(origin + shot.centre @ axes, shot.rotation @ axes, path, shot.image)
        placed.append(ImportedExposure(shot.image, shot.interior, centre, rotation, shot.size))
    return ImportedCameras(path, tuple(placed), scene_file_crs(poses.target))


def _tangent(lla: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Geocentric origin (3,) and axes (3, 3), as rows, of a tangent frame.

    lla : (3,) longitude and latitude (degrees) and height (m) of its origin.
    """
    origin = WGS84_EARTH.cartesian_from_ground(lla[None])[0]
    return origin, east_north_up(*np.deg2rad(lla[:2, None]))[0].T


def _only_part(document: Any, path: Path) -> dict[str, Any]:
    parts = document if isinstance(document, list) else [document]
    if not parts or not all(isinstance(part, dict) for part in parts):
        raise InputError(f"{path} is not an OpenSfM reconstruction: it must hold cameras and shots. {EXPORT_AGAIN}")
    if len(parts) > 1:
        raise InputError(
            f"{path} holds {len(parts)} parts that are not joined, each with a frame of its own. Keep one of them."
        )
    return dict(parts[0])


def _table(document: dict[str, Any], key: str, path: Path) -> dict[str, Any]:
    table = document.get(key)
    if not isinstance(table, dict) or not all(isinstance(entry, dict) for entry in table.values()):
        raise InputError(f"{path} has no table of {key}. {EXPORT_AGAIN}")
    return table


def _camera(entry: dict[str, Any], path: Path, where: str) -> tuple[dict[str, Any], tuple[int, int]]:
    projection = entry.get("projection_type", "perspective")
    if not isinstance(projection, str) or projection not in LENSES:
        raise InputError(
            f"{path}: {where} has the projection {quoted(projection)}, which is not read. Use one of "
            f"{', '.join(LENSES)}, or undistort the images in OpenSfM."
        )
    pixels = image_size(entry.get("width"), entry.get("height"), path, where)
    side = max(pixels)
    both = entry.get("focal")
    focal = [read_number(entry.get(key, both), path, f"{key} of {where}") * side for key in ("focal_x", "focal_y")]
    point = [
        read_number(entry.get(key, 0.0), path, f"{key} of {where}") * side + (n - 1) / 2
        for key, n in zip(("c_x", "c_y"), pixels, strict=True)
    ]
    kind, names = LENSES[projection]
    lens = {name: read_number(entry.get(name, 0.0), path, f"{name} of {where}") for name in names}
    interior = {"focal": focal, "principal_point": point, "distortion": {"kind": kind, **lens}}
    return interior, pixels


def _exposure(
    name: str, entry: dict[str, Any], cameras: dict[str, tuple[dict[str, Any], tuple[int, int]]], path: Path
) -> ImportedExposure:
    where = f"shot {quoted(name)}"
    camera = entry.get("camera")
    if not isinstance(camera, str) or camera not in cameras:
        raise InputError(
            f"{path}: {where} has the camera {quoted(camera)}, which the file does not hold. {EXPORT_AGAIN}"
        )
    axis = read_numbers(entry.get("rotation"), 3, path, f"rotation of {where}")
    # SciPy's rotations cost 0.2 s to import, and other importers do without them.
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_rotvec(np.clip(axis, -MAX_ROTATION_RAD, MAX_ROTATION_RAD)).as_matrix()
    rotation = rotation_matrix(turned, path, where)
    translation = read_numbers(entry.get("translation"), 3, path, f"translation of {where}")
    interior, pixels = cameras[camera]
    return ImportedExposure(name, interior, -rotation.T @ translation, rotation, pixels)
