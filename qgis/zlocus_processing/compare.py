"""Compare two surfaces: `zlocus compare`."""

from __future__ import annotations

import os
from typing import Any, Mapping, Sequence

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingOutputHtml,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterRasterLayer,
)

from .algorithm import OUTPUT, OVERWRITE, ZlocusAlgorithm
from .results import COMPARISON
from .words import surface_of


class Compare(ZlocusAlgorithm):
    """Two surfaces, or two runs, side by side."""

    COMMAND = "compare"
    TITLE = "Compare two surfaces"
    SHOWN = COMPARISON
    HELP = (
        "Compares two surfaces: differences of height, and cells with a height in one only. Of the dsm.tif of two runs "
        "it also compares options, times, cameras and versions. The folder of the result holds a page (compare.html) "
        "and the raster of the differences, B less A, on the grid of A."
    )

    def initAlgorithm(self, configuration: Mapping[str, Any] | None = None) -> None:
        self.add(QgsProcessingParameterRasterLayer("A", "Surface A"))
        self.add(QgsProcessingParameterRasterLayer("B", "Surface B"))
        self.add(QgsProcessingParameterFolderDestination(OUTPUT, "Folder of the result"))
        self.add(QgsProcessingParameterFile("GEOID", "Geoid raster", optional=True), is_advanced=True)
        self.add_shared()
        self.addOutput(QgsProcessingOutputRasterLayer("DIFFERENCE", "Difference"))
        self.addOutput(QgsProcessingOutputHtml("PAGE", "Comparison"))

    def words(
        self, parameters: dict[str, Any], context: QgsProcessingContext, folder: str
    ) -> tuple[Sequence[str], Mapping[str, Any]]:
        """Surfaces and options of `zlocus compare`."""
        surfaces = [surface_of(self.raster(parameters, name, context)) for name in ("A", "B")]
        return surfaces, {
            "out": folder, "geoid": self.file(parameters, "GEOID", context),
            "overwrite": self.parameterAsBool(parameters, OVERWRITE, context),
        }  # fmt: skip

    def answered(self, folder: str, answer: dict[str, Any]) -> dict[str, Any]:
        """The folder, the raster of the differences, and the page."""
        return {
            OUTPUT: folder, "DIFFERENCE": os.path.join(folder, COMPARISON[0].name), "PAGE": answer.get("page"),
        }  # fmt: skip
