"""Made-up mask files, and the parts of images that they are laid over."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import rasterio
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning

from rpc_fixtures import write_image
from zlocus.io.masks.ground_polygons import GroundView
from zlocus.io.masks.image_mask import ImageMask
from zlocus.io.masks.mask_entry import MaskEntry
from zlocus.io.masks.open_mask import open_masks
from zlocus.sensors.rpc import RpcModel

IMAGE_CRS = "urn:ogc:def:derivedCRSType:OGC:1.0:image"
UTM = CRS.from_epsg(32631)


def write_raster(path: Path, bands, descriptions=(), **profile) -> Path:
    """A raster of bands (r, c) or (b, r, c), without a place on the Earth unless the profile gives it one."""
    write_image(path, np.asarray(bands), None, **profile)
    if descriptions:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, "r+") as file:
                file.descriptions = descriptions
    return path


def geojson(path: Path, *rings, crs: str | None = "EPSG:4326") -> Path:
    """Polygons of one outline and holes each, as GeoJSON; its CRS is WGS 84 where none is written."""
    outlines = [[[list(point) for point in ring] for ring in polygon] for polygon in rings]
    features = [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": outline}}
        for outline in outlines
    ]
    document = {"type": "FeatureCollection", "features": features}
    if crs != "EPSG:4326":
        document["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def gml(path: Path, *rings, srs: str | None = IMAGE_CRS, kind: str = "CLOUD", title: str = "Cloud mask") -> Path:
    """A GML mask with a feature for each ring of points."""
    named = "" if srs is None else f' srsName="{srs}"'
    features = "".join(
        f'<hma:MaskFeature gml:id="m{number}"><hma:maskType codeSpace="urn:test">{kind}</hma:maskType><gml:extentOf>'
        f"<gml:Polygon{named}><gml:exterior><gml:LinearRing><gml:posList>{' '.join(f'{x} {y}' for x, y in ring)}"
        "</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon></gml:extentOf></hma:MaskFeature>"
        for number, ring in enumerate(rings)
    )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<hma:Mask gml:id="t" xmlns:gml="http://www.opengis.net/gml" '
        f'xmlns:hma="http://earth.esa.int/hma"><gml:name>{title}</gml:name><hma:maskMembers>{features}'
        "</hma:maskMembers></hma:Mask>",
        encoding="utf-8",
    )
    return path


def box(left, top, right, bottom):
    """A closed ring."""
    return [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]


def mask_of(shape, *entries, rpc=None, mean_height=None) -> ImageMask:
    """The mask of an image of some shape. entries : as in a scene file, with absolute paths."""
    sensor = None if rpc is None else RpcModel(rpc, UTM)
    view = GroundView(sensor, UTM, shape, mean_height)
    return open_masks([MaskEntry.model_validate(entry) for entry in entries], Path("image.tif"), view, "a")


def whole(mask: ImageMask):
    return mask.covers(0, 0, *mask.parts[0].shape)
