"""A block of up to thousands of aerial frames over a repeated town, and what its plan and a part of it take.

The town of `large.py` is repeated without end. A frame that is taken a whole period farther on shows the same pixels,
so all frames of the block are exact renderings although only `len(PHASES)` of them are rendered: the file of every
other frame is a hard link to the one whose position in the period is the same. The cameras are perspective, with a
lens distortion, and each of the written positions and attitudes has an error of its own.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from workplace import table_line
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DsmRequest, SetupRequest
from zlocus.io.cameras.frame_camera import FrameCamera, distortion_entry
from zlocus.io.run_record import Stopwatch
from zlocus.io.scene_file import SceneFile, ViewEntry, write_scene_file
from zlocus.pipeline.execution.plan import plan_tiles
from zlocus.pipeline.run_plan import planned
from zlocus.pipeline.setup import open_inputs, orient_views, set_up_run
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.synthetic.render import Optics, Sun, expose, render, sunlit
from zlocus.synthetic.terrain import SyntheticGround

# Frames in a period of the town, down and across: strips fly half a period apart, frames follow after a quarter of it.
STRIPS_OF_PERIOD, FRAMES_OF_PERIOD = 2, 4
PHASES = tuple(product(range(STRIPS_OF_PERIOD), range(FRAMES_OF_PERIOD)))
# A frame shows a period across the flight, and three quarters of it along: both overlaps are those of a usual survey.
LENGTH_OF_FRAME = 0.75
FOCAL_PX = 1000.0
LENS = BrownDistortion(k1=-0.05, k2=0.01, p1=3e-4, p2=-2e-4)
LARGEST_TILT_DEG = 1.0
# Standard deviations of the errors of the written cameras.
POSITION_ERROR_M, ATTITUDE_ERROR_DEG = 0.1, 0.005
TILE_PX = 256
SUN = Sun(150.0, 45.0)


@dataclass(frozen=True)
class Survey:
    """The town that is surveyed, and how large its frames are.

    ground : the town with copies around it; west_m, north_m : corner of a period; gsd_m : ground pixel of a rendered
    frame; period_px : side of the period in these pixels; enlarged : by how much frames are enlarged after rendering.
    """

    ground: SyntheticGround
    west_m: float
    north_m: float
    gsd_m: float
    period_px: int
    enlarged: int = 1

    @property
    def period_m(self) -> float:
        """Side of the period, m."""
        return self.period_px * self.gsd_m

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame as it is rendered."""
        return round(LENGTH_OF_FRAME * self.period_px), self.period_px

    @property
    def z(self) -> tuple[float, float]:
        """Lowest and highest height of the town, m."""
        return self.ground.height_range

    def camera(self, strip: int, number: int) -> FrameModel:
        """The exact camera of a frame of a strip, for frames as they are rendered."""
        phase = PHASES.index((strip % STRIPS_OF_PERIOD, number % FRAMES_OF_PERIOD))
        omega, phi = np.random.default_rng([31, phase]).uniform(-LARGEST_TILT_DEG, LARGEST_TILT_DEG, 2)
        # Neighbouring strips are flown in opposite directions, along the rows of their frames.
        kappa = -90.0 if strip % 2 else 90.0
        rows, cols = self.shape
        centre = (
            self.west_m + number / FRAMES_OF_PERIOD * self.period_m,
            self.north_m - strip / STRIPS_OF_PERIOD * self.period_m,
            sum(self.z) / 2 + FOCAL_PX * self.gsd_m,
        )
        middle = ((cols - 1) / 2 + 2.5, (rows - 1) / 2 - 1.5)
        return FrameModel(centre, rotation_from_angles(omega, phi, kappa), FOCAL_PX, middle, distortion=LENS)


def strips_of(n_frames: int) -> list[tuple[int, int]]:
    """Strip and number in it of each frame of a block that is about 1.6 times as long as it is wide."""
    n_strips = max(round((n_frames / 1.6) ** 0.5), 2)
    per_strip = -(-n_frames // n_strips)
    return [divmod(number, per_strip) for number in range(n_frames)]


def write_frames(folder: Path, survey: Survey, n_frames: int) -> Path:
    """Write a block of frames and its scene file, whose path is returned."""
    lit, written, views = sunlit(survey.ground, SUN), {}, []
    for strip, number in strips_of(n_frames):
        name = f"s{strip:02d}_{number:03d}"
        path, phase = folder / f"{name}.tif", (strip % STRIPS_OF_PERIOD, number % FRAMES_OF_PERIOD)
        if phase in written:
            os.link(written[phase], path)
        else:
            radiance = render(survey.ground, survey.camera(*phase), survey.shape, SUN, lit=lit)
            pixels = expose(radiance, Optics(), np.random.default_rng([32, *phase]))
            write_frame(path, pixels, survey.enlarged)
            written[phase] = path
        views.append(entry(name, survey, strip, number))
    low, high = survey.z
    heights = (low - 20.0, high + 20.0)
    scene = {"schema": 1, "frame": {"crs": "EPSG:32632"}, "heights": heights, "views": tuple(views)}
    write_scene_file(folder / "scene.yaml", SceneFile.model_validate(scene))
    return folder / "scene.yaml"


def write_frame(path: Path, pixels: NDArray[np.integer], enlarged: int) -> None:
    """Write a frame (r, c), enlarged by bicubic interpolation, as a tiled TIFF."""
    if enlarged > 1:
        size = (pixels.shape[1] * enlarged, pixels.shape[0] * enlarged)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC)
    # A frame has no georeference but the camera in the scene file.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        file = rasterio.open(
            path, "w", driver="GTiff", height=pixels.shape[0], width=pixels.shape[1], count=1, dtype=pixels.dtype,
            tiled=True, blockxsize=TILE_PX, blockysize=TILE_PX,
        )  # fmt: skip
    with file:
        file.write(pixels, 1)


def entry(name: str, survey: Survey, strip: int, number: int) -> ViewEntry:
    """The entry of a frame in the scene file, with the errors of its position and attitude."""
    rng, n = np.random.default_rng([33, strip, number]), survey.enlarged
    errors = POSITION_ERROR_M * rng.standard_normal(3), np.deg2rad(ATTITUDE_ERROR_DEG) * rng.standard_normal(3)
    sensor = survey.camera(strip, number).corrected(*errors)
    column, row = (n * (place + 0.5) - 0.5 for place in sensor.principal_point)
    camera = FrameCamera.model_validate({
        "kind": "frame", "focal": n * sensor.focal, "principal_point": (column, row), "centre": sensor.centre,
        "rotation": sensor.camera_from_ground, "earth": "flat", "distortion": distortion_entry(sensor.distortion),
    })  # fmt: skip
    return ViewEntry(name=name, image=f"{name}.tif", camera=camera)


@dataclass(frozen=True)
class PlannedBlock:
    """What the plan of a whole block takes.

    n_frames : of the block; open_s, orient_s, setup_s : CPU time of opening the inputs, of tie points and bundle
    adjustment, and of everything else until the plan stands; wall_s : of all of it; peak_mb : largest memory; n_tiles :
    of the plan; plan : the sentence that the command prints.
    """

    n_frames: int
    open_s: float
    orient_s: float
    setup_s: float
    wall_s: float
    peak_mb: float
    n_tiles: int
    plan: str

    def row(self) -> str:
        """A line of the table below `PLAN_HEAD`."""
        cells = (
            self.n_frames, self.n_tiles, f"{self.open_s:.1f}", f"{self.orient_s:.1f}", f"{self.setup_s:.1f}",
            f"{self.wall_s:.0f}", f"{self.peak_mb:.0f}",
        )  # fmt: skip
        return table_line(cells)


PLAN_HEAD = (
    "| frames of the whole block | tiles | opening, CPU s | orientation, CPU s | set-up and plan, CPU s | wall, s | "
    "memory, MB |\n" + "|---" * 7 + "|"
)


def plan_of(scene: Path, resolution_m: float, workers: int) -> PlannedBlock:
    """Plan the whole area of a block as `zlocus dsm` does, up to its first tile."""
    watch, start = Stopwatch(), time.perf_counter()
    request = DsmRequest((scene,), scene.parent / "planned", resolution=resolution_m, workers=workers)
    asked, config, progress = SetupRequest.of(request), RunConfig(), SilentProgress()
    with watch.stage("open"):
        opened = open_inputs(asked, progress)
    with watch.stage("orient"):
        orientation = orient_views(opened.scene, config.orientation, progress, threads=workers)
    with watch.stage("setup"):
        setup = set_up_run(asked, opened, orientation, config, progress)
        tiles = plan_tiles(setup.grid.window, setup.match_scene.overlap_window, config.pyramid)
        plan = str(planned(setup.match_scene, tiles, config, request))
    seconds = [stage["cpu_s"] for stage in watch.stages]
    peak_mb = max(stage["peak_mb"] for stage in watch.stages)
    wall_s = time.perf_counter() - start
    return PlannedBlock(len(opened.scene.views), *seconds, wall_s, peak_mb, len(tiles), plan)


def planned_in_process(scene: Path, resolution_m: float, workers: int) -> PlannedBlock:
    """See `plan_of`; in a process of its own, whose memory is that of the plan alone."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(plan_of, scene, resolution_m, workers).result()


def part_of(survey: Survey, n_frames: int, side_m: float) -> tuple[float, float, float, float]:
    """Bounds (xmin, ymin, xmax, ymax), m, of a square in the middle of a block."""
    strip, number = (max(place) for place in zip(*strips_of(n_frames), strict=True))
    east = survey.west_m + number / 2 / FRAMES_OF_PERIOD * survey.period_m
    north = survey.north_m - strip / 2 / STRIPS_OF_PERIOD * survey.period_m
    return east - side_m / 2, north - side_m / 2, east + side_m / 2, north + side_m / 2


def true_heights(survey: Survey, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
    """Height of the repeated town at places, m; x, y : easting and northing, m."""
    east = survey.west_m + (x - survey.west_m) % survey.period_m
    south = (survey.north_m - y) % survey.period_m
    col = ((east - survey.ground.x0) / survey.ground.step).astype(int)
    row = ((survey.ground.y0 - survey.north_m + south) / survey.ground.step).astype(int)
    return survey.ground.heights[row, col]


def errors_of(dsm: Path, survey: Survey) -> NDArray[np.float64]:
    """Heights of a surface minus those of the town, m, of all cells that have a height."""
    with rasterio.open(dsm) as file:
        heights = file.read(1)
        row, col = np.nonzero(np.isfinite(heights))
        x, y = file.transform * (col + 0.5, row + 0.5)
    return heights[row, col].astype(float) - true_heights(survey, np.asarray(x), np.asarray(y))


@dataclass(frozen=True)
class MatchedPart:
    """What a part of a block takes.

    n_frames : of the block; n_read : of those that may show the part, which alone are read; million : cells; cpu_s,
    match_cpu_s : of the whole command and of its matching; peak_mb : largest memory of one process; nmad_m : spread of
    the errors of its heights; within_1m, filled : shares of the cells with a height, and of all cells.
    """

    n_frames: int
    n_read: int
    million: float
    wall_s: float
    cpu_s: float
    match_cpu_s: float
    peak_mb: float
    nmad_m: float
    within_1m: float
    filled: float

    def row(self) -> str:
        """A line of the table below `PART_HEAD`."""
        cells = (
            self.n_frames, self.n_read, f"{self.million:.3g}", f"{self.wall_s:.0f}", f"{self.cpu_s:.0f}",
            f"{self.cpu_s / self.million:.1f}", f"{self.match_cpu_s / self.million:.1f}", f"{self.peak_mb:.0f}",
            f"{self.nmad_m:.2f}", f"{100 * self.within_1m:.1f}", f"{100 * self.filled:.1f}",
        )  # fmt: skip
        return table_line(cells)


PART_HEAD = (
    "| frames | read for the part | M cells | wall, s | CPU, s | CPU, s / M cells | of matching | memory, MB | "
    "NMAD, m | within 1 m, % | filled, % |\n" + "|---" * 11 + "|"
)


def part_run(
    scene: Path, survey: Survey, n_frames: int, bounds: tuple[float, float, float, float], workers: int
) -> MatchedPart:
    """Run `zlocus dsm --bounds` over a part of a block, at the ground pixel of the rendered frames."""
    out, start = scene.parent / "part", time.perf_counter()
    words = [
        sys.executable, "-m", "zlocus", "dsm", str(scene), "-o", str(out), "--overwrite", "--resolution",
        str(survey.gsd_m), "--workers", str(workers), "--bounds", *map(str, bounds),
    ]  # fmt: skip
    subprocess.run(words, check=True, stdout=sys.stderr)
    wall_s = time.perf_counter() - start
    run = json.loads((out / "run.json").read_text(encoding="utf-8"))
    off, stages = errors_of(out / "dsm.tif", survey), {stage["name"]: stage for stage in run["stages"]}
    return MatchedPart(
        n_frames=n_frames,
        n_read=len(run["orientation"]["views"]),
        million=math.prod(run["grid"]["shape"]) / 1e6,
        wall_s=wall_s,
        cpu_s=sum(stage["cpu_s"] for stage in stages.values()),
        match_cpu_s=stages["match"]["cpu_s"],
        peak_mb=max(stage["peak_mb"] for stage in stages.values()),
        nmad_m=float(1.4826 * np.median(np.abs(off - np.median(off)))),
        within_1m=float((np.abs(off) <= 1.0).mean()),
        filled=run["coverage"],
    )


def measure_frames(folder: Path, survey: Survey, frames: Sequence[int], side_m: float, workers: int) -> None:
    """Print what the plans of blocks of some numbers of frames take, and then what a part of each block takes."""
    scenes = []
    print(PLAN_HEAD, flush=True)
    for n_frames in frames:
        place = folder / f"frames{n_frames}"
        place.mkdir()
        scenes.append(write_frames(place, survey, n_frames))
        print(planned_in_process(scenes[-1], survey.gsd_m, workers).row(), flush=True)
    print(f"\n{PART_HEAD}", flush=True)
    for scene, n_frames in zip(scenes, frames, strict=True):
        print(part_run(scene, survey, n_frames, part_of(survey, n_frames, side_m), workers).row(), flush=True)
