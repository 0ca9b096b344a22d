"""item.json: the files of a result as an item of a SpatioTemporal Asset Catalog (STAC 1.1)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Any

import numpy as np
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer

from zlocus.core.scene import is_local
from zlocus.io.crs import crs_label
from zlocus.io.open_raster import open_raster
from zlocus.io.row_strips import BandReader
from zlocus.io.run_record import read_record, write_atomically

COG = "image/tiff; application=geotiff; profile=cloud-optimized"
GEOPACKAGE, LAZ, JSON = "application/geopackage+sqlite3", "application/vnd.laszip", "application/json"
HTML, GEOJSON = "text/html", "application/geo+json"
# Pieces of each side of the grid, whose straight sides are curves in degrees; a centimetre on the ground.
PIECES, DEGREE_DIGITS = 16, 7
STATISTICS = {"MINIMUM": "minimum", "MAXIMUM": "maximum", "MEAN": "mean", "STDDEV": "stddev",
              "VALID_PERCENT": "valid_percent"}  # fmt: skip


@dataclass(frozen=True)
class Product:
    """A file of a result, its title, media type and roles; those of rasters say more of themselves."""

    name: str
    title: str
    media: str
    roles: tuple[str, ...]


PRODUCTS = (
    Product("dsm.tif", "Surface: height at each cell's centre", COG, ("data",)),
    Product("sigma.tif", "Standard deviation of the height", COG, ("data", "metadata")),
    Product("quality.tif", "Why a cell is empty or doubtful: bit flags", COG, ("data", "metadata")),
    Product("views.tif", "Images used", COG, ("data", "metadata")),
    Product("ortho.tif", "Ortho-image", COG, ("data", "visual")),
    Product("hillshade.tif", "Hillshade of the surface", COG, ("visual", "overview")),
    Product("dtm.tif", "Terrain: the ground without buildings and trees", COG, ("data",)),
    Product("contours.gpkg", "Contours", GEOPACKAGE, ("data",)),
    Product("surface.laz", "The surface's cells as coloured points", LAZ, ("data",)),
    Product("ties.gpkg", "Tie points", GEOPACKAGE, ("metadata",)),
    Product("observations.npz", "Where tie points were seen in the images", "application/zip", ("metadata",)),
    Product("ranking.gpkg", "What tie points say of the images", GEOPACKAGE, ("metadata",)),
    Product("report.html", "All of it for people, on one page", HTML, ("overview", "metadata")),
    Product("footprints.geojson", "Outlines and pairs of the images", GEOJSON, ("metadata",)),
    Product("curves.json", "Match curves of some cells", JSON, ("metadata",)),
    Product("events.jsonl", "What happened when", "application/x-ndjson", ("metadata",)),
    Product("run.json", "What was asked, versions, inputs, times", JSON, ("metadata",)),
)


def write_item(folder: Path) -> bool:
    """An item that links every product in a folder; False, and no file, where the grid has no place on the Earth.

    Its time is that of the images, as far as `run.json` knows their dates, else that of the run, which the description
    then says. Raster information is that of STAC's core (bands); extensions are not used, so the CRS and what heights
    are above stand in properties of our own.

    Raises
    ------
    InputError
        dsm.tif is missing or damaged.
    OutputError
        The file cannot be written.
    """
    # A fifth of a second.
    import pystac

    with BandReader(folder / "dsm.tif") as heights:
        geobox, crs, cell_m, what = heights.geobox, heights.crs, heights.cell_m, heights.description
    if crs is None or is_local(crs):
        return False
    geometry, bbox = footprint_of(geobox, crs)
    taken = _times(folder)
    item = pystac.Item(
        id=folder.resolve().name or "surface",
        geometry=geometry,
        bbox=bbox,
        datetime=taken.when,
        start_datetime=taken.first,
        end_datetime=taken.last,
        properties={
            "title": "Digital surface model", "description": taken.description, "gsd": cell_m,
            "created": _text(taken.made), "zlocus:crs": crs_label(crs), "zlocus:heights": what,
        },
    )  # fmt: skip
    for product in PRODUCTS:
        if (path := folder / product.name).is_file():
            extra = {"bands": bands_of(path)} if product.media == COG else {}
            asset = pystac.Asset(f"./{product.name}", product.title, None, product.media, list(product.roles), extra)
            item.add_asset(product.name.replace(".", "-"), asset)
    record = item.to_dict(include_self_link=False, transform_hrefs=False)
    text = json.dumps(record, indent=2, allow_nan=False) + "\n"
    write_atomically(folder / "item.json", lambda part: part.write_text(text, encoding="utf-8"))
    return True


def footprint_of(geobox: GeoBox, crs: CRS) -> tuple[dict[str, Any], list[float]]:
    """The grid's outline in degrees as GeoJSON has it, and its bounds (west, south, east, north).

    Across the date line the outline is cut in two, and west is larger than east. Source: RFC 7946, 3.1.9 and 5.2.
    """
    from shapely import box
    from shapely.affinity import translate
    from shapely.geometry import MultiPolygon, Polygon, mapping
    from shapely.geometry.polygon import orient

    rows, cols = geobox.shape
    steps = np.arange(PIECES) / PIECES
    col = np.concatenate([steps, np.ones(PIECES), 1 - steps, np.zeros(PIECES)]) * cols
    row = np.concatenate([np.zeros(PIECES), steps, np.ones(PIECES), 1 - steps]) * rows
    t = geobox.transform
    to_degrees = Transformer.from_crs(crs.to_2d(), "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(t.c + t.a * col, t.f + t.e * row)
    is_cut = np.ptp(lon) > 180.0
    lon = np.round(np.where((lon < 0) & is_cut, lon + 360.0, lon), DEGREE_DIGITS)
    lat = np.round(lat, DEGREE_DIGITS)
    outline = orient(Polygon(np.column_stack([lon, lat])))
    west, south, east, north = outline.bounds
    if is_cut:
        parts = [outline & box(0, -90, 180, 90), translate(outline & box(180, -90, 360, 90), -360.0)]
        outline, east = MultiPolygon([orient(part) for part in parts]), east - 360.0
    return json.loads(json.dumps(mapping(outline))), [west, south, round(east, DEGREE_DIGITS), north]


def bands_of(path: Path) -> list[dict[str, Any]]:
    """What a raster's bands hold, as STAC's common metadata has it (names, data types, units, statistics)."""
    with open_raster(path, "raster") as file:
        bands = []
        for number in file.indexes:
            tags = file.tags(number)
            found = {STATISTICS[name]: float(tags[key]) for name in STATISTICS if (key := f"STATISTICS_{name}") in tags}
            band: dict[str, Any] = {"name": f"band-{number}", "data_type": file.dtypes[number - 1]}
            if description := file.descriptions[number - 1]:
                band["description"] = description
            if file.nodata is not None:
                band["nodata"] = "nan" if math.isnan(file.nodata) else file.nodata
            if unit := file.units[number - 1]:
                band["unit"] = unit
            bands.append(band | ({"statistics": found} if found else {}))
    return bands


@dataclass(frozen=True)
class _Times:
    """When the images were taken: from first to last, or a single time; made : when the result was."""

    when: datetime | None
    first: datetime | None
    last: datetime | None
    made: datetime
    description: str


def _times(folder: Path) -> _Times:
    """From run.json; of a result without one, the time at which the surface was written."""
    record: dict[str, Any] = {}
    if (path := folder / "run.json").is_file():
        record = read_record(path)
    if "created" in record:
        made = datetime.fromisoformat(record["created"])
    else:
        made = datetime.fromtimestamp(int((folder / "dsm.tif").stat().st_mtime), UTC)
    listed: Sequence[str | None] = record.get("image_dates", [])
    dates = sorted(date.fromisoformat(text) for text in listed if text)
    what = "Heights from overlapping images, by zlocus."
    if not dates:
        return _Times(
            made, None, None, made, f"{what} The dates of the images are not known: datetime is that of the run."
        )
    first = datetime.combine(dates[0], time(0, 0, 0), UTC)
    last = datetime.combine(dates[-1], time(23, 59, 59), UTC)
    if len(dates) < len(listed):
        what += f" The dates of {len(listed) - len(dates)} of {len(listed)} images are not known."
    return _Times(None, first, last, made, what)


def _text(when: datetime) -> str:
    """RFC 3339, in UTC."""
    return when.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
