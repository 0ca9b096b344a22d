"""Compile the kernels in advance, in separate processes, while other work runs; the cache on disk serves all processes.

`python -m zlocus.pipeline.execution.precompile GROUP` runs one group of kernels on a scene of a few cells; without a
group, all are compiled that are not there yet.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.jit import CACHE
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress, SilentProgress, duration, progress_for
from zlocus.core.resources import cores
from zlocus.core.scene import ImageWindow, View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.radiometry import GreyScale

GROUPS = ("orient", "match", "refine")
FOR_ANOTHER = (
    "import sys; from zlocus.pipeline.execution.precompile import warm_for_another; warm_for_another(sys.argv[1])"
)
SIDE = 96
# Time to compile all kernels on one core of 2024.
COMPILING_CPU_S = 150.0
# Of Python's collector of unused objects. Compiling makes millions of objects and keeps most: with the default, a sixth
# of the time is spent looking through them.
GC_THRESHOLDS = (20_000, 10, 10)


@contextmanager
def kernels_compiling(progress: Progress | None = None) -> Iterator[None]:
    """Compile the kernels while the block runs; at its end they are ready.

    Nothing is done where they are ready already, or where none can be kept. progress : is told why the run takes longer
    than usual, and for how long.
    """
    if CACHE.is_complete or CACHE.folder is None:
        yield
        return
    from zlocus.pipeline.execution.processes import kernel_cache

    progress, running = progress or SilentProgress(), []
    seconds = COMPILING_CPU_S / min(cores(), len(GROUPS))
    progress.note(
        f"Kernels are being compiled, once after an installation or an update. This takes about {duration(seconds)} of "
        f"this run. They are kept in {CACHE.folder}."
    )
    try:
        for group in GROUPS:
            command = [sys.executable, "-c", FOR_ANOTHER, group]
            # What it prints is not asked for; its input ends when this process does, and so does it.
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                env=os.environ | kernel_cache(),
            )  # fmt: skip
            running.append(process)
        yield
        with progress.stage("Compiling kernels", len(running)) as stage:
            for process in running:
                process.wait()
                stage.advance()
        if not any(process.returncode for process in running):
            CACHE.mark_complete()
    finally:
        for process in running:
            process.kill()
            process.communicate()


@dataclass(frozen=True)
class SlantedCamera:
    """A sensor with parallel rays: column = E + by_height z, row = -N."""

    by_height: float

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return np.column_stack([xyz[:, 0] + self.by_height * xyz[:, 2], -xyz[:, 1]])

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return np.column_stack([xy[:, 0] - self.by_height * z, -xy[:, 1], np.broadcast_to(z, len(xy))])

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None


@dataclass(frozen=True)
class Noise:
    """An image of noise."""

    seed: int
    shape: tuple[int, int] = (SIDE, SIDE)
    dtype: str = "float32"

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """See `ImageSource`."""
        pixels = np.random.default_rng(self.seed).normal(size=self.shape).astype(np.float32)
        part = np.ascontiguousarray(pixels[row : row + rows, col : col + cols])
        return ImageWindow(part, np.ones(part.shape, bool))


def tiny_scene() -> MatchScene:
    """Two images of noise over 96 x 96 cells."""
    views = tuple(View(f"v{i}", Path(f"v{i}"), Noise(i), SlantedCamera(0.5 * i)) for i in range(2))
    return MatchScene(
        views=views, anchor=(0.0, 0.0), cell_size=1.0, height_origin=0.0, height_step=1.0, n_steps=16, levels=2,
        overlap_window=CellWindow(0, 0, SIDE, SIDE), grey_scales=(GreyScale(0.0, 1.0),) * 2, ties=np.zeros((0, 3)),
    )  # fmt: skip


def warm_orientation(match_scene: MatchScene) -> None:
    """Run the kernels of the orientation once."""
    from zlocus.orientation.epipolar import Sightlines, epipolar_curves
    from zlocus.orientation.sift import N_DESCRIPTOR_VALUES, Features
    from zlocus.orientation.tie_refinement import refine_ties
    from zlocus.orientation.ties import MAX_DESCRIPTOR_RATIO, match_along_curves
    from zlocus.orientation.triangulate import Observations, ground_jacobian
    from zlocus.sensors.distortion import BrownDistortion
    from zlocus.sensors.frame import FrameModel
    from zlocus.sensors.rpc_kernel import ground_positions, positions

    sensors, options = [view.sensor for view in match_scene.views], RunConfig().orientation
    xy, point = np.full((4, 2), SIDE / 2.0), np.arange(4)
    features = Features(xy, np.zeros((4, N_DESCRIPTOR_VALUES), np.int16))
    curves = epipolar_curves(Sightlines.of(sensors[0], xy, (0.0, 1.0)), sensors[1], (0.0, 1.0))
    for moved in (curves, curves.moved(np.zeros(2))):
        match_along_curves(moved, features.only(point), features, options.inlier_px, MAX_DESCRIPTOR_RATIO)
    seen = Observations(np.repeat([0, 1], 4), np.tile(point, 2), np.tile(xy, (2, 1)))
    ground = sensors[0].ground_from_image(xy, np.zeros(4))
    refine_ties(match_scene.views, seen, ground_jacobian(sensors, seen, ground), options)
    coefficients, one, found = np.ones((20, 4)), np.zeros(1), np.empty((1, 2))
    positions(coefficients, one, one, one, found)
    ground_positions(coefficients, np.ones((2, 10, 4)), found, one, np.ones(2), found)
    above = FrameModel((0.0, 0.0, 10.0), ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)), 10.0, (4.0, 4.0))
    above.image_from_ray(np.zeros((1, 3)))
    BrownDistortion().undistorted(xy)


def warm_costs_of_heights() -> None:
    """Run the kernels once that only tiles of more cells, views or products use than those of the tiny scene."""
    from zlocus.core.options import SemiGlobalOptions
    from zlocus.matching.height_lattice import HeightLattice
    from zlocus.matching.kernels.plane_fitting import plane_heights
    from zlocus.matching.kernels.prior_costs import CoarserCells, add_costs_beyond, add_costs_of_candidates
    from zlocus.matching.kernels.shared_records import VisibleHeights
    from zlocus.matching.occlusion import keep_enough_views
    from zlocus.matching.prior_costs import COST_BEYOND_TIES, COST_OF_CANDIDATES, misfit
    from zlocus.matching.semiglobal import aggregate
    from zlocus.products.hillshade import hillshade
    from zlocus.sensors.straighten_kernel import straighten

    shape = (8, 8)
    lattice = HeightLattice(0.0, 1.0, shape, 4, np.zeros((2, 2), np.int64), np.full((2, 2), 4, np.int64))
    cost, cells, low = np.zeros(lattice.size, np.uint8), np.zeros(shape, np.float32), np.zeros((3, *shape), np.int32)
    with_one = replace(SemiGlobalOptions(), predecessors=1)
    misfit(cost, lattice, aggregate(cost, lattice, np.full((4, *shape), 8, np.uint16), 1.0, with_one))
    add_costs_beyond(cost, lattice.layout, cells, cells, cells, COST_BEYOND_TIES)
    coarser = np.zeros((1, *shape), np.int32)
    add_costs_of_candidates(cost, lattice.layout, cells, coarser, CoarserCells(0, 0, 2), COST_OF_CANDIDATES)
    keep_enough_views(VisibleHeights(low, low, low))
    hillshade(cells, 1.0, 315.0, 45.0)
    plane_heights(np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(2), np.zeros(3), np.empty(1))
    line, taps = np.zeros(1, np.int64), np.zeros((1, 2), np.float32)
    straighten(np.zeros((2, 4), np.float32), line, taps, line, taps, np.empty((1, 2), np.float32))


def warm(group: str) -> None:
    """Run a group of kernels once: `orient` for the orientation, `match` for matching up to the heights of the finest
    level, `refine` for the stages after it and for those that read the matching costs.

    The last two take about as long, where `match` finds what `refine` has compiled already.
    """
    from unittest.mock import patch

    from zlocus.matching import tile
    from zlocus.matching.kernels.shared_records import VisibleHeights
    from zlocus.matching.kernels.spline import spline_coefficients
    from zlocus.matching.locus_windows import CurveSamples
    from zlocus.matching.subpixel import refine
    from zlocus.matching.tile_views import TileGrid, tile_views
    from zlocus.matching.view_pixels import PixelWindow, read_pixels

    gc.set_threshold(*GC_THRESHOLDS)
    scene, config = tiny_scene(), RunConfig()
    if group == "orient":
        warm_orientation(scene)
        warm_costs_of_heights()
        return
    if group == "match":
        without = replace(config, refine=replace(config.refine, rounds=0))
        tile.match_tile(scene, scene.overlap_window, without)
        return
    pixels = [read_pixels(view, PixelWindow(0, 0, SIDE, SIDE), scene.grey_scales[0]) for view in scene.views]
    shape, block = (SIDE, SIDE), config.pyramid.block
    cells = TileGrid(0, scene.transform(scene.overlap_window, 0), shape, block, 0.0, 1.0)
    views = tile_views(pixels, cells, (0.0, 16.0), 2)
    for view in pixels:
        spline_coefficients(view.pixels)
    CurveSamples(np.full((1, 2), SIDE // 2), np.zeros(1), 2, np.zeros((1, 25), np.float32)).windows(
        views, 0, slice(None)
    )
    low = np.zeros((2, *shape), np.int32)
    visible = VisibleHeights(low, low + np.int32(16), low)
    refine(views, views.pixels, np.full(shape, 8.0, np.float32), visible, 1.0, config.refine)
    # The costs themselves are what takes `match` longest.
    with patch("zlocus.matching.tile.cost_volume", noise_costs):
        tile.match_tile(scene, scene.overlap_window, config)


def noise_costs(*given: Any) -> NDArray[np.uint8]:
    """Costs of noise in the place of `cost_volume`, whose arguments it takes; the third is the lattice."""
    return np.asarray(np.random.default_rng(0).integers(0, 128, given[2].size), np.uint8)


def _leave_after_input() -> None:
    """End this process as soon as the process that started it has ended for any reason."""
    sys.stdin.buffer.read()
    os._exit(1)


def warm_for_another(group: str) -> None:
    """Run a group of kernels once, unless the starting process ends first, and end this process.

    An ordinary end would wait for the thread that reads the input, and fail.
    """
    threading.Thread(target=_leave_after_input, daemon=True).start()
    warm(group)
    os._exit(0)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        warm(sys.argv[1])
    else:
        with kernels_compiling(progress_for(sys.stderr)):
            pass
