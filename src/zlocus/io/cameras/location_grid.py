"""The `location_grid` camera of a `scene.yaml`: a GeoTIFF of ground coordinates, as shareloc and CARS read it.

Two bands for each height hold the coordinates of the nodes, a third one may say which nodes count. Tags say the heights
(`ALTITUDE_B0`), the CRS (`REF`) and the meaning of each band (`FIELD_B0`); all may begin with `LG_`. The transform of
the file says to which pixels the nodes belong. There the centre of the first pixel is (0.5, 0.5), here (0, 0). See
docs/reference/location_grid.md.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.quoting import counted, quoted
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.io.cameras.camera_entry import CameraEntry
from zlocus.io.crs import file_crs
from zlocus.io.open_raster import check_complete, open_raster
from zlocus.io.safe_text import EXPORT_AGAIN, decimal
from zlocus.io.schema import FiniteNumber
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.earth_frame import WGS84
from zlocus.sensors.location_grid import LocationGrid, LocationGridModel

Pair = tuple[FiniteNumber, FiniteNumber]
TAG = re.compile(r"(?:LG_)?(ALTITUDE|FIELD)_B(\d+)")
CRS_TAGS = ("LG_REF", "REF")
# Where GDAL keeps the tags of the program that wrote the file; None: where tags usually are.
DOMAINS = (None, "GTiff")
FIELDS = {"lon": 0, "x": 0, "lat": 1, "y": 1, "status": 2}
# A grid of more nodes is an image that was named by mistake.
MAX_NODES = 20_000_000
# An image may end this far outside of the nodes, because some grids begin at corners of pixels and some at centres.
MAX_OUTSIDE_PX = 1.0
LARGEST_HEIGHT_M = 1e5


class LocationGridCamera(CameraEntry):
    """A table of ground coordinates at some heights, of the image or of the larger one that it was cut from.

    file : the GeoTIFF; first_pixel : (column, row), in the image of the grid, of this image's first pixel; shift :
    (column, row) px added to the positions. The others replace what the file says: heights : m above the ellipsoid, one
    for each pair of bands; crs : of the coordinates; first_node, step : (column, row) px of the first node, where (0,
    0) is the centre of the first pixel, and from node to node.
    """

    kind: Literal["location_grid"] = "location_grid"
    file: str
    first_pixel: Pair = (0.0, 0.0)
    shift: Pair | None = None
    heights: tuple[FiniteNumber, ...] | None = Field(default=None, min_length=2)
    crs: str | None = None
    first_node: Pair | None = None
    step: Pair | None = None

    @model_validator(mode="after")
    def _usable(self) -> LocationGridCamera:
        if self.step is not None and min(self.step) <= 0:
            raise ValueError("step is the distance of nodes in pixels, (column, row), and larger than 0")
        if (self.first_node is None) != (self.step is None):
            raise ValueError("first_node and step belong together: give both or neither")
        return self

    def read(self, folder: Path, image: Path) -> LocationGridSource:
        """See `CameraEntry`."""
        path = folder / self.file
        with open_raster(image) as source:
            shape = (source.height, source.width)
        location_grid = self._moved(read_location_grid(path, self))
        _check_covers(location_grid, shape, path, image)
        return LocationGridSource(location_grid, self.shift, (path,))

    def _moved(self, location_grid: LocationGrid) -> LocationGrid:
        """The grid in pixels of the image."""
        column, row = (node - first for node, first in zip(location_grid.first_node, self.first_pixel, strict=True))
        return LocationGrid(
            location_grid.heights, location_grid.xy, (column, row), location_grid.step, location_grid.crs
        )


@dataclass(frozen=True, eq=False)
class LocationGridSource:
    """A location grid that has been read, in pixels of its image.

    shift : (column, row) px added to its positions; files : the grid's file.
    """

    location_grid: LocationGrid
    shift: tuple[float, float] | None
    files: tuple[Path, ...]

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """See `OpenedCamera`; computed half way between the heights of the grid."""
        xy = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
        model = LocationGridModel(self.location_grid, WGS84)
        lon, lat, _ = model.ground_from_image(xy, np.array([np.mean(model.height_bounds())]))[0]
        return ((float(lon) + 180.0) % 360.0 - 180.0, float(lat)) if np.isfinite(lon) else None

    def sensor(self, crs: CRS) -> SensorModel:
        """See `OpenedCamera`.

        Raises
        ------
        InputError
            The scene has no place on the Earth, or its CRS has no coordinates for some of the nodes.
        """
        path = self.files[0]
        if is_local(crs):
            raise InputError(
                f"The location grid {path} knows its place on the Earth, but frame is local. Write frame: "
                "{crs: EPSG:n}."
            )
        if not np.isfinite(self.location_grid.in_crs(crs).xy).all():
            raise InputError(
                f"Nodes of the location grid {path} have no coordinates in {crs.name}. Choose another CRS."
            )
        model = LocationGridModel(self.location_grid, crs)
        return model if self.shift is None else ShiftedModel(model, column=self.shift[0], row=self.shift[1])


def read_location_grid(path: Path, camera: LocationGridCamera) -> LocationGrid:
    """Read a location grid, in the pixels that its file counts. camera : its entry, which goes before the file.

    Raises
    ------
    InputError
        The file is damaged, does not say what its bands or nodes are, or nodes are missing or wrong.
    """
    with open_raster(path, "location grid") as source:
        check_complete(source, path)
        tags = {key: value for domain in DOMAINS for key, value in source.tags(ns=domain).items()}
        bands = _bands_by_height(_heights_of_bands(tags, source.count, camera, path), tags, path)
        crs = _crs(tags, camera, path)
        first_node, step = _nodes(source.transform, camera, path)
        n_rows, n_cols = source.shape
        if min(n_rows, n_cols) < 2 or n_rows * n_cols > MAX_NODES:
            raise InputError(
                f"{path} has {n_rows} x {n_cols} nodes, and a location grid has from 2 x 2 to {MAX_NODES} in all. "
                "Check that it is the right file."
            )
        values = source.read(masked=True, out_dtype=np.float64).filled(np.nan)
    heights = sorted(bands)
    xy = np.stack([np.stack([values[bands[z][field]] for field in (0, 1)], axis=-1) for z in heights])
    status = [values[bands[z][2]] for z in heights if 2 in bands[z]]
    location_grid = LocationGrid(np.array(heights), _unwrapped(xy, crs), first_node, step, crs)
    _check_nodes(location_grid, np.array(status), path)
    return location_grid


def _heights_of_bands(tags: Mapping[str, str], n_bands: int, camera: LocationGridCamera, path: Path) -> list[float]:
    """The height (m) of each band."""
    if camera.heights is not None:
        if n_bands not in (2 * len(camera.heights), 3 * len(camera.heights)):
            raise InputError(
                f"{path} has {n_bands} bands, which are not two (or three, with a status) for each of the "
                f"{len(camera.heights)} heights given. Correct `heights`."
            )
        return [z for z in camera.heights for _ in range(n_bands // len(camera.heights))]
    named = _of_bands(tags, "ALTITUDE")
    missing = [band for band in range(n_bands) if band not in named]
    if missing:
        raise InputError(
            f"{path} does not say at which height its band {missing[0] + 1} of {n_bands} is: the tag "
            f"ALTITUDE_B{missing[0]} is missing. Check that it is a location grid, or give `heights` in the scene file."
        )
    return [decimal(named[band]) for band in range(n_bands)]


def _of_bands(tags: Mapping[str, str], what: str) -> dict[int, str]:
    """The values of the tags of each band, by its number from 0."""
    found = {key: TAG.fullmatch(key) for key in tags}
    return {int(match[2]): tags[key] for key, match in found.items() if match is not None and match[1] == what}


def _bands_by_height(heights: Sequence[float], tags: Mapping[str, str], path: Path) -> dict[float, dict[int, int]]:
    """The bands of each height: of x or longitude (0), of y or latitude (1), and of the status (2), if it has one."""
    if not all(abs(z) <= LARGEST_HEIGHT_M for z in heights):
        raise InputError(f"A height in {path} is not a number of metres. {EXPORT_AGAIN}")
    fields, bands = _of_bands(tags, "FIELD"), dict[float, dict[int, int]]()
    for band, z in enumerate(heights):
        of_height = bands.setdefault(float(z), {})
        named = fields.get(band, "")
        if named and named.lower() not in FIELDS:
            raise InputError(
                f"Band {band + 1} of {path} is called {quoted(named)}, and not one of {', '.join(FIELDS)}."
            )
        field = FIELDS[named.lower()] if named else len(of_height)
        if field in of_height or field > 2:
            raise InputError(
                f"{path} has several bands of the same coordinate at {z:g} m. Check the heights and names of its bands."
            )
        of_height[field] = band
    if len(bands) < 2:
        raise InputError(
            f"{path} has {counted(len(bands), 'height')}, and a ray needs two or more. Give a grid of more heights."
        )
    lacking = next((z for z, found in bands.items() if not {0, 1} <= set(found)), None)
    if lacking is not None:
        raise InputError(f"{path} lacks one of the two coordinates at {lacking:g} m. {EXPORT_AGAIN}")
    return bands


def _crs(tags: Mapping[str, str], camera: LocationGridCamera, path: Path) -> CRS:
    """The CRS of the coordinates."""
    named = camera.crs or next((tags[key] for key in CRS_TAGS if key in tags), None)
    if named is None:
        raise InputError(
            f"{path} does not say in which CRS its coordinates are: the tag REF is missing. Give `crs` in the scene "
            "file, for instance EPSG:4326 for longitudes and latitudes."
        )
    return file_crs(named, path)


def _nodes(transform: Any, camera: LocationGridCamera, path: Path) -> tuple[tuple[float, float], tuple[float, float]]:
    """The first node and the step, (column, row) px each."""
    if camera.first_node is not None and camera.step is not None:
        return camera.first_node, camera.step
    if transform == rasterio.Affine.identity():
        raise InputError(
            f"{path} does not say to which pixels its nodes belong, because it has no transform. Give `first_node` and "
            "`step` in the scene file."
        )
    if transform.b or transform.d or not (transform.a > 0 and transform.e > 0):
        raise InputError(
            f"The nodes of {path} do not follow the rows and columns of an image: its transform is "
            f"{tuple(transform)[:6]}. Give `first_node` and `step` in the scene file."
        )
    # There (0.5, 0.5) is the centre of the first pixel.
    return (transform.c - 0.5, transform.f - 0.5), (transform.a, transform.e)


def _unwrapped(xy: FloatArray, crs: CRS) -> FloatArray:
    """The coordinates of nodes with longitudes that do not jump at the date line."""
    if not crs.is_geographic:
        return xy
    first = xy[0, 0, 0, 0]
    with np.errstate(invalid="ignore"):
        lon = (xy[..., 0] - first + 180.0) % 360.0 - 180.0 + first
    return np.stack([lon, xy[..., 1]], axis=-1)


def _check_nodes(location_grid: LocationGrid, status: NDArray[np.float64], path: Path) -> None:
    """Refuse nodes that are missing, marked, or not in order."""
    xy, crs = location_grid.xy, location_grid.crs
    unusable = ~np.isfinite(xy).all(axis=-1)
    if status.size:
        unusable |= status != 0
    if unusable.any():
        k, row, col = np.argwhere(unusable)[0]
        raise InputError(
            f"{path} has {counted(int(unusable.sum()), 'node')} without a place on the ground, the first in row {row}, "
            f"column {col} at {location_grid.heights[k]:g} m. Give a grid of the part of the image that has one."
        )
    if crs.is_geographic and np.abs(xy[..., 1]).max() > 90:
        raise InputError(
            f"Latitudes in {path} reach {np.abs(xy[..., 1]).max():.6g} degrees. Check that its bands are longitudes "
            "and latitudes, in this order."
        )
    folded = location_grid.folded_cell()
    if folded is not None:
        k, row, col = folded
        raise InputError(
            f"The nodes of {path} are not in order beside row {row}, column {col} at {location_grid.heights[k]:g} m: "
            f"the ground there is folded, or a node is wrong. {EXPORT_AGAIN}"
        )


def _check_covers(location_grid: LocationGrid, shape: tuple[int, int], path: Path, image: Path) -> None:
    """Refuse an image with pixels outside of the nodes."""
    (left, top), (right, bottom) = location_grid.first_node, location_grid.last_node
    margins = left, top, shape[1] - 1 - right, shape[0] - 1 - bottom
    if max(margins) > MAX_OUTSIDE_PX:
        raise InputError(
            f"The location grid {path} holds columns {left:g} to {right:g} and rows {top:g} to {bottom:g} of {image}, "
            f"which has {shape[1]} columns and {shape[0]} rows. Check `first_pixel`, and that both belong together."
        )
