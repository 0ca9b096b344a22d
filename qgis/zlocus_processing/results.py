"""The files of a result that are shown as layers, with their names. Nothing here is of QGIS."""

from __future__ import annotations

import os
from typing import NamedTuple


class ShownFile(NamedTuple):
    """A file that becomes a layer. name : of the file; title : of the layer; is_visible : from the start."""

    name: str
    title: str
    is_visible: bool = False

    @property
    def style(self) -> str:
        """Name of the file of its style."""
        return os.path.splitext(self.name)[0] + ".qml"


# From the top of the list of layers to its bottom. The colours of heights darken the hillshade below them.
SURFACE = (
    ShownFile("footprints.geojson", "footprints of the images"),
    ShownFile("ties.gpkg", "tie points"),
    ShownFile("contours.gpkg", "contours", True),
    ShownFile("dsm.tif", "surface", True),
    ShownFile("hillshade.tif", "hillshade", True),
    ShownFile("dtm.tif", "terrain"),
    ShownFile("water.tif", "water"),
    ShownFile("sigma.tif", "standard deviation"),
    ShownFile("views.tif", "number of images"),
    ShownFile("reasons.vrt", "reasons (flags in groups)"),
    ShownFile("quality.tif", "quality flags"),
    ShownFile("ortho.tif", "ortho-image"),
)
EVALUATION = (ShownFile("error.tif", "error", True),)
COMPARISON = (ShownFile("difference.tif", "difference, B less A", True),)
MAPS = {
    "contours": "contours.gpkg", "dtm": "dtm.tif", "hillshade": "hillshade.tif", "laz": "surface.laz",
    "copc": "surface.copc.laz",
}  # fmt: skip


def shown_files(folder: str, files: tuple[ShownFile, ...]) -> list[ShownFile]:
    """Those of the files that are in a folder."""
    return [each for each in files if os.path.isfile(os.path.join(folder, each.name))]
