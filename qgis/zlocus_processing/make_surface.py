"""Make a surface: `zlocus dsm`."""

from __future__ import annotations

import os
from typing import Any, Mapping, Sequence

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterEnum,
    QgsProcessingParameterExtent,
    QgsProcessingParameterField,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterLayer,
    QgsProcessingParameterVectorLayer,
)

from .algorithm import OUTPUT, OVERWRITE, ZlocusAlgorithm, crs_words, is_empty
from .results import SURFACE
from .words import inputs_of, pair_of, utm_zone

DATUMS = ("ellipsoid", "egm96", "egm2008")
METHODS = ("mvll-sgm", "mvll", "gc3-sgm")
METHOD_NAMES = (
    "ground grid with semi-global constraint (mvll-sgm)", "ground grid, cell by cell (mvll)",
    "image space with semi-global constraint (gc3-sgm)",
)  # fmt: skip
FILLS = ("none", "interpolate", "dem")
MAPS = ("contours", "dtm", "laz", "copc")
MAP_NAMES = ("contours", "terrain without buildings and trees", "points (LAZ)", "points (COPC)")
# Outputs that are rasters, by their names.
RASTERS = {"DSM": "dsm.tif", "SIGMA": "sigma.tif", "QUALITY": "quality.tif", "VIEWS": "views.tif", "ORTHO": "ortho.tif"}


class MakeSurface(ZlocusAlgorithm):
    """A surface from images."""

    COMMAND = "dsm"
    TITLE = "Make a surface from images"
    SHOWN = SURFACE
    IS_SURFACE = True
    HELP = (
        "Makes a digital surface model from two or more overlapping images with RPCs, from a scene.yaml, or from the "
        "folder or archive that a vendor sent. The folder of the result holds heights and their standard deviations, "
        "quality flags, number of images, an ortho-image, a report, and styles.\n\nA run that was cancelled resumes "
        "with the same values and the same folder."
    )

    def initAlgorithm(self, configuration: Mapping[str, Any] | None = None) -> None:
        optional: dict[str, Any] = {"optional": True}
        number = QgsProcessingParameterNumber
        self.add(
            QgsProcessingParameterMultipleLayers(
                "INPUT", "Images with RPCs, or a scene.yaml", QgsProcessing.TypeFile, **optional
            )
        )
        self.add(QgsProcessingParameterFile(
            "DELIVERY", "or the folder that a vendor sent", QgsProcessingParameterFile.Folder, **optional
        ))  # fmt: skip
        self.add(number("RESOLUTION", "Cell size, m (empty: as the images)", number.Double, minValue=0.0, **optional))
        self.add(QgsProcessingParameterExtent("EXTENT", "Extent (empty: all that two images see)", **optional))
        self.add(QgsProcessingParameterCrs("CRS", "Projected CRS (empty: UTM)", **optional))
        self.add(number("LOWEST", "Lowest height, m (empty: found from the images)", number.Double, **optional))
        self.add(number("HIGHEST", "Highest height, m", number.Double, **optional))
        self.add(QgsProcessingParameterEnum("VERTICAL", "Heights above", DATUMS, defaultValue=0))
        self.add(
            QgsProcessingParameterEnum("MAPS", "Maps beside the hillshade", MAP_NAMES, allowMultiple=True, **optional)
        )
        self.add(QgsProcessingParameterFolderDestination(OUTPUT, "Folder of the result"))
        self._add_advanced()
        self.add_shared()
        for name, file in RASTERS.items():
            self.addOutput(QgsProcessingOutputRasterLayer(name, file))
        self.addOutput(QgsProcessingOutputNumber("COVERAGE", "Share of the cells seen that have a height"))
        self.addOutput(QgsProcessingOutputFile("REPORT", "Report"))

    def _add_advanced(self) -> None:
        optional: dict[str, Any] = {"optional": True}
        number, file, vector = (
            QgsProcessingParameterNumber,
            QgsProcessingParameterFile,
            QgsProcessingParameterVectorLayer,
        )
        polygons = [QgsProcessing.TypeVectorPolygon]
        for parameter in (
            file("ARCHIVE", "Archive that a vendor sent, in place of images", **optional),
            file("GEOID", "Geoid raster, in place of the one above", **optional),
            vector("AREA", "Match only inside these polygons", polygons, **optional),
            vector("MASK", "Match nothing inside these polygons", polygons, **optional),
            vector("WATER", "Water: one level inside each of these polygons", polygons, **optional),
            QgsProcessingParameterField(
                "WATER_LEVEL", "Attribute with the level of the water, m (empty: found)",
                parentLayerParameterName="WATER", **optional,
            ),
            QgsProcessingParameterBoolean("LEVEL_WATER", "Level possible water too", False),
            QgsProcessingParameterRasterLayer("DEM", "Search only near the heights of this terrain model", **optional),
            QgsProcessingParameterEnum("METHOD", "Method", METHOD_NAMES, defaultValue=0),
            QgsProcessingParameterEnum("FILL", "Fill gaps", FILLS, defaultValue=0),
            number("WORKERS", "Tiles worked on at a time", number.Integer, minValue=1, **optional),
            number("MEMORY", "Memory limit, GB", number.Double, minValue=0.0, **optional),
            file("CONFIG", "File with options of every stage (zlocus config)", **optional),
            QgsProcessingParameterBoolean("PARTIAL", "Accept an incomplete result, and doubtful cameras", False),
        ):  # fmt: skip
            self.add(parameter, is_advanced=True)

    def words(
        self, parameters: dict[str, Any], context: QgsProcessingContext, folder: str
    ) -> tuple[Sequence[str], Mapping[str, Any]]:
        """Inputs and options of `zlocus dsm`."""
        images = [] if is_empty(parameters.get("INPUT")) else self.parameterAsFileList(parameters, "INPUT", context)
        delivery = self.file(parameters, "DELIVERY", context) or self.file(parameters, "ARCHIVE", context)
        crs, bounds = self._grid(parameters, context)
        heights = pair_of(
            self.number(parameters, "LOWEST", context), self.number(parameters, "HIGHEST", context), "heights"
        )
        workers, memory = (self.number(parameters, name, context) for name in ("WORKERS", "MEMORY"))
        maps = [] if is_empty(parameters.get("MAPS")) else self.parameterAsEnums(parameters, "MAPS", context)
        level = self.parameterAsFields(parameters, "WATER_LEVEL", context)
        return inputs_of(images, delivery), {
            "out": folder, "resolution": self.number(parameters, "RESOLUTION", context),
            "crs": crs, "bounds": bounds, "heights": heights,
            "vertical": self.file(parameters, "GEOID", context) or self.choice(parameters, "VERTICAL", DATUMS, context),
            "products": ",".join(MAPS[k] for k in maps), "area": self.polygons(parameters, "AREA", context),
            "mask": self.polygons(parameters, "MASK", context), "water": self.polygons(parameters, "WATER", context),
            "water-level": level[0] if level else None,
            "level-water": self.parameterAsBool(parameters, "LEVEL_WATER", context),
            "dem": self.raster(parameters, "DEM", context),
            "method": self.choice(parameters, "METHOD", METHODS, context),
            "fill": self.choice(parameters, "FILL", FILLS, context), "workers": workers and int(workers),
            "memory": memory, "config": self.file(parameters, "CONFIG", context),
            "partial": self.parameterAsBool(parameters, "PARTIAL", context),
            "overwrite": self.parameterAsBool(parameters, OVERWRITE, context),
        }  # fmt: skip

    def _grid(
        self, parameters: dict[str, Any], context: QgsProcessingContext
    ) -> tuple[str | None, tuple[float, ...] | None]:
        """The CRS and the bounds of the result. An extent without a CRS is in the UTM zone of its centre."""
        crs = self.parameterAsCrs(parameters, "CRS", context)
        words = crs_words(crs) if crs.isValid() else None
        if is_empty(parameters.get("EXTENT")):
            return words, None
        if words is None:
            degrees = QgsCoordinateReferenceSystem("EPSG:4326")
            middle = self.parameterAsExtent(parameters, "EXTENT", context, degrees).center()
            words = utm_zone(middle.x(), middle.y())
            crs = QgsCoordinateReferenceSystem(words)
        box = self.parameterAsExtent(parameters, "EXTENT", context, crs)
        return words, (box.xMinimum(), box.yMinimum(), box.xMaximum(), box.yMaximum())

    def sentences(self, answer: dict[str, Any]) -> list[str]:
        """How complete the surface is."""
        coverage = answer.get("coverage")
        if coverage is None:
            return []
        return [f"{100 * coverage:.1f} % of the cells seen by two images or more have a height."]

    def answered(self, folder: str, answer: dict[str, Any]) -> dict[str, Any]:
        """The folder, its rasters, the coverage and the report."""
        files = {name: os.path.join(folder, file) for name, file in {**RASTERS, "REPORT": "report.html"}.items()}
        there = {name: path for name, path in files.items() if os.path.isfile(path)}
        return {OUTPUT: folder, "COVERAGE": answer.get("coverage"), **there}
