"""The Python interface: a surface as one Dataset, and single stages on arrays.

    >>> import zlocus
    >>> surface = zlocus.match("img_1.tif", "img_2.tif", "img_3.tif", resolution=0.5)
    >>> surface.height.rio.to_raster("dsm.tif")

Needs xarray and rioxarray: `pip install xarray rioxarray`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pyproj import CRS

from zlocus.core import argument_checks as arguments
from zlocus.core import request_checks
from zlocus.core.argument_checks import path_or_none
from zlocus.core.notebook_progress import progress_of
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import DEFAULT_PRODUCTS, DsmRequest
from zlocus.core.scene import Scene
from zlocus.evaluation.arrays import evaluate
from zlocus.io import config as config_file
from zlocus.io import scene_file
from zlocus.matching.array_stages import SCENE_ADVICE, LocusStack, locus_stack, ncc_cost, semiglobal, true_ortho
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.ties import Ties
from zlocus.pipeline.setup import orient_views, requested_crs, ties_of_views
from zlocus.products.surface_dataset import check_xarray, surface_dataset

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "LocusStack", "evaluate", "find_ties", "locus_stack", "match", "ncc_cost", "open_scene", "open_surface", "orient",
    "read_config", "semiglobal", "true_ortho",
]  # fmt: skip
PathLikes = str | PathLike[str]


def open_scene(*inputs: PathLikes, crs: str | CRS | None = None) -> Scene:
    """Open images with their cameras in one frame.

    inputs : two images or more with RPC, or one `scene.yaml`. crs : of the frame, projected in metres; by default the
    CRS of the file, else the WGS84 UTM zone of the scene's centre.

    Raises
    ------
    InputError, ConfigError
        See `zlocus.io.scene_file.open_scene`. InputError: an input is no path.
    """
    paths = arguments.input_paths("zlocus.open_scene", inputs)
    return scene_file.open_scene(list(paths), requested_crs(arguments.crs_or_none(crs)))


def find_ties(
    scene: Scene,
    options: OrientationOptions | None = None,
    *,
    heights: tuple[float, float] | None = None,
    progress: Progress | bool | None = None,
) -> Ties:
    """Find tie points between the images of a scene: the first step of `orient`, which also refines and uses them.

    heights, progress : as of `orient`. In the result, `observations.xy` (m, 2) are the positions of image points, px,
    `observations.view` (m,) the numbers of their images, `observations.point` (m,) those of their ties, and `z` (n,)
    the first heights of the ties, m above the ellipsoid.

    Raises
    ------
    GeometryError
        The images overlap too little.
    """
    scene, options = _checked_scene(scene, heights), _checked_orientation_options(options)
    return ties_of_views(scene, options, progress_of(progress))


def orient(
    scene: Scene,
    options: OrientationOptions | None = None,
    *,
    heights: tuple[float, float] | None = None,
    progress: Progress | bool | None = None,
) -> Orientation:
    """Find tie points and correct the cameras.

    `orientation.apply(scene)` is the corrected scene, `orientation.xyz` are the tie points (n, 3) m. heights : (zmin,
    zmax) m above the ellipsoid, between which tie points are searched; None: all heights that the cameras allow.
    progress : as of `match`.

    Raises
    ------
    GeometryError
        The images overlap too little, or their pointing is worse than can be corrected.
    """
    scene, options = _checked_scene(scene, heights), _checked_orientation_options(options)
    return orient_views(scene, options, progress_of(progress))


def match(
    *inputs: PathLikes, out: PathLikes | None = None, resolution: float | None = None, crs: str | CRS | None = None,
    bounds: tuple[float, float, float, float] | None = None, like: PathLikes | None = None,
    area: PathLikes | None = None, mask: PathLikes | None = None, heights: tuple[float, float] | None = None,
    dem: PathLikes | None = None, dem_vertical: PathLikes | None = None, reference: str | None = None,
    views: str = "auto", method: str = "mvll-sgm", selection: str = "default", vertical: PathLikes = "ellipsoid",
    fill: str = "none", water: PathLikes | None = None, water_level: str | None = None, level_water: bool = False,
    partial: bool = False, workers: int | None = None, scheduler: str | None = None,
    memory_gb: float | None = None, overwrite: bool = False, resume: bool = True,
    products: Sequence[str] = DEFAULT_PRODUCTS, report: bool = True, config: RunConfig | None = None,
    progress: Progress | bool | None = None,
) -> xr.Dataset:  # fmt: skip
    """Make the surface of a scene as `zlocus dsm` does, and return it as a Dataset (see `open_surface`).

    inputs : two images or more with RPC, or one `scene.yaml`. out : folder for the products, from which
    values are read when they are needed; None: no files are kept, and the Dataset is in memory. Where the folder holds
    the same finished surface already, it is opened; another run is refused unless `overwrite=True` is given. config :
    options of the stages. progress : None shows the progress in a notebook only, True also in a script, False nowhere;
    or a progress of your own. products, report : made with `out` only. All others are the fields of
    `zlocus.core.requests.DsmRequest`, which are the options of `zlocus dsm`.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError, StoppedError, CoverageError
        As `zlocus dsm`. InputError: xarray is not installed, or an input is no path. OutputError: `out` holds another
        run. CoverageError: too few cells have a height; the products are in `out`.
    """
    check_xarray()
    request = DsmRequest(
        inputs=arguments.input_paths("zlocus.match", inputs), out=path_or_none("out", out, "folder") or Path(),
        resolution=arguments.number_or_none("resolution", resolution), crs=arguments.crs_or_none(crs),
        bounds=arguments.bounds_or_none(bounds), like=path_or_none("like", like, "raster"),
        area=path_or_none("area", area, "file of polygons"), mask=path_or_none("mask", mask, "file of polygons"),
        heights=arguments.heights_or_none(heights), dem=path_or_none("dem", dem, "raster"),
        dem_vertical=arguments.text_or_none("dem_vertical", dem_vertical),
        reference=arguments.text_or_none("reference", reference), views=arguments.text_of("views", views),
        method=arguments.text_of("method", method), selection=arguments.text_of("selection", selection),
        vertical=arguments.text_of("vertical", vertical), fill=arguments.text_of("fill", fill),
        water=path_or_none("water", water, "file of polygons"),
        water_level=arguments.text_or_none("water_level", water_level),
        level_water=arguments.flag_of("level_water", level_water),
        partial=arguments.flag_of("partial", partial), workers=arguments.count_or_none("workers", workers),
        scheduler=arguments.text_or_none("scheduler", scheduler),
        memory_gb=arguments.number_or_none("memory_gb", memory_gb), overwrite=arguments.flag_of("overwrite", overwrite),
        resume=arguments.flag_of("resume", resume), products=arguments.names_of("products", products),
        report=arguments.flag_of("report", report),
    )  # fmt: skip
    return _matched(request, out is not None, _checked_config(config), progress_of(progress))


def open_surface(folder: PathLikes) -> xr.Dataset:
    """Open the result of `zlocus dsm` in a folder as a Dataset. `zlocus.open` is the same function.

    Its variables are height and sigma (m), quality (bit flags), views, ortho and water, over y and x; the ortho-image
    of colour images also over band (red, green, blue). A missing height is NaN. `zlocus.Quality` names the flags. Cells
    are read when they are needed. `surface.rio.crs` is the CRS. `surface.attrs` says what the surface is: crs,
    vertical_datum, resolution_m, method, source_images (one path a line), config (the request and all options, as
    JSON), options_sha256, source (the version), created, and run (the folder).

    Raises
    ------
    InputError
        The folder holds no surface, and what it holds instead; or xarray and rioxarray are not installed.
    """
    return surface_dataset(arguments.path_of("folder", folder, "folder that `zlocus dsm` wrote"))


# Short as `zlocus.open(OUT)`. It is handed out by the package as an attribute; no module here calls it by this name.
open = open_surface


def read_config(file: PathLikes) -> RunConfig:
    """Options of all stages from a file that `zlocus config` wrote, in TOML or YAML.

    Raises
    ------
    ConfigError
        The file cannot be read, or holds an option that is not known or out of range.
    """
    return config_file.read_config(arguments.path_of("file", file, "configuration file"))


def _matched(request: DsmRequest, keeps: bool, config: RunConfig, progress: Progress) -> xr.Dataset:
    """The surface of a request, which is only in memory unless its folder is kept."""
    from zlocus.pipeline.dsm import run_dsm

    if keeps:
        run_dsm(request, config, progress)
        return surface_dataset(request.out)
    with tempfile.TemporaryDirectory() as scratch:
        # Nobody would see maps and report.
        request = replace(request, out=Path(scratch) / "surface", products=(), report=False)
        run_dsm(request, config, progress)
        return surface_dataset(request.out, keeps_folder=False).load()


def _checked_scene(scene: Any, heights: Any) -> Scene:
    """The scene, with the heights that are given or its own."""
    given = arguments.heights_or_none(heights)
    request_checks.check_heights(given)
    checked = arguments.instance_of("scene", scene, Scene, SCENE_ADVICE)
    return replace(checked, heights=given or checked.heights)


def _checked_orientation_options(options: Any) -> OrientationOptions:
    advice = "Give zlocus.OrientationOptions(...)."
    return (
        OrientationOptions()
        if options is None
        else arguments.instance_of("options", options, OrientationOptions, advice)
    )


def _checked_config(config: Any) -> RunConfig:
    advice = "Give zlocus.RunConfig(...), or zlocus.read_config(FILE)."
    return RunConfig() if config is None else arguments.instance_of("config", config, RunConfig, advice)
