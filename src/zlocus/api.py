"""The Python interface: a surface as one Dataset, and single stages on arrays.

    >>> import zlocus
    >>> surface = zlocus.match("img_1.tif", "img_2.tif", "img_3.tif", resolution=0.5)
    >>> surface.height.rio.to_raster("dsm.tif")

Needs xarray and rioxarray: `pip install '.[xarray]'` in the clone.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pyproj import CRS

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.progress import Progress, SilentProgress
from zlocus.core.requests import DsmRequest
from zlocus.core.scene import Scene
from zlocus.io import scene_file
from zlocus.matching.array_stages import LocusStack, locus_stack, ncc_cost, semiglobal, true_ortho
from zlocus.matching.quality import Quality
from zlocus.orientation.orientation import Orientation
from zlocus.pipeline.setup import orient_views, requested_crs

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "LocusStack", "locus_stack", "match", "ncc_cost", "open_scene", "open_surface", "orient", "semiglobal",
    "true_ortho",
]  # fmt: skip
PathLikes = str | PathLike[str]
# Names in the Dataset, with the file and the long name of each.
VARIABLES = {
    "height": ("dsm.tif", "height of the surface at the cell's centre"),
    "sigma": ("sigma.tif", "standard deviation of the height"),
    "quality": ("quality.tif", "reasons why a height is missing or doubtful"),
    "views": ("views.tif", "images used"),
    "ortho": ("ortho.tif", "grey value or colours of the view that shows the cell best"),
}
COLOURS = ("red", "green", "blue")


def open_scene(*inputs: PathLikes, crs: str | CRS | None = None) -> Scene:
    """Open images with their cameras in one frame.

    inputs : two images or more with RPC, or one `scene.yaml`. crs : of the frame, projected in metres; by default the
    CRS of the file, else the WGS84 UTM zone of the scene's centre.

    Raises
    ------
    InputError, ConfigError
        See `zlocus.io.scene_file.open_scene`.
    """
    requested = crs if crs is None or isinstance(crs, CRS) else requested_crs(crs)
    return scene_file.open_scene([Path(path) for path in inputs], requested)


def orient(
    scene: Scene,
    options: OrientationOptions | None = None,
    *,
    heights: tuple[float, float] | None = None,
    progress: Progress | None = None,
) -> Orientation:
    """Find tie points and correct the cameras.

    `orientation.apply(scene)` is the corrected scene, `orientation.xyz` are the tie points (n, 3) m. heights : (zmin,
    zmax) m above the ellipsoid, between which tie points are searched; None: all heights that the cameras allow.

    Raises
    ------
    GeometryError
        The images overlap too little, or their pointing is worse than can be corrected.
    """
    scene = replace(scene, heights=heights or scene.heights)
    return orient_views(scene, options or OrientationOptions(), progress or SilentProgress())


def match(
    *inputs: PathLikes,
    out: PathLikes | None = None,
    config: RunConfig | None = None,
    progress: Progress | None = None,
    **request: Any,
) -> xr.Dataset:
    """Make the surface of a scene as `zlocus dsm` does, and return it as a Dataset (see `open_surface`).

    inputs : two images or more with RPC, or one `scene.yaml`. out : folder for the products, from which
    values are read when they are needed; None: no files are kept, and the Dataset is in memory. Where the folder holds
    the same finished surface already, it is opened; another run is refused unless `overwrite=True` is given. request :
    fields of `zlocus.core.requests.DsmRequest`, such as resolution, bounds, heights, workers; those that name files
    take paths.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError, StoppedError, CoverageError
        As `zlocus dsm`. OutputError: `out` holds another run. CoverageError: too few cells have a height; the
        products are in `out`.
    """
    from zlocus.pipeline.dsm import run_dsm

    known = {field for field in DsmRequest.__dataclass_fields__ if field not in ("inputs", "out")}
    if unknown := sorted(set(request) - known):
        raise ConfigError(f"match() does not know {', '.join(unknown)}. Known are {', '.join(sorted(known))}.")
    for name in ("like", "area", "mask", "dem"):
        if request.get(name) is not None:
            request[name] = Path(request[name])
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "surface" if out is None else Path(out)
        if out is None:  # nobody would see maps and report
            request = {"products": (), "report": False} | request
        dsm_request = DsmRequest(inputs=tuple(Path(path) for path in inputs), out=folder, **request)
        run_dsm(dsm_request, config or RunConfig(), progress or SilentProgress())
        surface = open_surface(folder)
        return surface.load() if out is None else surface


def open_surface(folder: PathLikes) -> xr.Dataset:
    """Open the result of `zlocus dsm` in a folder as a Dataset.

    Its variables are height and sigma (m), quality (bit flags), views and ortho, over y and x; the ortho-image of
    colour images also over band (red, green, blue). A missing height is NaN. `zlocus.matching.quality.Quality` names
    the flags. Cells are read when they are needed. `surface.rio.crs` is the CRS.

    Raises
    ------
    InputError
        The folder holds no such result, or xarray and rioxarray are not installed.
    """
    try:
        import rioxarray
        import xarray as xr
    except ImportError as error:
        raise InputError(
            f"{error.name} is not installed. Install it with pip, or all that is needed with `pip install '.[xarray]'` "
            "in the clone of zlocus."
        ) from error
    folder = Path(folder)
    found = {}
    for name, (file, long_name) in VARIABLES.items():
        if not (folder / file).is_file():
            raise InputError(f"{folder} holds no {file}. Give the folder that a finished `zlocus dsm` wrote.")
        raster = rioxarray.open_rasterio(folder / file)
        assert isinstance(raster, xr.DataArray)
        nodata = raster.rio.nodata
        if raster.sizes["band"] == 1:
            raster = raster.squeeze("band", drop=True)
        else:
            raster = raster.assign_coords(band=list(COLOURS))
        raster.attrs = {"long_name": long_name, **({"units": "m"} if name in ("height", "sigma") else {})}
        found[name] = raster if nodata is None else raster.rio.write_nodata(nodata)
    flags = [flag for flag in Quality if flag.name]
    found["quality"].attrs |= {
        "flag_masks": [int(flag) for flag in flags],
        "flag_meanings": " ".join(str(flag.name) for flag in flags),
    }
    return xr.Dataset(found)
