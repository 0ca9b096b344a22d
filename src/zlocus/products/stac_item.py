"""item.json: the files of a result as an item of a SpatioTemporal Asset Catalog (STAC 1.1)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pyproj import CRS

from zlocus.core.scene import is_local
from zlocus.io.atomic_write import write_atomically
from zlocus.io.crs import crs_label
from zlocus.io.open_raster import open_raster
from zlocus.io.row_strips import BandReader
from zlocus.io.styles.file_names import OF_SURFACE, QML, REASONS, SLD, TABLE, WITH_TABLE, style_files
from zlocus.matching.quality import MEANINGS, Quality
from zlocus.products.item_times import item_times, rfc3339
from zlocus.products.rasters import WATER_MEANINGS, WaterKind
from zlocus.products.surface_footprint import footprint_of

STAC_VERSION = "1.1.0"
# Extensions by the prefix of their fields.
EXTENSIONS = {
    prefix: f"https://stac-extensions.github.io/{name}/schema.json"
    for prefix, name in (
        ("proj:", "projection/v2.0.0"), ("classification:", "classification/v2.0.0"), ("raster:", "raster/v2.0.0"),
        ("file:", "file/v2.1.0"),
    )
}  # fmt: skip
COG = "image/tiff; application=geotiff; profile=cloud-optimized"
GEOPACKAGE, LAZ, JSON = "application/geopackage+sqlite3", "application/vnd.laszip", "application/json"
HTML, GEOJSON, XML, COPC = "text/html", "application/geo+json", "application/xml", "application/vnd.laszip+copc"
STYLE_MEDIA = {QML: "application/x-qgis-layer-settings", SLD: "application/vnd.ogc.sld+xml"}
# Files whose points have the heights of dsm.tif, and its CRS with its vertical datum.
WITH_HEIGHTS = (GEOPACKAGE, LAZ, COPC)
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
    Product("metadata.xml", "Lineage and quality by ISO 19115 and ISO 19157", XML, ("metadata",)),
    Product("run.json", "Request, options, versions, inputs and times of the run", JSON, ("metadata",)),
)
# How programs draw the products, and what their values mean.
STYLES = (
    *(
        Product(name, f"Style of {product}", STYLE_MEDIA[Path(name).suffix], ("style",))
        for product in OF_SURFACE
        for name in style_files(product)[:2]
    ),
    Product(f"{WITH_TABLE}{TABLE}", f"Names and counts of the values of {WITH_TABLE}", XML, ("metadata",)),
    Product(REASONS, f"Reasons in {WITH_TABLE}, in groups", XML, ("metadata",)),
)


def write_item(folder: Path) -> bool:
    """Write an item that links every product in a folder; return False, and write nothing, in a local frame.

    Its geometry is the outline of the cells that have a height. The item's time is that of the images, as far as
    `run.json` knows it. Otherwise it is that of the run, and the description says so. Extensions of STAC describe the
    grid and CRS of the rasters, the flags of quality.tif and the classes of water.tif, and the sizes of large files.

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
    footprint, times = footprint_of(folder / "dsm.tif"), item_times(folder)
    assets = {
        product.name.replace(".", "-"): asset_of(folder, product, crs)
        for product in (*PRODUCTS, *STYLES)
        if (folder / product.name).is_file()
    }
    properties = {
        "title": "Digital surface model", "description": times.description, "gsd": cell_m,
        "created": rfc3339(times.created), **times.properties(), **crs_fields(crs.to_2d()),
        "proj:geometry": footprint.on_map, "proj:bbox": footprint.map_bbox,
        "zlocus:crs": crs_label(crs), "zlocus:heights": height_description,
    }  # fmt: skip
    used = [
        address for prefix, address in EXTENSIONS.items()
        if any(name.startswith(prefix) for fields in (properties, *assets.values()) for name in fields)
    ]  # fmt: skip
    item = {
        "type": "Feature", "stac_version": STAC_VERSION, "stac_extensions": used,
        "id": folder.resolve().name or "surface", "geometry": footprint.geometry, "bbox": footprint.bbox,
        "properties": properties, "links": [], "assets": assets,
    }  # fmt: skip
    text = json.dumps(item, indent=2, allow_nan=False) + "\n"
    write_atomically(folder / "item.json", lambda part: part.write_text(text, encoding="utf-8"))
    return True


def asset_of(folder: Path, product: Product, crs: CRS) -> dict[str, Any]:
    """The entry of a product that is in the folder. crs : of dsm.tif, with its vertical datum where that is a geoid."""
    path = folder / product.name
    asset: dict[str, Any] = {"href": f"./{product.name}", "type": product.media, "title": product.title}
    if product.media == COG:
        asset |= {"bands": bands_of(path), **grid_fields(path), **classes_of(product.name)}
    elif product.media in WITH_HEIGHTS and len(crs.axis_info) > 2:
        asset |= crs_fields(crs)
    elif product.media == GEOJSON:
        asset |= {"proj:code": "OGC:CRS84"}
    if product.media in (COG, LAZ, COPC):  # other programs change the other files when they open them
        asset |= {"file:size": path.stat().st_size}
    return asset | {"roles": list(product.roles)}


def crs_fields(crs: CRS) -> dict[str, Any]:
    """A CRS by the projection extension: its code, and in full where it has none."""
    authority = crs.to_authority()
    if authority is not None:
        return {"proj:code": ":".join(authority)}
    return {"proj:code": None, "proj:wkt2": crs.to_wkt()}


def grid_fields(path: Path) -> dict[str, Any]:
    """The CRS and grid of a raster by the projection extension, and its cell size by the raster extension."""
    with open_raster(path, "raster") as file:
        return {
            **({} if file.crs is None else crs_fields(CRS.from_wkt(file.crs.to_wkt()))),
            "proj:shape": list(file.shape), "proj:transform": list(file.transform)[:6], "proj:bbox": list(file.bounds),
            "raster:spatial_resolution": float(file.transform.a),
        }  # fmt: skip


def classes_of(name: str) -> dict[str, Any]:
    """What the values of a raster mean, by the classification extension. name : of the file."""
    if name == "water.tif":
        classes = [
            {"value": int(kind), "name": kind.name, "description": WATER_MEANINGS[kind]} for kind in WaterKind
        ]  # fmt: skip
        return {"classification:classes": classes}
    if name != "quality.tif":
        return {}
    bitfields = [
        {
            "offset": int(flag).bit_length() - 1, "length": 1, "name": flag.name, "description": MEANINGS[flag],
            "classes": [
                {"value": 0, "name": f"not_{flag.name}", "description": "the flag is not set"},
                {"value": 1, "name": flag.name, "description": MEANINGS[flag]},
            ],
        }
        for flag in Quality
    ]  # fmt: skip
    return {"classification:bitfields": bitfields}


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
