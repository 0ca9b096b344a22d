"""What the algorithms share: parameters, the run of the command, and its results."""

from __future__ import annotations

import hashlib
import os
import tempfile
from typing import Any, Callable, Mapping, Sequence

from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import (
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterString,
    QgsVectorFileWriter,
    QgsVectorLayer,
)
from qgis.PyQt.QtGui import QIcon

from .layers import load_on_completion
from .process import Ended, Watcher, run_command
from .progress import CommandProgress
from .results import ShownFile, shown_files
from .words import WrongValue, command_line, found_command, own_environment

COMMAND_SETTING = "ZLOCUS_COMMAND"
OUTPUT, OPTIONS, OVERWRITE, LOAD = "OUTPUT", "OPTIONS", "OVERWRITE", "LOAD"


class FeedbackWatcher(Watcher):
    """Shows what the command says in the dialog of an algorithm."""

    def __init__(self, feedback: QgsProcessingFeedback) -> None:
        self._feedback = feedback

    def is_canceled(self) -> bool:
        return bool(self._feedback.isCanceled())

    def say(self, line: str) -> None:
        self._feedback.pushInfo(line)

    def warn(self, line: str) -> None:
        self._feedback.pushWarning(line)

    def set_percent(self, percent: float) -> None:
        self._feedback.setProgress(percent)


class ZlocusAlgorithm(QgsProcessingAlgorithm):
    """An algorithm that runs a command of zlocus. Subclasses say the words of its command line."""

    COMMAND = ""
    TITLE = ""
    HELP = ""
    # What is loaded, and whether a folder of tiles can be resumed.
    SHOWN: tuple[ShownFile, ...] = ()
    IS_SURFACE = False

    def createInstance(self) -> ZlocusAlgorithm:
        return type(self)()

    def name(self) -> str:
        return self.COMMAND

    def displayName(self) -> str:
        return self.TITLE

    def shortHelpString(self) -> str:
        return self.HELP

    def icon(self) -> QIcon:
        return QIcon(os.path.join(os.path.dirname(__file__), "icon.svg"))

    def words(
        self, parameters: dict[str, Any], context: QgsProcessingContext, folder: str
    ) -> tuple[Sequence[str], Mapping[str, Any]]:
        """Arguments and options of the command, without those that all commands have. folder : of the result.

        Raises
        ------
        WrongValue
            A value that cannot be used.
        """
        raise NotImplementedError

    def folder(self, parameters: dict[str, Any], context: QgsProcessingContext) -> str:
        """The folder of the result."""
        return str(self.parameterAsFileOutput(parameters, OUTPUT, context))

    def answered(self, folder: str, answer: dict[str, Any]) -> dict[str, Any]:
        """The outputs of the algorithm, from what the command answered."""
        return {OUTPUT: folder}

    def sentences(self, answer: dict[str, Any]) -> list[str]:
        """What the log says at the end, from what the command answered."""
        return []

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run the command, as QGIS asks for it."""
        folder = self.folder(parameters, context)
        try:
            program = found_command(str(ProcessingConfig.getSetting(COMMAND_SETTING) or ""))
            arguments, options = self.words(parameters, context, folder)
            more = self.parameterAsString(parameters, OPTIONS, context)
            words = command_line(program, self.COMMAND, arguments, options, more)
        except WrongValue as error:
            raise QgsProcessingException(str(error)) from error
        feedback.pushCommandInfo(" ".join(words))
        progress = CommandProgress(folder, self.IS_SURFACE)
        ended = run_command(words, own_environment(os.environ), FeedbackWatcher(feedback), progress)
        if ended.was_stopped:
            return self._stopped(ended, folder, feedback)
        if ended.error:
            raise QgsProcessingException(ended.error)
        feedback.setProgress(100)
        for sentence in self.sentences(ended.answer):
            feedback.pushInfo(sentence)
        if self.parameterAsBool(parameters, LOAD, context):
            load_on_completion(context, folder, shown_files(folder, self.SHOWN))
        return self.answered(folder, ended.answer)

    def _stopped(self, ended: Ended, folder: str, feedback: QgsProcessingFeedback) -> dict[str, Any]:
        feedback.pushInfo(ended.error)
        if self.IS_SURFACE:
            feedback.pushInfo(
                f"Finished tiles are kept in {folder}. Run the algorithm again with the same values to resume."
            )
        return {}

    def add(self, parameter: QgsProcessingParameterDefinition, is_advanced: bool = False, help_text: str = "") -> None:
        """Add a parameter."""
        if is_advanced:
            parameter.setFlags(parameter.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
        if help_text:
            parameter.setHelp(help_text)
        self.addParameter(parameter)

    def add_shared(self, has_overwrite: bool = True) -> None:
        """Add the parameters that all algorithms have."""
        if has_overwrite:
            text = "Replace another result in the folder"
            self.add(QgsProcessingParameterBoolean(OVERWRITE, text, False))
        self.add(QgsProcessingParameterBoolean(LOAD, "Load the results with their styles", True))
        text = f"Additional options of zlocus {self.COMMAND}"
        self.add(QgsProcessingParameterString(OPTIONS, text, "", optional=True), is_advanced=True)

    def number(self, parameters: dict[str, Any], name: str, context: QgsProcessingContext) -> float | None:
        """A number; None where none is given."""
        return None if is_empty(parameters.get(name)) else float(self.parameterAsDouble(parameters, name, context))

    def choice(self, parameters: dict[str, Any], name: str, choices: Sequence[str], context: Any) -> str | None:
        """The chosen one of several words; None for the first, which is what the command does by itself."""
        number = self.parameterAsEnum(parameters, name, context)
        return choices[number] if number else None

    def file(self, parameters: dict[str, Any], name: str, context: QgsProcessingContext) -> str:
        """A file or folder; "" where none is given."""
        return "" if is_empty(parameters.get(name)) else str(self.parameterAsFile(parameters, name, context))

    def raster(self, parameters: dict[str, Any], name: str, context: QgsProcessingContext) -> str:
        """The file of a raster layer; "" where none is given.

        Raises
        ------
        WrongValue
            The layer is not of a file.
        """
        layer = self._layer(parameters, name, "raster", lambda: self.parameterAsRasterLayer(parameters, name, context))
        if layer is None:
            return ""
        if layer.providerType() != "gdal" or not os.path.isfile(layer.source()):
            raise WrongValue(f"The layer {layer.name()} is not of a raster file. Save it as a GeoTIFF first.")
        return str(layer.source())

    def polygons(self, parameters: dict[str, Any], name: str, context: QgsProcessingContext) -> str:
        """The file of a vector layer, which is written where the layer is no file of one layer; "" where none is given.

        Raises
        ------
        WrongValue
            The layer cannot be opened or written.
        """
        layer = self._layer(
            parameters, name, "vector layer", lambda: self.parameterAsVectorLayer(parameters, name, context)
        )
        return "" if layer is None else file_of(layer, context)

    def _layer(self, parameters: dict[str, Any], name: str, kind: str, opened: Callable[[], Any]) -> Any:
        """A layer; None where none is given. opened : the layer as QGIS opens it, None where it cannot.

        Raises
        ------
        WrongValue
            The layer cannot be opened.
        """
        if is_empty(parameters.get(name)):
            return None
        layer = opened()
        if layer is None:
            raise WrongValue(f"{parameters[name]} cannot be opened as a {kind}. Check the path.")
        return layer


def is_empty(value: Any) -> bool:
    """Whether a value of a dialog is none."""
    return value is None or value == ""


def file_of(layer: QgsVectorLayer, context: QgsProcessingContext) -> str:
    """The file of a vector layer. A layer of a database, of several in a file, or of chosen features is written.

    Such a copy is named after its content and kept in the folder of the user's settings, so that a run that is resumed
    or made again finds it.
    """
    path = layer.source().split("|")[0]
    is_file = layer.providerType() == "ogr" and os.path.isfile(path)
    if is_file and not layer.subsetString() and len(layer.dataProvider().subLayers()) <= 1:
        return path
    options = QgsVectorFileWriter.SaveVectorOptions()
    options.driverName, options.layerName, options.fileEncoding = "GeoJSON", "polygons", "UTF-8"
    options.layerOptions = ["COORDINATE_PRECISION=10", "WRITE_NAME=NO"]
    folder = os.path.join(QgsApplication.qgisSettingsDirPath(), "zlocus")
    os.makedirs(folder, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as place:
        written = os.path.join(place, "layer.geojson")
        found = QgsVectorFileWriter.writeAsVectorFormatV3(layer, written, context.transformContext(), options)
        if found[0] != QgsVectorFileWriter.NoError:
            raise WrongValue(f"The layer {layer.name()} cannot be written: {found[1]}. Save it as a GeoPackage first.")
        with open(written, "rb") as file:
            digest = hashlib.sha256(file.read()).hexdigest()
        kept = os.path.join(folder, f"{digest[:16]}.geojson")
        # The time of change of a file is part of what a run depends on.
        if not os.path.exists(kept):
            os.replace(written, kept)
    return kept


def crs_words(crs: QgsCoordinateReferenceSystem) -> str:
    """A CRS as the command reads it: its code, or WKT where it has none that others know."""
    authority = crs.authid()
    if authority and not authority.startswith("USER:"):
        return str(authority)
    return str(crs.toWkt(QgsCoordinateReferenceSystem.WKT_PREFERRED))
