"""Corrected cameras: RPC files, trajectories, and a `scene.yaml` that names them and the images."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import ConfigError, ZlocusWarning
from zlocus.core.scene import Scene, View, is_local
from zlocus.core.sensor_model import SensorModel
from zlocus.io.archives import absolute_path, is_archived
from zlocus.io.cameras.camera_entry import CameraEntry
from zlocus.io.cameras.camera_kinds import RpcCamera
from zlocus.io.cameras.frame_camera import FrameCamera, distortion_entry, rolling_shutter_entry
from zlocus.io.cameras.linescan import LineScanCamera
from zlocus.io.cameras.linescan_files import write_trajectory
from zlocus.io.cameras.location_grid import LocationGridCamera
from zlocus.io.cameras.rpc_text import write_rpc_txt
from zlocus.io.colour_entry import ColourEntry
from zlocus.io.images import RasterImage
from zlocus.io.masks.mask_entry import MaskEntry
from zlocus.io.resolved_entry import entries_of
from zlocus.io.scene_file import SCENE_SUFFIXES, SceneFile, ViewEntry, read_scene_file, write_scene_file
from zlocus.products.point_cloud import file_names
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.earth_frame import EarthSpace
from zlocus.sensors.frame import FrameModel, as_row, as_rows
from zlocus.sensors.linescan import LineScanModel, RectifiedModel
from zlocus.sensors.location_grid import LocationGridModel
from zlocus.sensors.rpc import RpcCoefficients, RpcModel
from zlocus.sensors.rpc_fit import fit_rpc

FOLDER = "cameras"
SCENE = "scene.yaml"


@dataclass(frozen=True)
class WrittenCamera:
    """A camera that was written.

    entry : for the scene file; fit_px : largest error of an RPC that was fitted, None where the camera is exact.
    """

    entry: CameraEntry
    fit_px: float | None = None


def write_cameras(out: Path, inputs: Sequence[Path], scene: Scene) -> dict[str, Any]:
    """Write the cameras of a corrected scene and a `scene.yaml` to a folder; return the entry of each view by name.

    inputs : of the scene. Cameras of a scene file keep all that was not corrected, and its views their masks.

    Raises
    ------
    OutputError
        The folder cannot be written.
    ConfigError
        The image of a line scanner was shifted, which its files cannot express.
    """
    entries, masks = given_cameras(inputs), given_masks(inputs, out)
    (out / FOLDER).mkdir(exist_ok=True)
    views, record = [], {}
    for view, name in zip(scene.views, file_names([v.name for v in scene.views]), strict=True):
        camera, folder = entries.get(view.name, (RpcCamera(), Path()))
        written = write_camera(out, name, camera, folder, view, scene)
        image = relative(view.path, out)
        mask = masks.get(view.name)
        views.append(
            ViewEntry(
                name=view.name, image=image, camera=written.entry, date=view.date, mask=mask, colours=colours(view, out)
            )
        )
        record[view.name] = written.entry.model_dump(mode="json", exclude_none=True)
        if written.fit_px is not None:
            record[view.name]["rpc_fit_max_px"] = written.fit_px
    frame = {"local": True} if is_local(scene.crs) else {"crs": scene.crs.to_string()}
    area = None if scene.bounds is None else {"bounds": scene.bounds}
    described = {"schema": 1, "frame": frame, "area": area, "heights": scene.heights, "views": tuple(views)}
    write_scene_file(out / SCENE, SceneFile.model_validate(described))
    return record


def colours(view: View, out: Path) -> ColourEntry | None:
    """The entry of the image that gives the colours of a view; None where there is none. out : folder of the file."""
    colour_image = view.image.colour_image if isinstance(view.image, RasterImage) else None
    if colour_image is None:
        return None
    camera = None if colour_image.camera is None else relative(colour_image.camera, out)
    return ColourEntry(image=relative(colour_image.path, out), bands=colour_image.bands, camera=camera)


def given_cameras(inputs: Sequence[Path]) -> dict[str, tuple[CameraEntry, Path]]:
    """Cameras of a scene file by view, with the folder where their paths start; empty where images are the input."""
    (first, *_) = inputs
    if first.suffix.lower() not in SCENE_SUFFIXES:
        return {}
    return {view.name: (view.camera, first.parent) for view in read_scene_file(first).views}


def given_masks(inputs: Sequence[Path], out: Path) -> dict[str, tuple[MaskEntry, ...]]:
    """Masks of a scene file or of deliveries by view, with paths that start at `out`."""
    (first, *_) = inputs
    if first.suffix.lower() in SCENE_SUFFIXES:
        given = {
            view.name: [entry.inside(first.parent) for entry in view.mask or ()]
            for view in read_scene_file(first).views
        }
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ZlocusWarning)  # said when the deliveries were opened first
            given = {entry.name: list(entry.masks) for entry in entries_of(inputs)}
    return {
        name: tuple(entry.model_copy(update={"file": relative(Path(entry.file), out)}) for entry in masks)
        for name, masks in given.items()
        if masks
    }


def _kind_of(camera: CameraEntry) -> str:
    """The kind of a camera, as its entry names it."""
    return str(getattr(camera, "kind", "unknown"))


def check_cameras_can_be_written(inputs: Sequence[Path]) -> None:
    """Refuse, before any work, cameras of a kind whose corrected form cannot be written.

    Raises
    ------
    ConfigError
        A camera is neither an RPC nor a frame camera nor a line scanner nor a location grid.
    """
    for name, (camera, _) in given_cameras(inputs).items():
        if not isinstance(camera, RpcCamera | FrameCamera | LineScanCamera | LocationGridCamera):
            raise ConfigError(
                f"The camera of {name} in {inputs[0]} is of the kind {_kind_of(camera)}, and corrected "
                "cameras are written for rpc, frame, linescan and location_grid only. Use zlocus dsm, which corrects "
                "it in the run."
            )


def write_camera(out: Path, name: str, camera: CameraEntry, folder: Path, view: View, scene: Scene) -> WrittenCamera:
    """Write the camera of a view. camera : of the input, with paths that start at `folder`."""
    if isinstance(camera, FrameCamera):
        return WrittenCamera(frame_entry(camera, view.sensor, scene))
    if isinstance(camera, LineScanCamera):
        return WrittenCamera(write_scanner(out, name, camera, folder, view, scene))
    if isinstance(camera, LocationGridCamera):
        shifted = shifted_entry(out, camera, folder, view.sensor)
        if shifted is not None:
            return WrittenCamera(shifted)
    rpc, fit_px = rpc_of(view, scene)
    file = f"{FOLDER}/{name}_RPC.TXT"
    write_rpc_txt(out / file, rpc)
    return WrittenCamera(RpcCamera(file=file), fit_px)


def rpc_of(view: View, scene: Scene) -> tuple[RpcCoefficients, float | None]:
    """Corrected RPC of a view, and the largest error of its fit, px.

    A shifted RPC is exact, and the error is None. Other corrections are fitted over the image and the RPC's heights.
    """
    sensor, (column, row) = without_shifts(view.sensor)
    if isinstance(sensor, RpcModel):
        return sensor.rpc.moved(column=column, row=row), None
    heights = view.sensor.height_bounds()
    assert heights is not None, "an RPC and a location grid know their heights"
    fit = fit_rpc(view.sensor, view.image.shape, scene.crs, heights)
    return fit.rpc, fit.max_error_px


def without_shifts(sensor: SensorModel) -> tuple[SensorModel, tuple[float, float]]:
    """The sensor model under the shifts that are laid over it, and their sum (column, row), px."""
    column = row = 0.0
    while isinstance(sensor, ShiftedModel):
        column, row, sensor = column + sensor.column, row + sensor.row, sensor.base_sensor
    return sensor, (column, row)


def shifted_entry(
    out: Path, camera: LocationGridCamera, folder: Path, sensor: SensorModel
) -> LocationGridCamera | None:
    """Entry of a location grid with its shift, which is exact; None where more than a shift was corrected."""
    bare, (column, row) = without_shifts(sensor)
    if not isinstance(bare, LocationGridModel):
        return None
    return camera.model_copy(update={"file": relative(folder / camera.file, out), "shift": (column, row)})


def frame_entry(camera: FrameCamera, sensor: SensorModel, scene: Scene) -> FrameCamera:
    """Entry of a frame camera in the scene's frame, with pose and motion relative to the map's axes at its centre."""
    while isinstance(sensor, ShiftedModel):
        assert isinstance(sensor.base_sensor, FrameModel), "one shift is laid over a camera"
        sensor = sensor.base_sensor.moved(sensor.column, sensor.row)
    assert isinstance(sensor, FrameModel), "frame cameras stay frame cameras"
    centre, rows, rolling_shutter = sensor.centre, sensor.camera_from_ground, sensor.rolling_shutter
    if isinstance(sensor.space, EarthSpace):
        on_map = sensor.space.ground_from_cartesian(np.array([centre]))[0]
        _, axes = sensor.space.pose(scene.crs, on_map)
        centre, rows = as_row(on_map), as_rows(sensor.rotation @ axes.T)
        rolling_shutter = None if rolling_shutter is None else rolling_shutter.turned(axes)
    changed = {
        "focal": (sensor.focal, sensor.focal * sensor.aspect), "principal_point": sensor.principal_point,
        "centre": centre, "rotation": rows, "angles": None, "crs": None,
        "distortion": distortion_entry(sensor.distortion), "rolling_shutter": rolling_shutter_entry(rolling_shutter),
    }  # fmt: skip
    return camera.model_copy(update=changed)


def write_scanner(
    out: Path, name: str, camera: LineScanCamera, folder: Path, view: View, scene: Scene
) -> LineScanCamera:
    """Write the corrected trajectory of a line scanner and return its entry.

    The trajectory is that of the projection centre and of the camera's axes.
    """
    sensor = view.sensor
    if not isinstance(sensor, LineScanModel | RectifiedModel):
        raise ConfigError(
            f"The image of the line scanner {view.name} was shifted, which a trajectory cannot express. Set "
            "orientation.model = joint in --config."
        )
    raw = sensor.raw_sensor if isinstance(sensor, RectifiedModel) else sensor
    on_earth = camera.rays == "earth"
    file = f"{FOLDER}/{name}_trajectory.csv"
    write_trajectory(out / file, raw.trajectory, "s; m; corrected", quaternions=on_earth)
    rectification = camera.rectification
    if isinstance(sensor, RectifiedModel):
        flawed = f"{FOLDER}/{name}_resampled.csv"
        write_trajectory(out / flawed, sensor.plane_sensor.trajectory, "s; m; as resampled", quaternions=on_earth)
        assert rectification is not None, "level 1 images say how they were resampled"
        rectification = rectification.model_copy(update={"trajectory": flawed})
    times = camera.times if not isinstance(camera.times, str) else relative(folder / camera.times, out)
    changed = {
        "calibration": relative(folder / camera.calibration, out), "trajectory": file, "times": times,
        "crs": "EPSG:4978" if on_earth else camera.crs, "lever_arm": (0.0, 0.0, 0.0), "boresight": (0.0, 0.0, 0.0),
        "rectification": rectification,
    }  # fmt: skip
    return camera.model_copy(update=changed)


def relative(path: Path, folder: Path) -> str:
    """A path relative to a folder, as scene files have it; absolute where none exists, and in an archive."""
    if is_archived(path):
        return absolute_path(path).as_posix()
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return path.resolve().as_posix()
