"""Maps of a finished surface: `zlocus products`."""

from __future__ import annotations

import os
from typing import Any, Mapping, Sequence

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingOutputFile,
    QgsProcessingOutputFolder,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterNumber,
)

from .algorithm import OUTPUT, ZlocusAlgorithm, is_empty
from .results import MAPS, SURFACE

NAMES = tuple(MAPS)
TITLES = ("contours", "terrain without buildings and trees", "hillshade", "points (LAZ)", "points (COPC)")
OUTPUTS = {"CONTOURS": "contours", "DTM": "dtm", "HILLSHADE": "hillshade", "POINTS": "laz", "COPC": "copc"}


class Products(ZlocusAlgorithm):
    """Maps of a finished surface."""

    COMMAND = "products"
    TITLE = "Make terrain, contours, hillshade and points"
    SHOWN = tuple(each for each in SURFACE if each.name in MAPS.values())
    HELP = "Makes maps of a finished surface, in its folder. Earlier ones of the same name are replaced."

    def initAlgorithm(self, configuration: Mapping[str, Any] | None = None) -> None:
        number = QgsProcessingParameterNumber
        self.add(QgsProcessingParameterFile("FOLDER", "Folder of the surface", QgsProcessingParameterFile.Folder))
        self.add(QgsProcessingParameterEnum("MAPS", "Maps", TITLES, allowMultiple=True, defaultValue=[0, 1, 2]))
        text = "Interval of the contours, m (empty: a round one)"
        self.add(number("INTERVAL", text, number.Double, minValue=0.0, optional=True))
        file = QgsProcessingParameterFile("CONFIG", "File with options (zlocus config)", optional=True)
        self.add(file, is_advanced=True)
        self.add_shared(has_overwrite=False)
        self.addOutput(QgsProcessingOutputFolder(OUTPUT, "Folder of the surface"))
        self.addOutput(QgsProcessingOutputVectorLayer("CONTOURS", "Contours"))
        self.addOutput(QgsProcessingOutputRasterLayer("DTM", "Terrain"))
        self.addOutput(QgsProcessingOutputRasterLayer("HILLSHADE", "Hillshade"))
        self.addOutput(QgsProcessingOutputFile("POINTS", "Points (LAZ)"))
        self.addOutput(QgsProcessingOutputFile("COPC", "Points (COPC)"))

    def folder(self, parameters: dict[str, Any], context: QgsProcessingContext) -> str:
        """The folder of the surface."""
        return self.file(parameters, "FOLDER", context)

    def words(
        self, parameters: dict[str, Any], context: QgsProcessingContext, folder: str
    ) -> tuple[Sequence[str], Mapping[str, Any]]:
        """Folder and options of `zlocus products`."""
        maps = [] if is_empty(parameters.get("MAPS")) else self.parameterAsEnums(parameters, "MAPS", context)
        interval = self.number(parameters, "INTERVAL", context)
        return [folder], {
            "products": ",".join(NAMES[k] for k in maps) or "none",
            "set": None if interval is None else f"products.contour_interval_m={interval}",
            "config": self.file(parameters, "CONFIG", context),
        }  # fmt: skip

    def answered(self, folder: str, answer: dict[str, Any]) -> dict[str, Any]:
        """The folder, and the maps that are there."""
        files = {name: os.path.join(folder, MAPS[kind]) for name, kind in OUTPUTS.items()}
        return {OUTPUT: folder, **{name: path for name, path in files.items() if os.path.isfile(path)}}
