"""Write rendered line scanners: a focal plane, a trajectory per image with optional errors, and a `scene.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine

from zlocus.core.errors import ConfigError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.cameras.linescan import LineScanCamera, Rectification, RegularTimes
from zlocus.io.cameras.linescan_files import write_calibration, write_trajectory
from zlocus.io.scene_file import SceneFile, ViewEntry, write_scene_file
from zlocus.sensors.linescan import MARGIN_PX, FocalLine
from zlocus.sensors.trajectory import Drift, Trajectory
from zlocus.synthetic.cameras import LineScanner, RectifiedScanner
from zlocus.synthetic.scenes import Exposure, SceneSpec, ViewSpec

FOCAL_PLANE = "ads40.csv"
DETECTORS, NADIR_COLUMN = 12_000, 6_000
COLUMNS_WRITTEN = 500
# Names of the ADS40's lines by their angle ahead of the nadir (degrees).
LINES = {2.0: "nadir", 26.0: "forward", -14.0: "backward"}
SPEED_M_S = 70.0
SAMPLES_PER_S = 200.0
NOISE_STREAM = 41


@dataclass(frozen=True)
class TrajectoryNoise:
    """Errors that are added to written trajectories; zero by default.

    offset_m, turn_deg : standard deviation of slow errors along and about each axis of the camera, drawn every
    `every_s` and smooth in between (as GNSS and IMU have them after adjustment); jitter_m, jitter_deg : standard
    deviation of white noise of each sample.
    """

    offset_m: float = 0.0
    turn_deg: float = 0.0
    every_s: float = 10.0
    jitter_m: float = 0.0
    jitter_deg: float = 0.0


def image_name(view: ViewSpec) -> str:
    """File name of the image of a view."""
    return f"img_{view.name}.tif"


def write_linescan_views(
    spec: SceneSpec, exposures: tuple[Exposure, ...], folder: Path, noise: TrajectoryNoise
) -> tuple[ViewEntry, ...]:
    """Write the focal plane and the trajectories, and return the entries of the images for a scene file.

    The images themselves are written elsewhere.

    Raises
    ------
    ConfigError
        The cameras are no line scanners, images do not fit on their lines, or views have pointing errors of an RPC.
    """
    lines, entries, comment = {}, [], ""
    for index, exposure in enumerate(exposures):
        camera, view = exposure.taken.sensor, exposure.view
        if not isinstance(camera, LineScanner):
            raise ConfigError(f"SceneSpec.camera = {spec.camera!r} is no line scanner: choose 'ads40'.")
        if view.bias_row_px or view.bias_col_px:
            raise ConfigError(f"The pointing error of view {view.name} is one of RPCs. Use noise of the trajectory.")
        name = LINES.get(camera.along_deg, f"{camera.along_deg:+g}")
        lines[name] = focal_line(camera)
        comment = f"{camera.focal_m * 1e3:g} mm, {camera.pixel_m * 1e6:g} um; x to the right, y forward"
        rng = np.random.default_rng([spec.seed, NOISE_STREAM, index])
        trajectory = with_noise(sampled_trajectory(camera, exposure.taken.shape[0]), noise, rng)
        write_trajectory(folder / f"trajectory_{view.name}.csv", trajectory, "s; m in the scene's frame; degrees")
        entries.append(ViewEntry(name=view.name, image=image_name(view), camera=_entry(spec, exposure, camera, name)))
    write_calibration(folder / FOCAL_PLANE, lines, comment, COLUMNS_WRITTEN)
    return tuple(entries)


def write_scene(spec: SceneSpec, entries: tuple[ViewEntry, ...], path: Path) -> None:
    """Write a scene file of some views, with the CRS of the scene and the range of all its heights."""
    crs, heights = {"crs": f"EPSG:{spec.epsg}"}, spec.height_range
    scene = SceneFile.model_validate({"schema": 1, "frame": crs, "heights": heights, "views": entries})
    write_scene_file(path, scene)


def focal_line(camera: LineScanner) -> FocalLine:
    """The detectors of a camera. Detector `NADIR_COLUMN` lies in the vertical plane of the flight."""
    x_mm = 1e3 * camera.pixel_m * (np.arange(DETECTORS) - NADIR_COLUMN)
    y_mm = 1e3 * camera.focal_m * np.tan(np.deg2rad(camera.along_deg))
    return FocalLine(np.column_stack([x_mm, np.full(DETECTORS, y_mm)]), 1e3 * camera.focal_m)


def sampled_trajectory(camera: LineScanner, n_rows: int, samples_per_s: float = SAMPLES_PER_S) -> Trajectory:
    """The trajectory of a camera around an image of `n_rows` rows. Row 0, which is exposed last, is at 0 s."""
    interval = -camera.advance_m / SPEED_M_S
    start, end = interval * (n_rows + MARGIN_PX), -interval * MARGIN_PX
    times = np.arange(np.floor(start * samples_per_s), np.ceil(end * samples_per_s) + 1) / samples_per_s
    centres, frame_from_camera = camera.poses(times / interval)
    return Trajectory(times, centres, np.ascontiguousarray(frame_from_camera.swapaxes(-1, -2)))


def with_noise(trajectory: Trajectory, noise: TrajectoryNoise, rng: np.random.Generator) -> Trajectory:
    """The trajectory with random errors added."""
    times = trajectory.times
    n_knots = max(int(np.ceil((times[-1] - times[0]) / noise.every_s)), 3) + 1
    slow = _sigmas(noise.offset_m, noise.turn_deg) * rng.standard_normal((n_knots, 6))
    fast = _sigmas(noise.jitter_m, noise.jitter_deg) * rng.standard_normal((len(times), 6))
    drifted = Drift(np.linspace(times[0], times[-1], n_knots), slow).corrected(trajectory)
    return Drift(times, fast).corrected(drifted) if fast.any() else drifted


def _sigmas(offset_m: float, turn_deg: float) -> FloatArray:
    return np.array([offset_m] * 3 + [np.deg2rad(turn_deg)] * 3)


def _entry(spec: SceneSpec, exposure: Exposure, camera: LineScanner, line: str) -> LineScanCamera:
    """The camera entry of an exposure for the scene file."""
    first, n_cols = NADIR_COLUMN - camera.centre[0], exposure.taken.shape[1]
    if not 0 <= first <= DETECTORS - n_cols:
        raise ConfigError(
            f"View {exposure.view.name} needs the columns {first:.0f} to {first + n_cols - 1:.0f} of a line "
            f"of {DETECTORS}. Choose a smaller SceneSpec.size, or less across_deg."
        )
    return LineScanCamera(
        calibration=FOCAL_PLANE, line=line, focal_mm=1e3 * camera.focal_m, first_column=int(first),
        trajectory=f"trajectory_{exposure.view.name}.csv", crs=f"EPSG:{spec.epsg}", rays="frame",
        times=RegularTimes(start=0.0, interval=-camera.advance_m / SPEED_M_S),
        rectification=_rectification(exposure.sensor) if isinstance(exposure.sensor, RectifiedScanner) else None,
    )  # fmt: skip


def _rectification(camera: RectifiedScanner) -> Rectification:
    """The plane of a level 1 image. In the file, pixels are counted from the outer corner of the first one."""
    corner = camera.plane_from_image * Affine.translation(-0.5, -0.5)
    a, b, c, d, e, f, *_ = corner
    return Rectification(height=camera.height, transform=(a, b, c, d, e, f), rows=camera.raw_shape[0])
