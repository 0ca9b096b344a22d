"""Rendered scenes on disk: images as GeoTIFF with RPC tags or line scanner files, truth rasters, and `scene.json`."""

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
from zlocus.sensors.rpc import RpcCoefficients
from zlocus.sensors.rpc_fit import RpcFit, fit_rpc
from zlocus.synthetic.cameras import RectifiedScanner
from zlocus.synthetic.linescan import TrajectoryNoise, image_name, write_linescan_views, write_scene
from zlocus.synthetic.rectify import rectified
from zlocus.synthetic.render import Sun, expose, render, sunlit
from zlocus.synthetic.scenes import Exposure, SceneSpec, build_ground, exposures, steady
from zlocus.synthetic.terrain import SyntheticGround
from zlocus.synthetic.truth import write_truth

NOISE_STREAM = 9
HEIGHT_MARGIN_M = 20.0


@dataclass(frozen=True)
class RenderedScene:
    """Where a scene was written. images : by name of the view; inputs : what `zlocus dsm` takes."""

    folder: Path
    images: dict[str, Path]
    truth_dsm: Path
    truth_class: Path
    inputs: tuple[Path, ...]


def render_scene(
    spec: SceneSpec,
    folder: Path,
    progress: Callable[[str], None] = lambda step: None,
    linescan: TrajectoryNoise | None = None,
) -> RenderedScene:
    """Renders all views of `spec` and writes them, the truth and `scene.json` into a new folder.

    progress : called with a word before each step; linescan : cameras are written as line scanners with trajectories of
    this noise, under a `scene.yaml`, not as RPC. The folder appears only when it is complete.

    Raises
    ------
    OutputError
        Where the folder exists already, or cannot be written.
    ConfigError
        For line scanners of a scene that has none.
    """
    folder = Path(folder)
    with new_folder(folder) as part:
        _write_scene(spec, part, progress, linescan)
    return scene_files(spec, folder, linescan is not None)


def scene_files(spec: SceneSpec, folder: Path, is_linescan: bool) -> RenderedScene:
    """The files of a scene that `render_scene` wrote. is_linescan : cameras were written as line scanners."""
    images = {view.name: folder / image_name(view) for view in spec.views}
    inputs = (folder / "scene.yaml",) if is_linescan else tuple(images.values())
    return RenderedScene(folder, images, folder / "truth_dsm.tif", folder / "truth_class.tif", inputs)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder to write to, which gets its name when all went well.

    Raises
    ------
    OutputError
        Where the folder exists already, or cannot be written.
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


def _write_scene(
    spec: SceneSpec, folder: Path, progress: Callable[[str], None], linescan: TrajectoryNoise | None
) -> None:
    seen_by = exposures(spec)
    if linescan is not None:
        write_scene(spec, write_linescan_views(spec, seen_by, folder, linescan), folder / "scene.yaml")
    progress("terrain")
    ground = build_ground(spec, exposures(steady(spec)))
    write_truth(spec, ground, seen_by, folder)
    described = {}
    for exposure, numbers in exposed(spec, ground, seen_by, progress):
        view = exposure.view
        fit = fit_exposure(spec, exposure) if linescan is None else None
        write_image(folder / image_name(view), numbers, None if fit is None else fit.rpc)
        described[view.name] = {
            "along": view.along_deg, "across": view.across_deg, "heading": view.heading_deg,
            "bias_row_col": [view.bias_row_px, view.bias_col_px],
            "rpc_fit_max_px": None if fit is None else fit.max_error_px,
        }  # fmt: skip
    low, high = ground.height_range
    text = {"crs": f"EPSG:{spec.epsg}", "gsd": spec.gsd_m, "seed": spec.seed, "kind": spec.kind, "camera": spec.camera,
            "size": spec.size, "zmin": low, "zmax": high, "views": described}  # fmt: skip
    (folder / "scene.json").write_text(json.dumps(text, indent=1) + "\n")


def exposed(
    spec: SceneSpec, ground: SyntheticGround, seen_by: tuple[Exposure, ...], progress: Callable[[str], None]
) -> Iterator[tuple[Exposure, NDArray[np.integer]]]:
    """Exposures and their images (r, c), one after the other; level 1 where they are rectified."""
    lit: dict[Sun, NDArray[np.bool_]] = {}
    for index, exposure in enumerate(seen_by):
        view, taken = exposure.view, exposure.taken
        progress(view.name)
        if view.sun not in lit:
            lit = {view.sun: sunlit(ground, view.sun)}
        radiance = render(ground, taken.camera, taken.shape, view.sun, spec.samples, lit[view.sun])
        numbers = expose(radiance, view.optics, np.random.default_rng([spec.seed, NOISE_STREAM, index]))
        if isinstance(exposure.camera, RectifiedScanner):
            numbers = rectified(numbers, exposure.camera, exposure.shape)
        yield exposure, numbers


def fit_exposure(spec: SceneSpec, exposure: Exposure) -> RpcFit:
    """The RPC of an exposure, with the pointing error of its view put in."""
    low, high = spec.height_range
    fit = fit_rpc(exposure.camera, exposure.shape, spec.crs, (low - HEIGHT_MARGIN_M, high + HEIGHT_MARGIN_M))
    view = exposure.view
    return RpcFit(fit.rpc.moved(column=view.bias_col_px, row=view.bias_row_px), fit.max_error_px)


def write_image(path: Path, numbers: NDArray[np.integer], rpc: RpcCoefficients | None) -> None:
    """A single-band GeoTIFF with RPC tags, if any: (0, 0) is the centre of the first pixel, 0 is nodata.

    numbers : (r, c).
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
