"""Picture of a surface in QGIS: `/usr/bin/python3 docs/qgis_picture.py SURFACE [FOLDER]`, by a Python that has QGIS.

SURFACE is the folder of the lesson `tutorials/delivery_to_contours.md`. Its layers are drawn as QGIS shows them when
they are added to a project: each in the style of its name that lies beside it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
NAME = "delivery_qgis.png"
# Part of the sides of the area, so that single houses and the labels of contours are seen.
SHARE, SIZE_PX, DPI = 0.6, 640, 110


def main() -> None:
    """Draw contours over relief in colours."""
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    from qgis.core import (
        QgsApplication,
        QgsMapRendererSequentialJob,
        QgsMapSettings,
        QgsRasterLayer,
        QgsVectorLayer,
    )
    from qgis.PyQt.QtCore import QSize
    from qgis.PyQt.QtGui import QColor

    surface, folder = Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else HERE / "pictures"
    application = QgsApplication([], False)
    application.initQgis()
    contours = QgsVectorLayer(str(surface / "contours.gpkg"), "contours")
    relief, heights = (QgsRasterLayer(str(surface / name), name) for name in ("hillshade.tif", "dsm.tif"))
    settings = QgsMapSettings()
    settings.setLayers([contours, heights, relief])
    settings.setDestinationCrs(heights.crs())
    extent = heights.extent()
    extent.scale(SHARE)
    settings.setExtent(extent)
    settings.setOutputSize(QSize(SIZE_PX, SIZE_PX))
    settings.setOutputDpi(DPI)
    settings.setBackgroundColor(QColor("white"))
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    if not job.renderedImage().save(str(folder / NAME)):
        sys.exit(f"{folder / NAME} cannot be written.")
    application.exitQgis()


if __name__ == "__main__":
    main()
