"""One ground seen by three kinds of sensor, a strip each: an ADS40, a frame camera, and a satellite with RPC."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from zlocus.io.cameras.camera_kinds import RpcCamera
from zlocus.io.cameras.frame_camera import FrameCamera
from zlocus.io.scene_file import ViewEntry
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.synthetic.files import exposed, fit_exposure, new_folder, write_image
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
    exposures,
    placed,
    steady,
)
from zlocus.synthetic.truth import write_truth

# A mapping camera of 100 mm and 6 um, 3500 m above the ground: 0.21 m, three images along a strip 300 m to the west.
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
    """Three images of each sensor, by its kind. spec : of the ground and of the line scanner."""
    size = round(spec.size * spec.gsd_m / SATELLITE_GSD_M)
    above = replace(spec, camera="satellite", gsd_m=SATELLITE_GSD_M, truth_step_m=SATELLITE_GSD_M, size=size)
    return {
        "linescan": exposures(replace(spec, camera="ads40", views=ADS40_VIEWS[:3])),
        "frame": tuple(_photograph(spec, number) for number in range(len(TILTS_DEG))),
        "rpc": exposures(replace(above, views=SATELLITE_VIEWS)),
    }


def _photograph(spec: SceneSpec, number: int) -> Exposure:
    """The part of an image of the mapping camera that shows the area; its strip goes north."""
    side, (low, high) = spec.size * spec.gsd_m, spec.terrain_range
    east, north = spec.west_m + side / 2 - ASIDE_M, spec.north_m - side / 2 + (number - 1) * BASE_M
    centre = (east, north, (low + high) / 2 + ABOVE_GROUND_M)
    camera = FrameModel(centre, rotation_from_angles(*TILTS_DEG[number]), FOCAL_PX, (0.0, 0.0))
    view = ViewSpec(f"p{number + 1}", 0.0, 0.0, optics=FRAME_OPTICS)
    first, shape = placed(camera.image_from_ground(area_corners(spec)))
    return Exposure(view, camera.moved(-first[0], -first[1]), shape)


def render_mixed_scene(
    spec: SceneSpec, folder: Path, progress: Callable[[str], None] = lambda step: None
) -> dict[str, Path]:
    """Render the images of all sensors and the truth into a new folder; returns the scene files: of each sensor by its
    kind, and of all of them as `mixed`.

    Raises
    ------
    OutputError
        Where the folder exists already, or cannot be written.
    """
    seen_by = mixed_exposures(spec)
    still = mixed_exposures(steady(spec))
    with new_folder(Path(folder)) as part:
        ground = build_ground(spec, tuple(exposure for group in still.values() for exposure in group))
        # The rim that two images see is another one for every sensor; surfaces are compared over the area itself.
        write_truth(replace(spec, whole_truth=False), ground, (), part)
        entries = {
            "linescan": write_linescan_views(spec, seen_by["linescan"], part, TrajectoryNoise()),
            "frame": tuple(_frame_entry(exposure) for exposure in seen_by["frame"]),
            "rpc": tuple(_rpc_entry(exposure) for exposure in seen_by["rpc"]),
        }
        for exposure, numbers in exposed(spec, ground, sum(seen_by.values(), ()), progress):
            fit = fit_exposure(spec, exposure) if exposure in seen_by["rpc"] else None
            write_image(part / image_name(exposure.view), numbers, None if fit is None else fit.rpc)
        for kind, views in (*entries.items(), ("mixed", sum(entries.values(), ()))):
            write_scene(spec, views, part / f"{kind}.yaml")
    return {kind: Path(folder) / f"{kind}.yaml" for kind in (*SENSORS, "mixed")}


def _frame_entry(exposure: Exposure) -> ViewEntry:
    camera = exposure.camera
    assert isinstance(camera, FrameModel)
    rotation = tuple(tuple(row) for row in np.array(camera.camera_from_ground))
    entry = FrameCamera.model_validate({
        "kind": "frame", "focal": camera.focal, "principal_point": camera.principal_point, "centre": camera.centre,
        "rotation": rotation, "earth": "flat",
    })  # fmt: skip
    return ViewEntry(name=exposure.view.name, image=image_name(exposure.view), camera=entry)


def _rpc_entry(exposure: Exposure) -> ViewEntry:
    return ViewEntry(name=exposure.view.name, image=image_name(exposure.view), camera=RpcCamera())
