"""The rasters of a finished surface as one xarray Dataset, with the CRS, units and the origin of the heights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.scene import is_local
from zlocus.io.run_folder import RECORD, check_surface
from zlocus.io.run_record import read_record
from zlocus.matching.quality import Quality
from zlocus.products.rasters import WaterKind

if TYPE_CHECKING:
    import xarray as xr

# Names in the Dataset, with the file, the long name and the unit of each.
VARIABLES = {
    "height": ("dsm.tif", "height of the surface at the cell's centre", "m"),
    "sigma": ("sigma.tif", "standard deviation of the height", "m"),
    "quality": ("quality.tif", "reasons why a height is missing or doubtful", "1"),
    "views": ("views.tif", "number of images used", "1"),
    "ortho": ("ortho.tif", "grey value or colours of the view that shows the cell best", "1"),
    "water": ("water.tif", "water surface, levelled or possible", "1"),
}
COLOURS = ("red", "green", "blue")
# Entries of run.json that are used.
NEEDED = ("config", "versions", "grid", "vertical", "coverage")


def check_xarray() -> None:
    """Raise an error where xarray or rioxarray is not installed.

    Raises
    ------
    InputError
        One of them is not installed.
    """
    try:
        for name in ("xarray", "rioxarray"):
            import_module(name)
    except ImportError as error:
        raise InputError(
            f"{error.name} is not installed. Install what is needed with `pip install xarray rioxarray`."
        ) from error


def surface_dataset(folder: Path, keeps_folder: bool = True) -> xr.Dataset:
    """The surface in a folder as a Dataset, whose cells are read when they are needed.

    keeps_folder : whether the folder stays, so that the attributes name it.

    Raises
    ------
    InputError
        The folder holds no surface, or xarray and rioxarray are not installed.
    """
    check_xarray()
    check_surface(folder)
    import xarray as xr

    run = read_record(folder / RECORD)
    if absent := [key for key in NEEDED if key not in run]:
        raise InputError(f"{folder / RECORD} lacks {', '.join(absent)}: it is damaged. Make the surface again.")
    found = {name: _variable(folder, name) for name in VARIABLES}
    vertical = _datum_name(run)
    found["height"].attrs |= {"vertical_datum": vertical, "positive": "up"}
    if not _is_local(run):
        found["height"].attrs["standard_name"] = (
            "height_above_reference_ellipsoid" if vertical == "ellipsoid" else "height_above_geopotential_datum"
        )
    flags = [flag for flag in Quality if flag.name]
    found["quality"].attrs |= {
        "flag_masks": [int(flag) for flag in flags],
        "flag_meanings": " ".join(str(flag.name) for flag in flags),
    }
    found["water"].attrs |= {
        "flag_values": [int(kind) for kind in WaterKind],
        "flag_meanings": " ".join(kind.name for kind in WaterKind),
    }
    surface = xr.Dataset(found, attrs=_attributes(folder if keeps_folder else None, run))
    for axis in ("x", "y"):
        surface[axis].attrs = _attributes_of_axis(axis, run)
    return surface


def _variable(folder: Path, name: str) -> xr.DataArray:
    """A raster of the surface, over y and x; the ortho-image of colour images also over band."""
    import rioxarray
    import xarray as xr

    file, long_name, unit = VARIABLES[name]
    raster = rioxarray.open_rasterio(folder / file)
    assert isinstance(raster, xr.DataArray)
    nodata = 0 if name == "ortho" else raster.rio.nodata  # its mask in the file is not read
    if raster.sizes["band"] == 1:
        raster = raster.squeeze("band", drop=True)
    else:
        raster = raster.assign_coords(band=list(COLOURS))
    raster.attrs = {"long_name": long_name, "units": unit}
    return raster if nodata is None else raster.rio.write_nodata(nodata)


def _attributes(folder: Path | None, run: Mapping[str, Any]) -> dict[str, Any]:
    """Where the surface comes from: texts and numbers only, which every format can hold."""
    config, grid = run["config"], run["grid"]
    text = json.dumps(config, sort_keys=True)
    attributes: dict[str, Any] = {
        "title": "digital surface model",
        "source": f"zlocus {run['versions']['zlocus']}",
        "created": run.get("created") or "",
        "method": config["request"]["method"],
        "selection": config["request"]["selection"],
        "crs": grid["crs"],
        "horizontal_units": "m",
        "vertical_datum": _datum_name(run),
        "resolution_m": float(grid["transform"][0]),
        "coverage": run["coverage"],
        "source_images": "\n".join(str(path) for path in config["request"]["inputs"]),
        "config": text,
        "options_sha256": hashlib.sha256(json.dumps(config["options"], sort_keys=True).encode()).hexdigest(),
    }
    if code := run["vertical"].get("crs"):
        attributes["vertical_crs"] = code
    if folder is not None:
        attributes["run"] = str(folder.resolve())
    return attributes


def _attributes_of_axis(axis: str, run: Mapping[str, Any]) -> dict[str, str]:
    """Name and unit of a coordinate, by the conventions of CF."""
    attributes = {"axis": axis.upper(), "long_name": f"{axis} of the cell's centre", "units": "m"}
    return attributes if _is_local(run) else attributes | {"standard_name": f"projection_{axis}_coordinate"}


def _datum_name(run: Mapping[str, Any]) -> str:
    """The vertical datum of the heights: "ellipsoid", "EGM96 geoid", "local frame"."""
    return "local frame" if _is_local(run) else str(run["vertical"]["heights_above"]).removeprefix("the ")


def _is_local(run: Mapping[str, Any]) -> bool:
    return is_local(CRS.from_user_input(run["grid"]["crs"]))
