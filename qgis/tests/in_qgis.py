"""Run by QGIS's own Python: draws layers with their styles, loads results into a project, cancels a run.

draw FOLDER OUT | load FOLDER | cancel OUT IMAGE... The last line that is printed is an object of JSON.
"""

from __future__ import annotations

import json
import os
import sys
import time

from qgis.core import (
    QgsApplication,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProject,
)

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
from drawing import CLOUDS, VECTORS, layer_of, legend, picture

LONG_S = 60.0


def begin():
    """QGIS with Processing and the plugin."""
    QgsApplication.setPrefixPath("/usr", True)
    application = QgsApplication([], False)
    application.initQgis()
    sys.path += [os.path.join(QgsApplication.pkgDataPath(), "python", "plugins"), os.environ["QGIS_PLUGINPATH"]]
    from processing.core.Processing import Processing

    Processing.initialize()
    import zlocus_processing

    plugin = zlocus_processing.classFactory(None)
    plugin.initProcessing()
    return application, plugin


def n_colours(image):
    """Number of different colours of a picture, counted on every fourth pixel."""
    return len({image.pixel(x, y) for x in range(0, image.width(), 4) for y in range(0, image.height(), 4)})


def draw(folder, out):
    """Draw all products of a folder and of those in it with their styles; say how, and what their legends say."""
    os.makedirs(out, exist_ok=True)
    found = {}
    for name in names_in(folder):
        layer = layer_of(folder, name)
        stem = os.path.splitext(os.path.join(folder, name))[0]
        extent = layer.extent()
        extent.scale(1.05)
        file = os.path.join(out, name.replace(os.sep, "_"))
        drawn = picture([layer], extent)
        drawn.save(file + ".png")
        image, texts = legend(layer)
        image.save(file + ".legend.png")
        entry = {"renderer": layer.renderer().type(), "colours": n_colours(drawn), "legend": texts}
        if os.path.isfile(stem + ".qml"):
            entry["qml"] = layer.loadNamedStyle(stem + ".qml")
            entry["reloaded"] = picture([layer], extent) == drawn
        if os.path.isfile(stem + ".sld") and name.endswith(VECTORS):
            entry["sld"] = layer.loadSldStyle(stem + ".sld")
            by_sld = picture([layer], extent)
            by_sld.save(file + ".sld.png")
            entry["colours_by_sld"] = n_colours(by_sld)
        found[name] = entry
    if {"dsm.tif", "hillshade.tif"} <= set(found):
        relief = [layer_of(folder, name) for name in ("contours.gpkg", "dsm.tif", "hillshade.tif") if name in found]
        picture(relief, relief[-1].extent()).save(os.path.join(out, "relief.png"))
    return found


def names_in(folder):
    """Names of the products in a folder and in those in it, without the tiles of a run."""
    endings = (".tif", ".vrt", *VECTORS, *CLOUDS)
    return sorted(
        os.path.relpath(os.path.join(inner, name), folder)
        for inner, folders, names in os.walk(folder)
        for name in names
        if name.endswith(endings)
    )


def load(folder):
    """Compute maps with the algorithm, and load all layers as the window of QGIS does."""
    from processing.gui.Postprocessing import handleAlgorithmResults

    context, feedback = QgsProcessingContext(), QgsProcessingFeedback()
    project = QgsProject.instance()
    context.setProject(project)
    algorithm = QgsApplication.processingRegistry().algorithmById("zlocus:products").create()
    _, is_done = algorithm.run({"FOLDER": folder, "MAPS": [0, 1, 2]}, context, feedback)
    assert is_done, feedback.textLog()
    assert handleAlgorithmResults(algorithm, context, feedback)
    layers = project.layerTreeRoot().findLayers()
    return {
        "groups": [group.name() for group in project.layerTreeRoot().findGroups()],
        "layers": [node.name() for node in layers],
        "visible": [node.name() for node in layers if node.itemVisibilityChecked()],
        "renderers": [node.layer().renderer().type() for node in layers],
        "percent": feedback.progress(),
    }


class Cancelling(QgsProcessingFeedback):
    """Cancels once a line begins in a given way."""

    def __init__(self, beginning):
        super().__init__()
        self.beginning, self.lines, self.percents = beginning, [], []

    def pushInfo(self, line):
        self.lines.append(line)
        if self.beginning and line.startswith(self.beginning):
            self.cancel()


def cancel(out, *images):
    """Cancel a run, and run it to its end afterwards."""
    algorithm = QgsApplication.processingRegistry().algorithmById("zlocus:dsm").create()
    values = {"INPUT": list(images), "RESOLUTION": 0.5, "OUTPUT": out, "OPTIONS": "--set pyramid.tile=64"}
    found = {}
    for name, beginning in (("first", "Plan:"), ("second", "")):
        feedback, context = Cancelling(beginning), QgsProcessingContext()
        begun = time.monotonic()
        try:
            results, is_done = algorithm.run(values, context, feedback)
            error = ""
        except QgsProcessingException as raised:
            results, is_done, error = {}, False, str(raised)
        found[name] = {
            "results": results, "done": is_done, "lines": feedback.lines, "error": error,
            "seconds": time.monotonic() - begun, "files": sorted(os.listdir(out)) if os.path.isdir(out) else [],
        }  # fmt: skip
    return found


if __name__ == "__main__":
    application, plugin = begin()
    answer = {"draw": draw, "load": load, "cancel": cancel}[sys.argv[1]](*sys.argv[2:])
    print(json.dumps(answer), flush=True)
    # QGIS's objects may outlive each other in a wrong order.
    os._exit(0)
