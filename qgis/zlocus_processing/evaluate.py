"""Judge a surface: `zlocus evaluate`."""

from __future__ import annotations

import os
from typing import Any, Mapping, Sequence

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterLayer,
)

from .algorithm import OUTPUT, OVERWRITE, ZlocusAlgorithm, is_empty
from .results import EVALUATION
from .words import WrongValue, figures_in_words

ALIGNMENTS = ("none", "search", "nuth-kaab")
ALIGNMENT_NAMES = ("as it lies", "best shift removed, found by a search", "best shift removed, by Nuth and Kääb (2011)")
# Outputs that are numbers, by the names of the figures.
FIGURES = {"RMSE": "rmse", "MEDIAN": "median", "NMAD": "nmad", "LE90": "le90", "COMPLETENESS": "completeness"}


class Evaluate(ZlocusAlgorithm):
    """A surface against reference heights."""

    COMMAND = "evaluate"
    TITLE = "Evaluate a surface"
    SHOWN = EVALUATION
    HELP = (
        "Compares a surface with a raster of reference heights, or with points (CSV, GeoPackage, GeoJSON, Parquet) or "
        "laser clouds (LAS, LAZ, COPC). The folder of the result holds the figures (evaluation.json), a map of the "
        "errors and their histogram."
    )

    def initAlgorithm(self, configuration: Mapping[str, Any] | None = None) -> None:
        optional: dict[str, Any] = {"optional": True}
        number, raster = QgsProcessingParameterNumber, QgsProcessingParameterRasterLayer
        self.add(raster("DSM", "Surface"))
        self.add(raster("REFERENCE", "Reference heights", **optional))
        self.add(QgsProcessingParameterMultipleLayers(
            "POINTS", "or points or laser clouds", QgsProcessing.TypeFile, **optional
        ))  # fmt: skip
        self.add(QgsProcessingParameterEnum("ALIGNMENT", "Main figures", ALIGNMENT_NAMES, defaultValue=0))
        self.add(number("THRESHOLD", "Share of errors below this, m", number.Double, 1.0, minValue=0.0))
        self.add(number("MARGIN", "Rim of the reference that is left out, m", number.Double, 10.0, minValue=0.0))
        self.add(QgsProcessingParameterFolderDestination(OUTPUT, "Folder of the result"))
        self.add(raster("CLASSES", "Classes on the grid of the reference", **optional), is_advanced=True)
        self.add(QgsProcessingParameterFile("GEOID", "Geoid raster", **optional), is_advanced=True)
        self.add(QgsProcessingParameterBoolean(OVERWRITE, "Replace another evaluation in the folder", False))
        self.add_shared(has_overwrite=False)
        self.addOutput(QgsProcessingOutputRasterLayer("ERROR", "Errors"))
        for name in FIGURES:
            self.addOutput(QgsProcessingOutputNumber(name, name))

    def words(
        self, parameters: dict[str, Any], context: QgsProcessingContext, folder: str
    ) -> tuple[Sequence[str], Mapping[str, Any]]:
        """Surface, references and options of `zlocus evaluate`."""
        reference = self.raster(parameters, "REFERENCE", context)
        points = [] if is_empty(parameters.get("POINTS")) else self.parameterAsFileList(parameters, "POINTS", context)
        if bool(reference) == bool(points):
            given = "both are given" if points else "neither is given"
            raise WrongValue(f"The reference is a raster or points, and {given}. Give one of them.")
        alignment = self.choice(parameters, "ALIGNMENT", ALIGNMENTS, context)
        return [self.raster(parameters, "DSM", context), *([reference] if reference else points)], {
            "out": folder, "align": alignment == "search",
            "coregister": alignment if alignment == "nuth-kaab" else None,
            "threshold": self.number(parameters, "THRESHOLD", context),
            "margin": self.number(parameters, "MARGIN", context),
            "classes": self.raster(parameters, "CLASSES", context), "geoid": self.file(parameters, "GEOID", context),
            "overwrite": self.parameterAsBool(parameters, OVERWRITE, context),
        }  # fmt: skip

    def sentences(self, answer: dict[str, Any]) -> list[str]:
        """The main figures."""
        return [figures_in_words(answer.get("all") or {})]

    def answered(self, folder: str, answer: dict[str, Any]) -> dict[str, Any]:
        """The folder, the map of the errors, and the main figures."""
        figures = answer.get("all") or {}
        found: dict[str, Any] = {name: figures.get(figure) for name, figure in FIGURES.items()}
        error = os.path.join(folder, EVALUATION[0].name)
        return {OUTPUT: folder, **({"ERROR": error} if os.path.isfile(error) else {}), **found}
