"""Products drawn by QGIS without a window, as it shows them when they are added to a project: in their styles.

Run by QGIS's own Python, for tests and for pictures of the documentation.
"""

from __future__ import annotations

import os

from qgis.core import (
    QgsLayerTreeModel,
    QgsLegendRenderer,
    QgsLegendSettings,
    QgsMapLayer,
    QgsMapRendererSequentialJob,
    QgsMapSettings,
    QgsPointCloudLayer,
    QgsProject,
    QgsRasterLayer,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QSize, Qt
from qgis.PyQt.QtGui import QColor, QImage, QPainter

SIZE_PX, DPI = 640, 96
VECTORS, CLOUDS = (".gpkg", ".geojson"), ("ept.json",)


def layer_of(folder: str, name: str) -> QgsMapLayer:
    """A file as a layer, as if it was dropped into the window."""
    path = os.path.join(folder, name)
    if name.endswith(VECTORS):
        layer = QgsVectorLayer(path, name)
    elif name.endswith(CLOUDS):
        layer = QgsPointCloudLayer(path, name, "ept")
    else:
        layer = QgsRasterLayer(path, name)
    assert layer.isValid(), path
    return layer


def picture(layers: list[QgsMapLayer], extent: QgsRectangle, dpi: int = DPI) -> QImage:
    """A map of layers, the first one on top. extent : in the CRS of the first one."""
    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setDestinationCrs(layers[0].crs())
    settings.setExtent(extent)
    settings.setOutputSize(QSize(SIZE_PX, SIZE_PX))
    settings.setOutputDpi(dpi)
    settings.setBackgroundColor(QColor("white"))
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    return job.renderedImage()


def legend(layer: QgsMapLayer) -> tuple[QImage, list[str]]:
    """The legend of a layer as a picture, and its texts."""
    project = QgsProject()
    project.addMapLayer(layer.clone())
    model = QgsLayerTreeModel(project.layerTreeRoot())
    renderer = QgsLegendRenderer(model, QgsLegendSettings())
    size = renderer.minimumSize()
    image = QImage(int(size.width() * 4) + 8, int(size.height() * 4) + 8, QImage.Format_RGB32)
    image.fill(Qt.white)
    image.setDotsPerMeterX(4000)
    image.setDotsPerMeterY(4000)
    painter = QPainter(image)
    renderer.drawLegend(painter)
    painter.end()
    node = project.layerTreeRoot().findLayers()[0]
    return image, [str(part.data(Qt.DisplayRole) or "") for part in model.layerLegendNodes(node)]
