"""One ground in images of three kinds of sensor: an ADS40, a frame camera, and a satellite with RPCs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from zlocus.io.cameras.camera_kinds import RpcCamera
from zlocus.io.cameras.frame_camera import FrameCamera
from zlocus.io.scene_file import ViewEntry
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.synthetic.files import fit_exposure, new_folder, render_exposures, write_image
from zlocus.synthetic.linescan import TrajectoryNoise, image_name, write_linescan_views, write_scene
from zlocus.synthetic.scenes import (
    ADS40_VIEWS,
    CLEAR,
    SOFTER,
    Exposure,
    SceneSpec,
    ViewSpec,
    area_corners,
    build_ground,
    exposures_of,
    first_pixel_and_shape,
    steady,
)
from zlocus.synthetic.truth import write_truth

# A mapping camera of 100 mm focal length and 6 um pixels, 3500 m above the ground: ground pixels of 0.21 m. It takes
# three images along a strip 300 m to the west.
FOCAL_PX, ABOVE_GROUND_M, ASIDE_M, BASE_M = 100.0 / 0.006, 3500.0, 300.0, 1300.0
TILTS_DEG = ((0.8, -1.1, 91.0), (-0.5, 0.4, 89.2), (1.2, 0.7, 90.4))
FRAME_OPTICS = replace(SOFTER, gain=900.0, haze=120.0)
SATELLITE_GSD_M = 0.3
SATELLITE_VIEWS = (
    ViewSpec("s1", 3.0, 8.0, 188.0, optics=CLEAR),
    ViewSpec("s2", 21.0, 8.0, 188.0, optics=CLEAR),
    ViewSpec("s3", -19.0, 8.0, 188.0, optics=CLEAR),
)
SENSORS = ("linescan", "frame", "rpc")


def mixed_exposures(spec: SceneSpec) -> dict[str, tuple[Exposure, ...]]:
    """Three exposures of each sensor, by its kind. spec : the scene with its ground and the line scanner."""
    size = round(spec.size * spec.gsd_m / SATELLITE_GSD_M)
    above = replace(spec, camera="satellite", gsd_m=SATELLITE_GSD_M, truth_step_m=SATELLITE_GSD_M, size=size)
    return {
        "linescan": exposures_of(replace(spec, camera="ads40", views=ADS40_VIEWS[:3])),
        "frame": tuple(_photograph(spec, number) for number in range(len(TILTS_DEG))),
        "rpc": exposures_of(replace(above, views=SATELLITE_VIEWS)),
    }


def _photograph(spec: SceneSpec, number: int) -> Exposure:
    """The part of an image of the mapping camera that shows the area. The strip goes north."""
    side, (low, high) = spec.size * spec.gsd_m, spec.terrain_range
    east, north = spec.west_m + side / 2 - ASIDE_M, spec.north_m - side / 2 + (number - 1) * BASE_M
    centre = (east, north, (low + high) / 2 + ABOVE_GROUND_M)
    camera = FrameModel(centre, rotation_from_angles(*TILTS_DEG[number]), FOCAL_PX, (0.0, 0.0))
    view = ViewSpec(f"p{number + 1}", 0.0, 0.0, optics=FRAME_OPTICS)
    first, shape = first_pixel_and_shape(camera.image_from_ground(area_corners(spec)))
    return Exposure(view, camera.moved(-first[0], -first[1]), shape)


def render_mixed_scene(
    spec: SceneSpec, folder: Path, progress: Callable[[str], None] = lambda step: None
) -> dict[str, Path]:
    """Render the images of all sensors and the truth into a new folder.

    Returns the scene files: that of each sensor by its kind, and that of all sensors as `mixed`.

    Raises
    ------
    OutputError
        The folder exists already, or cannot be written.
    """
    exposures = mixed_exposures(spec)
    still = mixed_exposures(steady(spec))
    with new_folder(Path(folder)) as part:
        ground = build_ground(spec, tuple(exposure for group in still.values() for exposure in group))
        # The rim that two images show differs between the sensors, so surfaces are compared over the area only.
        write_truth(replace(spec, whole_truth=False), ground, (), part)
        entries = {
            "linescan": write_linescan_views(spec, exposures["linescan"], part, TrajectoryNoise()),
            "frame": tuple(_frame_entry(exposure) for exposure in exposures["frame"]),
            "rpc": tuple(_rpc_entry(exposure) for exposure in exposures["rpc"]),
        }
        for exposure, numbers in render_exposures(spec, ground, sum(exposures.values(), ()), progress):
            fit = fit_exposure(spec, exposure) if exposure in exposures["rpc"] else None
            write_image(part / image_name(exposure.view), numbers, None if fit is None else fit.rpc)
        for kind, views in (*entries.items(), ("mixed", sum(entries.values(), ()))):
            write_scene(spec, views, part / f"{kind}.yaml")
    return {kind: Path(folder) / f"{kind}.yaml" for kind in (*SENSORS, "mixed")}


def _frame_entry(exposure: Exposure) -> ViewEntry:
    camera = exposure.sensor
    assert isinstance(camera, FrameModel)
    rotation = tuple(tuple(row) for row in np.array(camera.camera_from_ground))
    entry = FrameCamera.model_validate({
        "kind": "frame", "focal": camera.focal, "principal_point": camera.principal_point, "centre": camera.centre,
        "rotation": rotation, "earth": "flat",
    })  # fmt: skip
    return ViewEntry(name=exposure.view.name, image=image_name(exposure.view), camera=entry)


def _rpc_entry(exposure: Exposure) -> ViewEntry:
    return ViewEntry(name=exposure.view.name, image=image_name(exposure.view), camera=RpcCamera())
