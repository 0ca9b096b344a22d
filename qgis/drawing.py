"""Products drawn by QGIS without a window, as it shows them when they are added to a project: in their styles.

Run by QGIS's own Python, for tests and for pictures of the documentation.
"""

from __future__ import annotations

import os

from qgis.core import (
    QgsMapLayer,
    QgsMapRendererSequentialJob,
    QgsMapSettings,
    QgsPointCloudLayer,
    QgsRasterLayer,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor, QImage

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
