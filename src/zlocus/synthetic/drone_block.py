"""A block of images of a drone over a rendered settlement, with its exact truth.

A consumer drone flies parallel strips at a constant height, and strips across them where that is asked for. Its frames
are colour JPEGs of a lens with distortion, and of a rolling shutter where a read-out time is given. They are rendered
through exact sensor models, which are written to `scene.yaml` unless errors are asked for, so the truth is exact.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from zlocus.core.errors import ConfigError
from zlocus.core.options.option_fields import Checked, option
from zlocus.core.sensor_model import FloatArray
from zlocus.io.cameras.frame_camera import FrameCamera, distortion_entry, rolling_shutter_entry
from zlocus.io.scene_file import SceneFile, ViewEntry, write_scene_file
from zlocus.sensors.distortion import BrownDistortion, Distortion
from zlocus.sensors.frame import FrameModel, as_row, rotation_from_angles
from zlocus.sensors.rolling_shutter import RollingShutter
from zlocus.synthetic.drone_ground import ColouredGround, Settlement, build_settlement
from zlocus.synthetic.drone_photo import DronePhoto, photographed, write_photo
from zlocus.synthetic.drone_trees import TALLEST_TREE_M
from zlocus.synthetic.drone_truth import write_drone_truth
from zlocus.synthetic.files import new_folder
from zlocus.synthetic.render import Sun, sunlit
from zlocus.synthetic.scenes import Exposure, ViewSpec
from zlocus.synthetic.terrain import TEXTURE_STREAM, Relief, natural_ground
from zlocus.synthetic.textures import natural_textures

FLIGHT_STREAM, NOISE_STREAM, ERROR_STREAM = 51, 52, 53
# Coefficients of the size that lenses of consumer drones have.
DRONE_LENS = BrownDistortion(k1=-0.26, k2=0.10, p1=7e-4, p2=3e-4, k3=-0.025)
# The optical axis meets the image this far right of and below its middle, by the number of columns.
PRINCIPAL_OFFSET = (0.0031, -0.0018)
# A texel of the natural textures by the ground pixel. Textures repeat after about 0.4 of the width of a frame, and they
# have at most this many texels along a side, to save memory.
TEXEL_PX, MAX_TEXTURE_SIZE = 0.4, 4096
LONGEST_RELIEF_M, RELIEF_ROUGHNESS = 200.0, 3.0
# Above the terrain rise trees, and houses on slopes.
TALLEST_M = TALLEST_TREE_M + 4.0
MARGIN_M = 2.0
# Standard deviation of the logarithm of the exposure between frames, and share of light by the middle of a frame.
EXPOSURE_SPREAD = 0.05


@dataclass(frozen=True)
class DroneBlockSpec(Checked):
    """A block of drone images to render. Equal specifications give equal bytes."""

    seed: int = option(1, "Seed of ground, flight and noise.", low=0)
    columns: int = option(4000, "Columns of a frame, across the flight.", low=64, high=20000)
    rows: int = option(3000, "Rows of a frame, along the flight.", low=64, high=20000)
    strips: int = option(4, "Number of strips.", low=1, high=50)
    frames_per_strip: int = option(5, "Number of frames in a strip.", low=1, high=200)
    forward_overlap: float = option(0.6, "Share of the ground of a frame that the next one shows.", low=0.0, high=0.95)
    side_overlap: float = option(0.6, "Share of the ground of a strip that the next one shows.", low=0.0, high=0.95)
    focal_px: float = option(3000.0, "Focal length.", low=50.0, high=50000.0, unit="px")
    flying_height_m: float = option(80.0, "Height above the middle of the terrain.", low=40.0, high=500.0, unit="m")
    distortion: Distortion = field(default=DRONE_LENS)
    heading_deg: float = option(20.0, "Direction of the first strip, clockwise from north.", low=0.0, high=360.0)
    least_tilt_deg: float = option(1.0, "Least tilt of a frame from the nadir.", low=0.0, high=20.0, unit="deg")
    largest_tilt_deg: float = option(3.0, "Largest tilt of a frame from the nadir.", low=0.0, high=20.0, unit="deg")
    heading_noise_deg: float = option(2.0, "Standard deviation of the headings of frames.", low=0.0, high=20.0)
    flight_noise_m: float = option(0.6, "Standard deviation of stations from the plan.", low=0.0, high=20.0, unit="m")
    position_error_m: float = option(
        0.0, "Standard deviation, by axis, of the errors of written positions.", low=0.0, high=50.0, unit="m"
    )
    angle_error_deg: float = option(
        0.0, "Standard deviation, about each axis, of the errors of written attitudes.", low=0.0, high=10.0, unit="deg"
    )
    crossing_strips: int = option(
        0, "Number of strips across the others, over the middle of the block.", low=0, high=50
    )
    crossing_tilt_deg: float = option(
        0.0, "Tilt of the frames of crossing strips from the nadir, forwards.", low=0.0, high=30.0, unit="deg"
    )
    readout_s: float = option(
        0.0, "Time in which the rows of a frame are read, from the first to the last. 0: all at once.", low=0.0,
        high=1.0, unit="s",
    )  # fmt: skip
    speed_m_s: float = option(8.0, "Speed along the strip during the read-out.", low=0.0, high=50.0, unit="m/s")
    # What `scene.yaml` states of the camera instead of the truth; None is the truth.
    stated_distortion: Distortion | None = field(default=None)
    stated_focal_px: float | None = option(None, "Focal length that is stated.", low=50.0, high=50000.0, unit="px")
    stated_readout_s: float | None = option(None, "Read-out time that is stated.", low=0.0, high=1.0, unit="s")
    step_m: float = option(0.04, "Cell of the height field and of the truth.", low=0.01, high=5.0, unit="m")
    samples: int = option(2, "Rays per pixel and axis.", low=1, high=8)
    base_m: float = option(480.0, "Lowest ellipsoidal height of the terrain.", low=-400.0, high=8000.0, unit="m")
    relief_m: float = option(10.0, "Difference from lowest to highest terrain.", low=0.1, high=100.0, unit="m")
    houses_per_ha: float = option(9.0, "Houses that are tried to be placed per hectare.", low=0.0, high=200.0)
    trees_per_ha: float = option(35.0, "Trees and bushes that are tried to be planted per hectare.", low=0.0, high=1e3)
    cars_per_ha: float = option(8.0, "Cars that are tried to be parked per hectare.", low=0.0, high=200.0)
    n_targets: int = option(6, "Painted targets, whose centres stand in `scene.json`.", low=0, high=200)
    east_m: float = option(462200.0, "Easting of the middle of the block.", unit="m")
    north_m: float = option(5247300.0, "Northing of the middle of the block.", unit="m")
    epsg: int = option(32632, "Projected CRS of the truth; heights are ellipsoidal.", low=1024, high=32767)
    sun: Sun = field(default=Sun(160.0, 47.0))
    photo: DronePhoto = field(default=DronePhoto())

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.largest_tilt_deg < self.least_tilt_deg:
            raise ConfigError(
                f"DroneBlockSpec.largest_tilt_deg = {self.largest_tilt_deg} is less than least_tilt_deg = "
                f"{self.least_tilt_deg}. Give the larger one first, or leave both out."
            )
        if not 1 <= self.photo.quality <= 100:
            raise ConfigError(f"DroneBlockSpec.photo.quality = {self.photo.quality} is outside its range 1 to 100.")
        if self.flying_height_m < self.relief_m / 2 + TALLEST_M + MARGIN_M:
            raise ConfigError(
                f"DroneBlockSpec.flying_height_m = {self.flying_height_m} m is not above trees of {TALLEST_TREE_M:g} m "
                f"on terrain with relief_m = {self.relief_m}. Fly higher, or choose less relief_m."
            )
        camera = _level_camera(self)
        for name, each in (("distortion", camera), ("stated_distortion", _with_stated_interior(self, camera))):
            if not np.isfinite(each.ray_from_image(_outline(self))).all():
                raise ConfigError(
                    f"DroneBlockSpec.{name} does not map all of the frame: choose a longer focal_px or smaller "
                    "coefficients."
                )

    @property
    def ground_pixel_m(self) -> float:
        """Ground pixel at the middle of the terrain, in the middle of a frame, m."""
        return self.flying_height_m / self.focal_px

    @property
    def middle_m(self) -> float:
        """Middle of the heights of the terrain, m."""
        return self.base_m + self.relief_m / 2

    @property
    def height_range(self) -> tuple[float, float]:
        """Lower and upper bound of all heights, with objects, m."""
        return self.base_m - 1.0, self.base_m + self.relief_m + TALLEST_M

    @property
    def crs(self) -> CRS:
        """CRS of the ground."""
        return CRS.from_epsg(self.epsg)


@dataclass(frozen=True)
class RenderedDroneBlock:
    """The files of a rendered block. images : by name of the frame."""

    folder: Path
    scene: Path
    images: dict[str, Path]
    truth_dsm: Path
    truth_class: Path


def small_drone_block_spec(seed: int = 1, **changes: object) -> DroneBlockSpec:
    """A block for tests: six frames of 560 x 420 px in two strips, with the angle of view of the large block."""
    small = DroneBlockSpec(
        seed=seed, columns=560, rows=420, focal_px=420.0, strips=2, frames_per_strip=3, step_m=0.2, n_targets=12
    )
    return replace(small, **changes)  # type: ignore[arg-type]


def frame_spacing(spec: DroneBlockSpec) -> tuple[float, float]:
    """Distances (m) between frames of a strip and between strips that give the overlaps at the middle of the terrain.

    The ground that a frame shows is measured along the middle column and the middle row of a frame without tilt.
    """
    camera = _level_camera(spec)
    x, y = (spec.columns - 1) / 2, (spec.rows - 1) / 2
    ends = np.array([(x, -0.5), (x, spec.rows - 0.5), (-0.5, y), (spec.columns - 0.5, y)])
    top, bottom, left, right = spec.flying_height_m * camera.ray_from_image(ends)
    along, across = float(np.linalg.norm(bottom - top)), float(np.linalg.norm(right - left))
    return (1.0 - spec.forward_overlap) * along, (1.0 - spec.side_overlap) * across


class FlownStrip(NamedTuple):
    """A strip of a block. name : prefix of the names of its frames; heading_deg : of the flight, clockwise from north;
    stations : (n, 3) m, planned positions of its frames; tilt_deg : of the frames from the nadir, forwards."""

    name: str
    heading_deg: float
    stations: FloatArray
    tilt_deg: float


def flown_strips(spec: DroneBlockSpec) -> list[FlownStrip]:
    """The strips of a block: parallel ones, then those across. Of both, every second one is flown backwards.

    The frames of crossing strips are taken so far before the others that their optical axes meet the same ground.
    """
    along_m, across_m = frame_spacing(spec)
    middle = np.array([spec.east_m, spec.north_m, spec.middle_m + spec.flying_height_m])
    before_m = spec.flying_height_m * np.tan(np.deg2rad(spec.crossing_tilt_deg))
    kinds = (("s", spec.strips, 0.0, 0.0, 0.0), ("c", spec.crossing_strips, 90.0, before_m, spec.crossing_tilt_deg))
    strips, number = [], np.arange(spec.frames_per_strip)
    for prefix, n_strips, turn_deg, before, tilt_deg in kinds:
        heading = np.deg2rad(spec.heading_deg + turn_deg)
        forward = np.array([np.sin(heading), np.cos(heading), 0.0])
        right = np.array([np.cos(heading), -np.sin(heading), 0.0])
        for strip in range(n_strips):
            backwards_deg, sense = (180.0, -1.0) if strip % 2 == 1 else (0.0, 1.0)
            ahead = (number - (spec.frames_per_strip - 1) / 2) * along_m * sense - sense * before
            aside = (strip - (n_strips - 1) / 2) * across_m
            stations = middle + ahead[:, None] * forward + aside * right
            heading_deg = spec.heading_deg + turn_deg + backwards_deg
            strips.append(FlownStrip(f"{prefix}{strip + 1}", heading_deg, stations, tilt_deg))
    return strips


def drone_exposures(spec: DroneBlockSpec) -> tuple[Exposure, ...]:
    """The exposures of all frames with exact cameras, strip by strip (see `flown_strips`)."""
    rng = np.random.default_rng([spec.seed, FLIGHT_STREAM])
    result = []
    for strip in flown_strips(spec):
        for number, station in enumerate(strip.stations):
            centre = station + spec.flight_noise_m * rng.standard_normal(3)
            tilt, towards = rng.uniform(spec.least_tilt_deg, spec.largest_tilt_deg), rng.uniform(0.0, 2.0 * np.pi)
            turned = strip.heading_deg + spec.heading_noise_deg * rng.standard_normal()
            angles = (float(tilt * np.cos(towards)), float(tilt * np.sin(towards)), float(-turned))
            camera = replace(
                _level_camera(spec), centre=as_row(centre), camera_from_ground=rotation_from_angles(*angles),
                rolling_shutter=_rolling_shutter(spec, strip.heading_deg),
            )  # fmt: skip
            if strip.tilt_deg:
                camera = camera.corrected(np.zeros(3), np.deg2rad([strip.tilt_deg, 0.0, 0.0]))
            view = ViewSpec(f"{strip.name}_{number + 1}", 0.0, 0.0, float(turned), spec.sun)
            result.append(Exposure(view, camera, (spec.rows, spec.columns)))
    return tuple(result)


def _rolling_shutter(spec: DroneBlockSpec, heading_deg: float) -> RollingShutter | None:
    """The motion of a drone that flies level in a direction; None where all rows are read at once."""
    if not (spec.readout_s or spec.stated_readout_s):
        return None
    heading = np.deg2rad(heading_deg)
    velocity = (float(spec.speed_m_s * np.sin(heading)), float(spec.speed_m_s * np.cos(heading)), 0.0)
    return RollingShutter(spec.readout_s, velocity, spec.rows)


def _level_camera(spec: DroneBlockSpec) -> FrameModel:
    """The camera at the origin, looking straight down with the top of the image to the north."""
    x, y = (
        (n - 1) / 2 + offset * spec.columns
        for n, offset in zip((spec.columns, spec.rows), PRINCIPAL_OFFSET, strict=True)
    )
    rotation = rotation_from_angles(0.0, 0.0, 0.0)
    return FrameModel((0.0, 0.0, 0.0), rotation, spec.focal_px, (x, y), distortion=spec.distortion)


def build_drone_ground(spec: DroneBlockSpec, exposures: tuple[Exposure, ...]) -> ColouredGround:
    """The ground that any of the exposures can show, with all objects."""
    xyz = np.concatenate([
        exposure.sensor.ground_from_image(_outline(spec), np.full(len(_outline(spec)), z))
        for exposure in exposures for z in spec.height_range
    ])  # fmt: skip
    step = spec.step_m
    west, south = (float(np.floor((xyz[:, k].min() - MARGIN_M) / step) * step) for k in (0, 1))
    cols, rows = (
        int(np.ceil((xyz[:, k].max() + MARGIN_M - low) / step)) for k, low in ((0, west), (1, south))
    )  # fmt: skip
    relief = Relief(spec.base_m, spec.relief_m, LONGEST_RELIEF_M, RELIEF_ROUGHNESS)
    origin = (west, south + rows * step)
    bare = natural_ground(spec.seed, origin, step, (rows, cols), relief, TEXEL_PX * spec.ground_pixel_m)
    size = min(1 << (spec.columns - 1).bit_length(), MAX_TEXTURE_SIZE)
    bare = replace(bare, textures=natural_textures(np.random.default_rng([spec.seed, TEXTURE_STREAM]), size))
    settlement = Settlement(
        spec.houses_per_ha, spec.trees_per_ha, spec.cars_per_ha, spec.n_targets, spec.ground_pixel_m
    )
    return build_settlement(bare, settlement, spec.seed)


def _outline(spec: DroneBlockSpec) -> FloatArray:
    """Positions (n, 2) px along the border of a frame, three pixels beyond it."""
    x, y = np.linspace(-3.0, spec.columns + 2.0, 33), np.linspace(-3.0, spec.rows + 2.0, 33)
    return np.concatenate([
        *(np.column_stack([x, np.full(33, at)]) for at in (y[0], y[-1])),
        *(np.column_stack([np.full(33, at), y]) for at in (x[0], x[-1])),
    ])  # fmt: skip


def render_drone_block(
    spec: DroneBlockSpec, folder: Path, progress: Callable[[str], None] = lambda step: None
) -> RenderedDroneBlock:
    """Render all frames of a block and write them, `scene.yaml`, `scene.json` and the truth into a new folder.

    The folder appears only when it is complete. progress : called with a word before each step.

    Raises
    ------
    OutputError
        The folder exists already, or cannot be written.
    """
    folder = Path(folder)
    exposures = drone_exposures(spec)
    with new_folder(folder) as part:
        progress("terrain")
        coloured_ground = build_drone_ground(spec, exposures)
        progress("truth")
        write_drone_truth(coloured_ground.ground, exposures, spec.epsg, part)
        written = written_cameras(spec, exposures)
        _write_scene_file(spec, exposures, written, part / "scene.yaml")
        _write_description(spec, coloured_ground, exposures, part / "scene.json")
        progress("light")
        lit = sunlit(coloured_ground.ground, spec.sun)
        for index, exposure in enumerate(exposures):
            progress(exposure.view.name)
            rng = np.random.default_rng([spec.seed, NOISE_STREAM, index])
            gain = float(np.exp(EXPOSURE_SPREAD * rng.standard_normal()))
            photo = replace(spec.photo, exposure=spec.photo.exposure * gain)
            camera = frame_model(exposure)
            bands = photographed(coloured_ground, camera, exposure.shape, lit, spec.sun, spec.samples, photo, rng)
            write_photo(part / photo_name(exposure), bands, photo.quality)
    return drone_block_files(spec, folder)


def drone_block_files(spec: DroneBlockSpec, folder: Path) -> RenderedDroneBlock:
    """The files of a block that `render_drone_block` has written."""
    images = {exposure.view.name: folder / photo_name(exposure) for exposure in drone_exposures(spec)}
    return RenderedDroneBlock(
        folder, folder / "scene.yaml", images, folder / "truth_dsm.tif", folder / "truth_class.tif"
    )  # fmt: skip


def photo_name(exposure: Exposure) -> str:
    """File name of a frame."""
    return f"{exposure.view.name}.jpg"


def frame_model(exposure: Exposure) -> FrameModel:
    """The camera of an exposure of a drone."""
    assert isinstance(exposure.sensor, FrameModel)
    return exposure.sensor


def written_cameras(spec: DroneBlockSpec, exposures: tuple[Exposure, ...]) -> tuple[FrameModel, ...]:
    """The cameras with the errors of position and attitude, and the lens and read-out time, that `scene.yaml` states.

    By default they are exact.
    """
    rng = np.random.default_rng([spec.seed, ERROR_STREAM])
    cameras = []
    for exposure in exposures:
        offset = spec.position_error_m * rng.standard_normal(3)
        turn = np.deg2rad(spec.angle_error_deg) * rng.standard_normal(3)
        camera = _with_stated_interior(spec, frame_model(exposure))
        cameras.append(camera.corrected(offset, turn) if offset.any() or turn.any() else camera)
    return tuple(cameras)


def _with_stated_interior(spec: DroneBlockSpec, sensor: FrameModel) -> FrameModel:
    """A camera with the interior orientation and the read-out time that `scene.yaml` states."""
    if spec.stated_focal_px is not None:
        sensor = replace(sensor, focal=spec.stated_focal_px)
    if spec.stated_distortion is not None:
        sensor = replace(sensor, distortion=spec.stated_distortion)
    if spec.stated_readout_s is not None and sensor.rolling_shutter is not None:
        sensor = replace(sensor, rolling_shutter=replace(sensor.rolling_shutter, readout_s=spec.stated_readout_s))
    return sensor


def _write_scene_file(
    spec: DroneBlockSpec, exposures: tuple[Exposure, ...], sensors: tuple[FrameModel, ...], path: Path
) -> None:  # fmt: skip
    views = tuple(_entry(exposure, sensor) for exposure, sensor in zip(exposures, sensors, strict=True))
    crs, heights = {"crs": f"EPSG:{spec.epsg}"}, spec.height_range
    scene = SceneFile.model_validate({"schema": 1, "frame": crs, "heights": heights, "views": views})
    write_scene_file(path, scene)


def _entry(exposure: Exposure, sensor: FrameModel) -> ViewEntry:
    """The entry of a frame in the scene file. The map is taken for Cartesian axes, as in the rendering."""
    camera = FrameCamera.model_validate({
        "kind": "frame", "focal": sensor.focal, "principal_point": sensor.principal_point, "centre": sensor.centre,
        "rotation": sensor.camera_from_ground, "earth": "flat", "distortion": distortion_entry(sensor.distortion),
        "rolling_shutter": rolling_shutter_entry(sensor.rolling_shutter),
    })  # fmt: skip
    return ViewEntry(name=exposure.view.name, image=photo_name(exposure), camera=camera)


def _write_description(
    spec: DroneBlockSpec, coloured_ground: ColouredGround, exposures: tuple[Exposure, ...], path: Path
) -> None:  # fmt: skip
    """Write `scene.json`: what the block is, its targets, and the exact cameras."""
    low, high = coloured_ground.ground.height_range
    along_m, across_m = frame_spacing(spec)
    frames = {
        exposure.view.name: {
            "centre": frame_model(exposure).centre, "rotation": frame_model(exposure).camera_from_ground,
            "heading_deg": exposure.view.heading_deg,
        }
        for exposure in exposures
    }  # fmt: skip
    text = {
        "crs": f"EPSG:{spec.epsg}", "kind": "drone", "seed": spec.seed, "ground_pixel_m": spec.ground_pixel_m,
        "frame_spacing_m": along_m, "strip_spacing_m": across_m, "forward_overlap": spec.forward_overlap,
        "side_overlap": spec.side_overlap, "position_error_m": spec.position_error_m,
        "angle_error_deg": spec.angle_error_deg, "zmin": low, "zmax": high, "targets": coloured_ground.targets.tolist(),
        "frames": frames, "spec": asdict(spec),
    }  # fmt: skip
    path.write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")
