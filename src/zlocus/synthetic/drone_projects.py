"""The cameras of a rendered drone block as OpenDroneMap and COLMAP write theirs, beside its images.

OpenDroneMap: `opensfm/reconstruction.json` in a tangent frame, and `odm_georeferencing/coords.txt` with what it
subtracts from the coordinates of the map. COLMAP: `sparse/0` as text, in coordinates of the map less the same offset.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from zlocus.core.errors import ConfigError
from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.earth_frame import WGS84_EARTH, between, east_north_up
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.drone_block import (
    DroneBlockSpec,
    RenderedDroneBlock,
    drone_exposures,
    frame_model,
    photo_name,
    written_cameras,
)

IMAGES, SCENE = "images", "scene.yaml"
# (0.5, 0.5) is the centre of the first pixel in COLMAP.
FIRST_PIXEL = 0.5


def write_projects(spec: DroneBlockSpec, block: RenderedDroneBlock) -> None:
    """Move the images of a block to its folder `images`, and write the projects of both programs in place of its
    `scene.yaml`.

    Raises
    ------
    ConfigError
        The lens or the shutter is one that these programs do not have.
    """
    exposures = drone_exposures(spec)
    sensors = dict(zip(map(photo_name, exposures), written_cameras(spec, exposures), strict=True))
    first = frame_model(exposures[0])
    if not isinstance(first.distortion, BrownDistortion) or first.rolling_shutter is not None:
        raise ConfigError("Projects of drone blocks have lenses by Brown and no rolling shutter. Choose another block.")
    (block.folder / IMAGES).mkdir()
    for path in block.images.values():
        path.rename(block.folder / IMAGES / path.name)
    _write_opensfm(spec, sensors, block.folder)
    _write_colmap(spec, sensors, block.folder / "sparse" / "0")
    (block.folder / SCENE).unlink()


def offset_of(spec: DroneBlockSpec) -> tuple[float, float]:
    """What the programs subtract from easting and northing, m."""
    return float(np.floor(spec.east_m)), float(np.floor(spec.north_m))


def _lens(sensor: FrameModel) -> BrownDistortion:
    assert isinstance(sensor.distortion, BrownDistortion), "`write_projects` sees to it"
    return sensor.distortion


def _write_opensfm(spec: DroneBlockSpec, sensors: dict[str, FrameModel], folder: Path) -> None:
    x, y = offset_of(spec)
    zone = spec.crs.utm_zone or ""
    (folder / "odm_georeferencing").mkdir()
    text = f"WGS84 UTM {zone}\n{x:.0f} {y:.0f}\n"
    (folder / "odm_georeferencing" / "coords.txt").write_text(text, encoding="utf-8")
    lon, lat = between(spec.crs, WGS84_EARTH.crs).transform(x, y)
    origin = WGS84_EARTH.cartesian_from_ground(np.array([[lon, lat, spec.base_m]]))[0]
    tangent = east_north_up(*np.deg2rad([[lon], [lat]]))[0].T
    shots, side = {}, max(spec.columns, spec.rows)
    for name, sensor in sensors.items():
        centre, axes = WGS84_EARTH.pose(spec.crs, np.array(sensor.centre))
        rotation = sensor.rotation @ axes @ tangent.T
        shots[name] = {
            "camera": "drone", "rotation": _rotation_vector(rotation),
            "translation": (-rotation @ tangent @ (centre - origin)).tolist(),
        }  # fmt: skip
    any_sensor = next(iter(sensors.values()))
    lens, (column, row) = _lens(any_sensor), any_sensor.principal_point
    drone = {
        "projection_type": "brown", "width": spec.columns, "height": spec.rows, "focal_x": any_sensor.focal / side,
        "focal_y": any_sensor.focal / side, "c_x": (column - (spec.columns - 1) / 2) / side,
        "c_y": (row - (spec.rows - 1) / 2) / side, "k1": lens.k1, "k2": lens.k2, "p1": lens.p1, "p2": lens.p2,
        "k3": lens.k3,
    }  # fmt: skip
    place = {"latitude": lat, "longitude": lon, "altitude": spec.base_m}
    document = [{"cameras": {"drone": drone}, "shots": shots, "points": {}, "reference_lla": place}]
    (folder / "opensfm").mkdir()
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _write_colmap(spec: DroneBlockSpec, sensors: dict[str, FrameModel], folder: Path) -> None:
    folder.mkdir(parents=True)
    offset = np.array([*offset_of(spec), 0.0])
    any_sensor = next(iter(sensors.values()))
    lens, (column, row) = _lens(any_sensor), any_sensor.principal_point
    focal, centre = any_sensor.focal, (column + FIRST_PIXEL, row + FIRST_PIXEL)
    # FULL_OPENCV: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6.
    numbers = (focal, focal, *centre, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0)
    values = " ".join(repr(float(value)) for value in numbers)
    text = f"# Number of cameras: 1\n1 FULL_OPENCV {spec.columns} {spec.rows} {values}\n"
    (folder / "cameras.txt").write_text(text, encoding="utf-8")
    lines = [f"# Number of images: {len(sensors)}, mean observations per image: 0"]
    for number, (name, sensor) in enumerate(sensors.items(), 1):
        translation = -sensor.rotation @ (np.array(sensor.centre) - offset)
        pose = [*_quaternion(sensor.rotation), *translation]
        lines += [" ".join([str(number), *(repr(float(value)) for value in pose), "1", name]), ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "points3D.txt").write_text("# Number of points: 0\n", encoding="utf-8")


def _rotation_vector(rotation: FloatArray) -> list[float]:
    from scipy.spatial.transform import Rotation

    return [float(value) for value in Rotation.from_matrix(rotation).as_rotvec()]


def _quaternion(rotation: FloatArray) -> FloatArray:
    """The quaternion (4,) of a rotation, the scalar first."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]])
