"""Small analytic scenes, rendered through satellite cameras and written as images with RPC."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from pyproj import CRS

from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.progress import progress_for
from zlocus.core.requests import DsmRequest
from zlocus.pipeline.dsm import DsmResult, run_dsm
from zlocus.sensors.earth_frame import FRAME_SPACE
from zlocus.sensors.linescan import FocalLine, LineScanModel, LineTimes
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.files import write_image
from zlocus.synthetic.linescan import NADIR_COLUMN, SPEED_M_S, focal_line, sampled_trajectory
from zlocus.synthetic.render import Optics, Sun, expose, render
from zlocus.synthetic.scenes import Exposure
from zlocus.synthetic.terrain import analytic_ground, analytic_height

CENTRE = (462_000.0, 5_247_000.0)
UTM = CRS.from_epsg(32632)
GSD_M = 0.5
HEIGHTS = (25.0, 80.0)
SIZE_PX = 150
FIELD = (640, 640)
# Forward and across view angles, degrees.
LOOKS = {"nadir": (1.0, -3.0), "fore": (18.0, 2.0), "aft": (-17.0, 4.0)}
QUIET = Optics(noise=0.003, noise_floor=1.0)
# Four tiles of the area that the rendered images see.
SMALL_TILES = RunConfig(pyramid=PyramidOptions(tile=80))
N_SMALL_TILES = 4
# A part of the area that all images see.
PART = (CENTRE[0] - 12.0, CENTRE[1] - 10.0, CENTRE[0] + 14.0, CENTRE[1] + 9.0)
# An error that counts as a wrong match.
BLUNDER_M = 0.5


@dataclass(frozen=True)
class RenderedImages:
    """paths : by name of the view."""

    kind: str
    paths: dict[str, Path]

    @property
    def inputs(self) -> tuple[Path, ...]:
        return tuple(self.paths.values())


def line_scanner(exposure: Exposure) -> LineScanModel:
    """The sensor model of a rendered line scanner's raw image, straight from its exact camera."""
    raw, first = exposure.taken, int(NADIR_COLUMN - exposure.taken.sensor.centre[0])
    line = focal_line(raw.sensor)
    line = FocalLine(line.xy_mm[first : first + raw.shape[1]], line.focal_mm)
    times = LineTimes.regular(0.0, -raw.sensor.advance_m / SPEED_M_S, raw.shape[0])
    return LineScanModel(line, times, sampled_trajectory(raw.sensor, raw.shape[0]), FRAME_SPACE)


def camera(name: str, size: int = SIZE_PX) -> SatelliteCamera:
    """The exact camera of a view; its image is centred on the scene at height 50 m."""
    along, across = LOOKS[name]
    return SatelliteCamera((*CENTRE, 50.0), ((size - 1) / 2, (size - 1) / 2), GSD_M, along, across, 3.0)


def rendered(folder: Path, kind: str, errors: dict[str, tuple[float, float]] | None = None) -> RenderedImages:
    """Images of an analytic ground. errors : pointing error (column, row) px put into the RPC of a view."""
    folder.mkdir(parents=True, exist_ok=True)
    ground = analytic_ground(kind, CENTRE, GSD_M / 2, FIELD, seed=5)
    paths = {}
    for index, name in enumerate(LOOKS):
        sensor, shape = camera(name), (SIZE_PX - 3 * index, SIZE_PX)
        radiance = render(ground, sensor, shape, Sun(150.0, 50.0))
        numbers = expose(radiance, QUIET, np.random.default_rng([3, index]))
        column, row = (errors or {}).get(name, (0.0, 0.0))
        rpc = fit_rpc(sensor, shape, UTM, (0.0, 120.0)).rpc.moved(column=column, row=row)
        paths[name] = folder / f"{name}.tif"
        write_image(paths[name], numbers, rpc)
    return RenderedImages(kind, paths)


def rendered_in_colours(folder: Path, dtype: str) -> tuple[Path, ...]:
    """Three images of a plane with red, green and blue, each band another multiple of the grey value."""
    ground, paths = analytic_ground("plane", CENTRE, GSD_M / 2, FIELD, seed=5), []
    for name in ("nadir", "fore", "aft"):
        radiance = render(ground, camera(name), (SIZE_PX, SIZE_PX), Sun(150.0, 50.0))
        grey = np.rint(100 * radiance / radiance.mean()).astype(dtype)
        paths.append(folder / f"{name}.tif")
        write_image(paths[-1], grey, fit_rpc(camera(name), grey.shape, UTM, (0.0, 120.0)).rpc)
        with rasterio.open(paths[-1]) as source:
            profile, rpcs = source.profile, source.rpcs
        with rasterio.open(paths[-1], "w", **profile | {"count": 3, "photometric": "RGB"}, rpcs=rpcs) as file:
            file.write(np.stack([grey, grey // 2, 255 - grey]))
    return tuple(paths)


def run(images: RenderedImages | tuple[Path, ...], out: Path, config: RunConfig | None = None, **request) -> DsmResult:
    """A surface of these images at 0.5 m in UTM, with the heights given and without a report, unless a request asks."""
    inputs = images.inputs if isinstance(images, RenderedImages) else images
    asked = {"crs": "EPSG:32632", "resolution": GSD_M, "heights": HEIGHTS, "report": False} | request
    if "like" in asked:
        asked["crs"] = asked["resolution"] = None
    return run_dsm(DsmRequest(inputs=inputs, out=out, **asked), config or RunConfig(), progress_for(io.StringIO()))


def read(path: Path) -> tuple[np.ndarray, rasterio.DatasetReader]:
    """The first band of a raster and its (closed) dataset."""
    with rasterio.open(path) as source:
        return source.read(1), source


def truth_at(kind: str, source: rasterio.DatasetReader, moved: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """True height at the cell centres of a raster, (r, c) m; `moved` metres east and north of them."""
    col, row = np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5)
    x, y = source.transform * (col, row)
    return analytic_height(kind, x - CENTRE[0] + moved[0], y - CENTRE[1] + moved[1])


def well_seen(source: rasterio.DatasetReader, truth: np.ndarray, margin_px: float = 8.0) -> np.ndarray:
    """Cells of a raster whose true surface point falls inside every image, `margin_px` from its border, (r, c) bool."""
    col, row = np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5)
    x, y = source.transform * (col, row)
    xyz = np.column_stack([x.ravel(), y.ravel(), truth.ravel()])
    inside = np.ones(len(xyz), bool)
    for index, name in enumerate(LOOKS):
        last = np.array([SIZE_PX, SIZE_PX - 3 * index]) - 1 - margin_px
        xy = camera(name).image_from_ground(xyz)
        inside &= ((xy > margin_px) & (xy < last)).all(axis=1)
    return inside.reshape(truth.shape)


def errors_of(out, kind):
    """Height errors where all images see the surface, m; NaN where there is no height."""
    height, source = read(out / "dsm.tif")
    truth = truth_at(kind, source)
    error = height - truth
    seen = well_seen(source, truth)
    assert seen.sum() > 50
    return error, seen
