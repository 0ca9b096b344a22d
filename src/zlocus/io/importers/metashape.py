"""Import Metashape's `cameras.xml` (File > Export > Export Cameras, Agisoft XML).

Axes: those of the camera are right, down, forwards, as in zlocus. The transform of a chunk goes to geocentric axes if
the chunk has a CRS of the Earth, else to local axes. Pixels: (0, 0) is the outer corner of the first pixel, so half a
pixel is subtracted. Distortion: p1 and p2 are OpenCV's p2 and p1.
Source: Agisoft Metashape User Manual, appendix "Camera models".
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.requests import ImportRequest
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import is_in_metres, is_on_earth
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
from zlocus.io.safe_documents import read_xml
from zlocus.io.safe_text import EXPORT_AGAIN

FILES = ("cameras.xml", "metashape.xml", "agisoft.xml")
LENSES = {
    "frame": ("brown", {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p2", "p2": "p1"}),
    "fisheye": ("fisheye", {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4"}),
    "equidistant_fisheye": ("fisheye", {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4"}),
}
INTERIOR = ("f", "cx", "cy", "b1", "b2")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


@dataclass(frozen=True)
class _Similarity:
    """Transform from chunk to world: scale * rotation @ point + translation."""

    rotation: FloatArray
    translation: FloatArray
    scale: float


def read_metashape(request: ImportRequest) -> ImportedCameras:
    """The aligned cameras of the first chunk, in a map, or in local axes where the chunk has no CRS.

    Raises
    ------
    InputError
        The file is missing or damaged, a calibration is not supported, or the position of the chunk is not known.
    """
    path = find_camera_file(request.source, FILES, "Metashape export of cameras")
    root = read_xml(path)
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise InputError(f"{path} is not an export of cameras: it has no chunk. Use Export Cameras, Agisoft XML.")
    sensors = {entry.get("id"): entry for entry in chunk.iterfind("sensors/sensor")}
    if any(entry.get("master_id") is not None for entry in sensors.values()):
        raise InputError(f"{path} has a rig of several sensors, which is not read. Export the cameras of one of them.")
    exposures = []
    for entry in chunk.iterfind("cameras//camera"):
        if entry.find("transform") is not None and entry.get("enabled") not in ("0", "false"):
            exposures.append(_exposure(entry, sensors, chunk, path))
    return _placed(exposures, chunk, request, path)


def _placed(exposures: list[ImportedExposure], chunk: Element, request: ImportRequest, path: Path) -> ImportedCameras:
    """The cameras in the map of the chunk, or in local axes."""
    crs = _chunk_crs(chunk, path)
    if crs is None or not exposures:
        if request.crs is not None:
            raise InputError(f"{path} has local coordinates, which --crs cannot place on the Earth. Leave --crs out.")
        return ImportedCameras(path, tuple(exposures))
    geographic = crs.geodetic_crs
    assert geographic is not None, "_chunk_crs sees to it"
    own = request.crs or (scene_file_crs(crs) if crs.is_projected and is_in_metres(crs) else None)
    poses = map_poses(geographic, own, exposures[0].centre)
    placed = []
    for shot in exposures:
        centre, rotation = poses.pose(shot.centre, shot.rotation, path, shot.image)
        placed.append(ImportedExposure(shot.image, shot.interior, centre, rotation, shot.size))
    return ImportedCameras(path, tuple(placed), scene_file_crs(poses.target))


def _chunk_crs(chunk: Element, path: Path) -> CRS | None:
    """The CRS of the chunk; None for local coordinates."""
    text = (chunk.findtext("reference") or "").strip()
    if not text or text.upper().startswith("LOCAL_CS"):
        return None
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise InputError(f"{path} has the reference {quoted(text)}, which is no CRS. {EXPORT_AGAIN}") from error
    if crs.is_engineering:
        return None
    geographic = crs.to_2d().geodetic_crs
    if geographic is None or not is_on_earth(geographic):
        raise InputError(f"{path} has the reference {crs.name}, whose place on the Earth is not known. {EXPORT_AGAIN}")
    return crs.to_2d()


def _exposure(entry: Element, sensors: dict[str | None, Element], chunk: Element, path: Path) -> ImportedExposure:
    label = entry.get("label") or ""
    where = f"camera {quoted(label)}"
    sensor = sensors.get(entry.get("sensor_id"))
    if sensor is None:
        raise InputError(f"{path}: {where} has a sensor that the file does not hold. {EXPORT_AGAIN}")
    pose = read_numbers(entry.findtext("transform") or "", 16, path, f"transform of {where}").reshape(4, 4)
    world = _similarity(entry, chunk, path)
    rotation = world.rotation @ rotation_matrix(pose[:3, :3], path, where)
    centre = world.scale * world.rotation @ pose[:3, 3] + world.translation
    interior, pixels = _interior(sensor, path, f"the sensor of {where}")
    return ImportedExposure(label, interior, centre, rotation.T, pixels)


def _similarity(entry: Element, chunk: Element, path: Path) -> _Similarity:
    """The transform of the camera's component, in older files that of the chunk; the identity where there is none."""
    component = entry.get("component_id")
    transform = next(
        (c.find("transform") for c in chunk.iterfind("components/component") if c.get("id") == component), None
    )
    transform = chunk.find("transform") if transform is None else transform
    if transform is None:
        if _chunk_crs(chunk, path) is not None:
            raise InputError(f"{path} has no transform of the chunk, so its place is not known. {EXPORT_AGAIN}")
        return _Similarity(np.eye(3), np.zeros(3), 1.0)
    parts = {key: (transform.findtext(key) or "").strip() for key in ("rotation", "translation", "scale")}
    scale = read_number(parts["scale"] or "1", path, "the scale of the chunk")
    if not scale > 0:
        raise InputError(f"{path}: the scale of the chunk is {scale:g}, and must be above 0. {EXPORT_AGAIN}")
    rotation = read_numbers(parts["rotation"], 9, path, "the rotation of the chunk")
    translation = read_numbers(parts["translation"], 3, path, "the translation of the chunk")
    return _Similarity(rotation_matrix(rotation, path, "the chunk"), translation, scale)


def _interior(sensor: Element, path: Path, where: str) -> tuple[dict[str, Any], tuple[int, int]]:
    """Interior orientation and size from the adjusted calibration, else from the initial one."""
    calibrations = {entry.get("class", "adjusted"): entry for entry in sensor.iterfind("calibration")}
    entry = calibrations.get("adjusted", calibrations.get("initial"))
    if entry is None or entry.find("f") is None:
        raise InputError(
            f"{path}: {where} has no calibration with an f. Export the cameras with Metashape 1.4 or newer."
        )
    kind = entry.get("type", sensor.get("type", "frame"))
    if kind not in LENSES:
        raise InputError(
            f"{path}: {where} is of the type {quoted(kind)}, which is not read. Undistort the photos, or use one of "
            f"{', '.join(LENSES)}."
        )
    resolution = entry.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    attributes = {} if resolution is None else resolution.attrib
    pixels = image_size(attributes.get("width"), attributes.get("height"), path, where)
    value = {
        key: read_number((entry.findtext(key) or "0").strip(), path, f"{key} of {where}")
        for key in INTERIOR + COEFFICIENTS
    }
    distortion, names = LENSES[kind]
    unknown = [key for key in COEFFICIENTS if value[key] and key not in names]
    if unknown:
        raise InputError(
            f"{path}: {where} has {', '.join(unknown)}, which is not read for the type {kind}. Fix it at 0 in Tools > "
            "Camera Calibration, and optimise the cameras again."
        )
    lens = {name: value[key] for key, name in names.items()}
    interior: dict[str, Any] = {
        "focal": [value["f"] + value["b1"], value["f"]],
        "principal_point": [(pixels[0] - 1) / 2 + value["cx"], (pixels[1] - 1) / 2 + value["cy"]],
        "distortion": {"kind": distortion, **lens},
    }
    return interior | ({"skew": value["b2"]} if value["b2"] else {}), pixels
