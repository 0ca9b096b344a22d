"""item.json: the files of a result as an item of a SpatioTemporal Asset Catalog (STAC 1.1)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rasterio import DatasetReader
from rasterio.warp import transform_geom

from zlocus.core.scene import is_local
from zlocus.io.atomic_write import write_atomically
from zlocus.io.crs import crs_label
from zlocus.io.open_raster import open_raster
from zlocus.io.row_strips import BandReader
from zlocus.io.run_record import read_record

STAC_VERSION, WGS84 = "1.1.0", "EPSG:4326"
COG = "image/tiff; application=geotiff; profile=cloud-optimized"
GEOPACKAGE, LAZ, JSON = "application/geopackage+sqlite3", "application/vnd.laszip", "application/json"
HTML, GEOJSON, COPC = "text/html", "application/geo+json", "application/vnd.laszip+copc"
# Each side of the grid is cut into this many pieces, because straight sides on the map are curves in degrees.
PIECES_PER_SIDE = 16
# Coordinates are rounded to 1e-7 degrees, a centimetre on the ground.
DEGREE_DECIMALS = 7
STATISTICS = {"MINIMUM": "minimum", "MAXIMUM": "maximum", "MEAN": "mean", "STDDEV": "stddev",
              "VALID_PERCENT": "valid_percent"}  # fmt: skip


@dataclass(frozen=True)
class Product:
    """A file of a result: its name, title, media type and roles. Rasters also describe their bands."""

    name: str
    title: str
    media: str
    roles: tuple[str, ...]


PRODUCTS = (
    Product("dsm.tif", "Surface: height at each cell's centre", COG, ("data",)),
    Product("sigma.tif", "Standard deviation of the height", COG, ("data", "metadata")),
    Product("quality.tif", "Why a cell is empty or doubtful: bit flags", COG, ("data", "metadata")),
    Product("views.tif", "Number of images used", COG, ("data", "metadata")),
    Product("ortho.tif", "Ortho-image", COG, ("data", "visual")),
    Product("water.tif", "Water: surfaces that were levelled, and possible water", COG, ("data", "metadata")),
    Product("hillshade.tif", "Hillshade of the surface", COG, ("visual", "overview")),
    Product("dtm.tif", "Terrain: the ground without buildings and trees", COG, ("data",)),
    Product("contours.gpkg", "Contours", GEOPACKAGE, ("data",)),
    Product("surface.laz", "The surface's cells as coloured points", LAZ, ("data",)),
    Product("surface.copc.laz", "The surface's cells as coloured points, in an octree", COPC, ("data",)),
    Product("ties.gpkg", "Tie points", GEOPACKAGE, ("metadata",)),
    Product("observations.npz", "Positions of the tie points in the images", "application/zip", ("metadata",)),
    Product("ranking.gpkg", "How well pairs of images match at the tie points", GEOPACKAGE, ("metadata",)),
    Product("report.html", "Report of the run on one page", HTML, ("overview", "metadata")),
    Product("footprints.geojson", "Footprints and overlaps of the images", GEOJSON, ("metadata",)),
    Product("curves.json", "Match curves of some cells", JSON, ("metadata",)),
    Product("events.jsonl", "Events of the run with their times", "application/x-ndjson", ("metadata",)),
    Product("metadata.xml", "Lineage and quality by ISO 19115 and ISO 19157", "application/xml", ("metadata",)),
    Product("run.json", "Request, options, versions, inputs and times of the run", JSON, ("metadata",)),
)


class GridFootprint(NamedTuple):
    """Outline of a grid on the Earth. geometry : GeoJSON, in degrees; bbox : west, south, east and north, degrees."""

    geometry: dict[str, Any]
    bbox: list[float]


def write_item(folder: Path) -> bool:
    """Write an item that links every product in a folder; return False, and write nothing, in a local frame.

    The item's time is that of the images, as far as `run.json` knows their dates. Otherwise it is that of the run, and
    the description says so. Rasters are described by the bands of STAC's core. No extension is used, because the
    schemas of extensions are on the network only; the CRS and the vertical datum are properties with our prefix.

    Raises
    ------
    InputError
        dsm.tif is missing or damaged.
    OutputError
        The file cannot be written.
    """
    with BandReader(folder / "dsm.tif") as reader:
        crs, cell_m, height_description = reader.crs, reader.cell_m, reader.description
    if crs is None or is_local(crs):
        return False
    with open_raster(folder / "dsm.tif", "raster") as file:
        footprint = footprint_of(file)
    times = _times(folder)
    properties = {
        "title": "Digital surface model", "description": times.description, "gsd": cell_m,
        "created": _rfc3339(times.created), "zlocus:crs": crs_label(crs), "zlocus:heights": height_description,
    }  # fmt: skip
    ends = {"start_datetime": times.first, "end_datetime": times.last}
    properties |= {name: _rfc3339(end) for name, end in ends.items() if end is not None}
    item = {
        "type": "Feature", "stac_version": STAC_VERSION, "stac_extensions": [],
        "id": folder.resolve().name or "surface", "geometry": footprint.geometry, "bbox": footprint.bbox,
        "properties": properties | {"datetime": None if times.single is None else _rfc3339(times.single)},
        "links": [],
        "assets": {
            product.name.replace(".", "-"): asset_of(folder, product)
            for product in PRODUCTS
            if (folder / product.name).is_file()
        },
    }  # fmt: skip
    text = json.dumps(item, indent=2, allow_nan=False) + "\n"
    write_atomically(folder / "item.json", lambda part: part.write_text(text, encoding="utf-8"))
    return True


def asset_of(folder: Path, product: Product) -> dict[str, Any]:
    """The entry of a product that is in the folder."""
    bands = {"bands": bands_of(folder / product.name)} if product.media == COG else {}
    named = {"href": f"./{product.name}", "type": product.media, "title": product.title}
    return named | bands | {"roles": list(product.roles)}


def footprint_of(file: DatasetReader) -> GridFootprint:
    """Outline of a raster on the Earth, counter-clockwise.

    An outline that crosses the date line is cut in two, and its west is larger than its east. Source: RFC 7946, 3.1.6,
    3.1.9 and 5.2.
    """
    west, south, east, north = file.bounds
    corners = np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])
    places = np.arange(PIECES_PER_SIDE * (len(corners) - 1) + 1)
    x, y = (np.interp(places, places[::PIECES_PER_SIDE], column) for column in corners.T)
    outline = {"type": "Polygon", "coordinates": [list(zip(x, y, strict=True))]}
    geometry = transform_geom(file.crs, WGS84, outline, precision=DEGREE_DECIMALS)
    parts = geometry["coordinates"] if geometry["type"] == "MultiPolygon" else [geometry["coordinates"]]
    low, high = (np.array([end(part[0], axis=0) for part in parts]) for end in (np.min, np.max))
    # The eastern hemisphere's part has the larger longitudes, and the box begins in it.
    bbox = (low[:, 0].max(), low[:, 1].min(), high[:, 0].min(), high[:, 1].max())
    return GridFootprint(geometry, [float(degrees) for degrees in bbox])


def bands_of(path: Path) -> list[dict[str, Any]]:
    """What the bands of a raster hold, as STAC's common metadata: names, data types, units and statistics.

    The statistics are those that the file keeps of all its cells.
    """
    with open_raster(path, "raster") as file:
        bands = []
        for number in file.indexes:
            tags = file.tags(number)
            statistics = {
                STATISTICS[name]: float(tags[key]) for name in STATISTICS if (key := f"STATISTICS_{name}") in tags
            }
            band: dict[str, Any] = {"name": f"band-{number}", "data_type": file.dtypes[number - 1]}
            if description := file.descriptions[number - 1]:
                band["description"] = description
            if file.nodata is not None:
                band["nodata"] = "nan" if math.isnan(file.nodata) else file.nodata
            if unit := file.units[number - 1]:
                band["unit"] = unit
            bands.append(band | ({"statistics": statistics} if statistics else {}))
    return bands


@dataclass(frozen=True)
class _ItemTimes:
    """Times of an item. single : the only one, or None where there is a range from first to last; created : of the
    result; description : of the item, which says where the times are from."""

    single: datetime | None
    first: datetime | None
    last: datetime | None
    created: datetime
    description: str


def _times(folder: Path) -> _ItemTimes:
    """Times from run.json; without one, the time at which the surface was written."""
    record: dict[str, Any] = {}
    if (path := folder / "run.json").is_file():
        record = read_record(path)
    if "created" in record:
        created = datetime.fromisoformat(record["created"])
    else:
        created = datetime.fromtimestamp(int((folder / "dsm.tif").stat().st_mtime), UTC)
    listed: Sequence[str | None] = record.get("image_dates", [])
    dates = sorted(date.fromisoformat(text) for text in listed if text)
    description = "Heights from overlapping images, by zlocus."
    if not dates:
        description += " The dates of the images are not known: datetime is that of the run."
        return _ItemTimes(created, None, None, created, description)
    first = datetime.combine(dates[0], time(0, 0, 0), UTC)
    last = datetime.combine(dates[-1], time(23, 59, 59), UTC)
    if len(dates) < len(listed):
        description += f" The dates of {len(listed) - len(dates)} of {len(listed)} images are not known."
    return _ItemTimes(None, first, last, created, description)


def _rfc3339(when: datetime) -> str:
    """A time in UTC as RFC 3339 writes it."""
    return when.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
