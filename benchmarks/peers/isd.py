"""Images and their metadata as SETSM reads them: plain TIFF, and XML as WorldView has it.

SETSM reads the XML by lines: each tag stands on a line of its own, and the corners of an image follow `BAND_P`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.errors import NotGeoreferencedWarning
from shapely import Polygon

from peers.scenes import Scene
from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.scene_file import open_scene
from zlocus.sensors.rpc import RpcCoefficients


@dataclass(frozen=True)
class ImageMetadata:
    """What SETSM is told of an image.

    bounds : west, south, east, north, degrees, of the ground that it shows; height : of that ground, m; azimuth_deg,
    elevation_deg : direction of the satellite; gsd_m : side of a pixel on the ground.
    """

    rpc: RpcCoefficients
    bounds: tuple[float, float, float, float]
    height: float
    azimuth_deg: float
    elevation_deg: float
    gsd_m: float


def metadata(scene: Scene) -> dict[str, ImageMetadata]:
    """Metadata of the images of a scene by view."""
    opened, height, found = open_scene(list(scene.images.values())), sum(scene.heights) / 2, {}
    on_map = Transformer.from_crs(opened.crs, scene.crs, always_xy=True)
    in_degrees = Transformer.from_crs(opened.crs, "EPSG:4326", always_xy=True)
    for (name, path), view, ray in zip(scene.images.items(), opened.views, scene.rays(), strict=True):
        rows, cols = view.image.shape
        corners = np.array([(0, 0), (cols - 1, 0), (cols - 1, rows - 1), (0, rows - 1)], float)
        x, y = view.sensor.ground_from_image(corners, np.full(4, height))[:, :2].T
        area = Polygon(np.column_stack(on_map.transform(x, y))).area
        lon, lat = in_degrees.transform(x, y)
        found[name] = ImageMetadata(
            read_rpc(path), (lon.min(), lat.min(), lon.max(), lat.max()), height,
            float(np.degrees(np.arctan2(ray[0], ray[1])) % 360.0), float(np.degrees(np.arcsin(ray[2]))),
            float(np.sqrt(area / ((rows - 1) * (cols - 1)))),
        )  # fmt: skip
    return found


def write_isd(path: Path, image: ImageMetadata) -> None:
    """Write the metadata of an image."""
    root = ElementTree.Element("isd")
    described = ElementTree.SubElement(root, "IMD")
    west, south, east, north = image.bounds
    corners = {"UL": (west, north), "UR": (east, north), "LR": (east, south), "LL": (west, south)}
    add(ElementTree.SubElement(described, "BAND_P"), {
        f"{corner}{what}": value
        for corner, (lon, lat) in corners.items()
        for what, value in (("LON", lon), ("LAT", lat), ("HAE", image.height))
    })  # fmt: skip
    off_nadir = 90.0 - image.elevation_deg
    add(ElementTree.SubElement(described, "IMAGE"), {
        "SATID": "WV01", "FIRSTLINETIME": "2020-01-01T12:00:00.000000Z",
        "MEANPRODUCTROWGSD": image.gsd_m, "MEANPRODUCTCOLGSD": image.gsd_m, "MEANPRODUCTGSD": image.gsd_m,
        "MEANSUNAZ": 180.0, "MEANSUNEL": 45.0, "MEANSATAZ": image.azimuth_deg, "MEANSATEL": image.elevation_deg,
        "MEANINTRACKVIEWANGLE": off_nadir, "MEANCROSSTRACKVIEWANGLE": 0.0, "MEANOFFNADIRVIEWANGLE": off_nadir,
        "CLOUDCOVER": 0.0,
    })  # fmt: skip
    rpc, block = image.rpc, ElementTree.SubElement(ElementTree.SubElement(root, "RPB"), "IMAGE")
    add(block, {
        "ERRBIAS": 0.0, "ERRRAND": 0.0, "LINEOFFSET": rpc.line_off, "SAMPOFFSET": rpc.samp_off,
        "LATOFFSET": rpc.lat_off, "LONGOFFSET": rpc.lon_off, "HEIGHTOFFSET": rpc.height_off,
        "LINESCALE": rpc.line_scale, "SAMPSCALE": rpc.samp_scale, "LATSCALE": rpc.lat_scale,
        "LONGSCALE": rpc.lon_scale, "HEIGHTSCALE": rpc.height_scale,
    })  # fmt: skip
    terms = {
        "LINENUMCOEF": rpc.line_num, "LINEDENCOEF": rpc.line_den, "SAMPNUMCOEF": rpc.samp_num,
        "SAMPDENCOEF": rpc.samp_den,
    }  # fmt: skip
    for name, values in terms.items():
        listed = " ".join(repr(float(value)) for value in values)
        add(ElementTree.SubElement(block, f"{name}List"), {name: listed})
    ElementTree.indent(root)
    path.write_text(ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


def add(parent: ElementTree.Element, values: dict[str, float | str]) -> None:
    """Add a child with a text for each value."""
    for name, value in values.items():
        ElementTree.SubElement(parent, name).text = value if isinstance(value, str) else repr(float(value))


def write_plain(image: Path, path: Path) -> None:
    """Write an image of one band without compression or position."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(image) as source:
            grey = source.read(1)
        with rasterio.open(
            path, "w", driver="GTiff", height=grey.shape[0], width=grey.shape[1], count=1, dtype=grey.dtype
        ) as file:
            file.write(grey, 1)
