"""Write rendered scenes: images as GeoTIFF with RPC tags or line scanner files, truth rasters, and `scene.json`."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.rpc import RPC

from zlocus.core.errors import OutputError
from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.rpc import RpcCoefficients
from zlocus.sensors.rpc_fit import RpcFit, fit_rpc
from zlocus.synthetic.acquisitions import acquisition_of, write_tags
from zlocus.synthetic.appearance import Changes, Moment, ground_in_view
from zlocus.synthetic.cameras import RectifiedScanner
from zlocus.synthetic.linescan import TrajectoryNoise, image_name, write_linescan_views, write_scene
from zlocus.synthetic.rectify import rectified
from zlocus.synthetic.render import Sun, expose, render, sunlit, visible_ground_points
from zlocus.synthetic.scenes import Exposure, SceneSpec, build_ground, exposures_of, steady
from zlocus.synthetic.sensor_errors import WavySatelliteCamera
from zlocus.synthetic.terrain import SyntheticGround
from zlocus.synthetic.truth import write_truth
from zlocus.synthetic.weather import weathered
from zlocus.synthetic.works import with_works, write_works

NOISE_STREAM = 9
HEIGHT_MARGIN_M = 20.0


@dataclass(frozen=True)
class RenderedScene:
    """The files of a rendered scene. images : by name of the view; inputs : the inputs for `zlocus dsm`."""

    folder: Path
    images: dict[str, Path]
    truth_dsm: Path
    truth_class: Path
    inputs: tuple[Path, ...]


def render_scene(
    spec: SceneSpec,
    folder: Path,
    progress: Callable[[str], None] = lambda step: None,
    noise: TrajectoryNoise | None = None,
) -> RenderedScene:
    """Render all views of a scene and write them, the truth and `scene.json` into a new folder.

    The folder appears only when it is complete. progress : called with a word before each step; noise : write cameras
    as line scanners in a `scene.yaml`, with trajectories of this noise; None: write RPCs.

    Raises
    ------
    OutputError
        The folder exists already, or cannot be written.
    ConfigError
        Line scanners are to be written, and the scene has none.
    """
    folder = Path(folder)
    with new_folder(folder) as part:
        _write_scene(spec, part, progress, noise)
    return scene_files(spec, folder, noise is not None)


def scene_files(spec: SceneSpec, folder: Path, is_linescan: bool) -> RenderedScene:
    """The files of a scene that `render_scene` has written. is_linescan : its cameras are line scanners."""
    images = {view.name: folder / image_name(view) for view in spec.views}
    inputs = (folder / "scene.yaml",) if is_linescan else tuple(images.values())
    return RenderedScene(folder, images, folder / "truth_dsm.tif", folder / "truth_class.tif", inputs)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder to write to; at the end of the block it is renamed to `folder`.

    After an exception the temporary folder is removed.

    Raises
    ------
    OutputError
        The folder exists already, or cannot be written.
    """
    if folder.exists():
        raise OutputError(f"`{folder}` exists already: name a new folder for the rendered scene, or remove it.")
    part = folder.with_name(folder.name + ".part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part
        part.rename(folder)
    except OSError as error:
        raise OutputError(f"The rendered scene cannot be written to `{folder}` ({error}): name another.") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write_scene(spec: SceneSpec, folder: Path, progress: Callable[[str], None], noise: TrajectoryNoise | None) -> None:
    exposures = exposures_of(spec)
    if noise is not None:
        write_scene(spec, write_linescan_views(spec, exposures, folder, noise), folder / "scene.yaml")
    progress("terrain")
    ground = build_ground(spec, exposures_of(steady(spec)))
    write_truth(spec, ground, exposures, folder)
    if spec.works_day is not None:
        write_truth(spec, with_works(ground, spec), exposures, folder, "_after")
        write_works(ground, spec, folder / "works.geojson")
    described = {}
    for index, (exposure, numbers) in enumerate(render_exposures(spec, ground, exposures, progress)):
        view = exposure.view
        fit = fit_exposure(spec, exposure) if noise is None else None
        write_image(folder / image_name(view), numbers, None if fit is None else fit.rpc)
        if spec.is_dated:
            write_tags(folder / image_name(view), acquisition_of(spec, exposure, index))
        described[view.name] = {
            "along": view.along_deg, "across": view.across_deg, "heading": view.heading_deg,
            "bias_row_col": [view.bias_row_px, view.bias_col_px],
            "rpc_fit_max_px": None if fit is None else fit.max_error_px,
        }  # fmt: skip
    low, high = ground.height_range
    text = {"crs": f"EPSG:{spec.epsg}", "gsd": spec.gsd_m, "seed": spec.seed, "kind": spec.kind, "camera": spec.camera,
            "size": spec.size, "zmin": low, "zmax": high, "views": described}  # fmt: skip
    (folder / "scene.json").write_text(json.dumps(text, indent=1) + "\n")


def render_exposures(
    spec: SceneSpec, ground: SyntheticGround, exposures: tuple[Exposure, ...], progress: Callable[[str], None]
) -> Iterator[tuple[Exposure, NDArray[np.integer]]]:
    """Yield each exposure and its rendered image (r, c); images of rectified scanners are resampled to level 1."""
    lit: dict[Sun, NDArray[np.bool_]] = {}
    later = ground if spec.works_day is None else with_works(ground, spec)
    for index, exposure in enumerate(exposures):
        view, taken = exposure.view, exposure.taken
        progress(view.name)
        seen = ground if spec.works_day is None or view.day < spec.works_day else later
        if spec.changes != Changes() or spec.trouble is not None:
            moment = Moment(view.along_deg, view.across_deg, view.day, index)
            seen = ground_in_view(seen, spec.changes, moment, spec.seed)
        if view.sun not in lit or spec.changes.cars_per_km or spec.works_day is not None:
            lit = {view.sun: sunlit(seen, view.sun)}
        radiance = render(seen, taken.sensor, taken.shape, view.sun, spec.samples, lit[view.sun])
        radiance = _through_weather(spec, exposure, seen, radiance)
        numbers = expose(radiance, view.optics, np.random.default_rng([spec.seed, NOISE_STREAM, index]), view.errors)
        if isinstance(exposure.sensor, RectifiedScanner):
            numbers = rectified(numbers, exposure.sensor, exposure.shape)
        yield exposure, numbers


def _through_weather(
    spec: SceneSpec, exposure: Exposure, ground: SyntheticGround, radiance: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The radiance (r, c) of an image through the weather of its day."""
    view = exposure.view
    if view.day >= len(spec.weather) or spec.weather[view.day].is_clear:
        return radiance
    sensor, (rows, cols) = exposure.taken.sensor, radiance.shape
    xy = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    shown = visible_ground_points(ground, sensor, xy)
    # A pixel beyond the height field shows nothing, so its weather does not matter.
    shown = np.where(np.isfinite(shown), shown, shown[np.isfinite(shown).all(axis=1)].mean(axis=0))
    low, high = (sensor.ground_from_image(xy[:1], np.array([z]))[0] for z in ground.height_range)
    to_sensor: FloatArray = (high - low)[:2] / (high - low)[2]
    azimuth, elevation = np.deg2rad(view.sun.azimuth_deg), np.deg2rad(view.sun.elevation_deg)
    to_sun = np.array([np.sin(azimuth), np.cos(azimuth)]) / np.tan(elevation)
    places = shown[:, :2].reshape(rows, cols, 2)
    return weathered(radiance, places, spec.weather[view.day], to_sensor, to_sun, (spec.seed, view.day))


def fit_exposure(spec: SceneSpec, exposure: Exposure) -> RpcFit:
    """The RPC fitted to the camera of an exposure without its waves, with the pointing error of its view added."""
    low, high = spec.height_range
    sensor = exposure.sensor.steady if isinstance(exposure.sensor, WavySatelliteCamera) else exposure.sensor
    fit = fit_rpc(sensor, exposure.shape, spec.crs, (low - HEIGHT_MARGIN_M, high + HEIGHT_MARGIN_M))
    view = exposure.view
    return RpcFit(fit.rpc.moved(column=view.bias_col_px, row=view.bias_row_px), fit.max_error_px)


def write_image(path: Path, numbers: NDArray[np.integer], rpc: RpcCoefficients | None) -> None:
    """Write an image (r, c) as GeoTIFF, with 0 as nodata.

    rpc : written as RPC tag, with (0, 0) at the centre of the first pixel; None: no tag.
    """
    tags = None if rpc is None else RPC(
        height_off=rpc.height_off, height_scale=rpc.height_scale, lat_off=rpc.lat_off, lat_scale=rpc.lat_scale,
        line_den_coeff=list(rpc.line_den), line_num_coeff=list(rpc.line_num), line_off=rpc.line_off,
        line_scale=rpc.line_scale, long_off=rpc.lon_off, long_scale=rpc.lon_scale, samp_den_coeff=list(rpc.samp_den),
        samp_num_coeff=list(rpc.samp_num), samp_off=rpc.samp_off, samp_scale=rpc.samp_scale,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            path, "w", driver="GTiff", height=numbers.shape[0], width=numbers.shape[1], count=1, dtype=numbers.dtype,
            nodata=0, compress="deflate", predictor=2, tiled=True, blockxsize=256, blockysize=256, rpcs=tags,
        ) as file:  # fmt: skip
            file.write(numbers, 1)
