"""Pictures of a surface in QGIS: `/usr/bin/python3 docs/qgis_picture.py SURFACE [FOLDER]`, by a Python that has QGIS.

SURFACE is the folder of the lesson `tutorials/delivery_to_contours.md`. Its layers are drawn as QGIS shows them when
they are added to a project: each in the style of its name that lies beside it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
DELIVERY, STYLES = "delivery_qgis.png", "qgis.png"
# Part of the sides of the area, so that single houses and the labels of contours are seen.
SHARE, DPI, MARGIN_PX = 0.6, 110, 12


def main() -> None:
    """Draw contours over relief in colours, and the reasons of the same place with their legend."""
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    sys.path.insert(0, str(HERE.parent / "qgis"))
    from qgis.core import QgsApplication

    from drawing import layer_of, legend, picture

    surface, folder = sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else HERE / "pictures"
    application = QgsApplication([], False)
    application.initQgis()
    layers = [layer_of(surface, name) for name in ("contours.gpkg", "dsm.tif", "hillshade.tif")]
    extent = layers[1].extent()
    extent.scale(SHARE)
    relief = picture(layers, extent, DPI)
    reasons = layer_of(surface, "reasons.vrt")
    beside = _beside([relief, picture([reasons], extent, DPI), legend(reasons)[0]])
    for image, name in ((relief, DELIVERY), (beside, STYLES)):
        if not image.save(str(folder / name)):
            sys.exit(f"{folder / name} cannot be written.")
    # QGIS's objects may outlive each other in a wrong order.
    os._exit(0)


def _beside(images: list) -> object:
    """Pictures in a row, on white."""
    from qgis.PyQt.QtCore import Qt
    from qgis.PyQt.QtGui import QImage, QPainter

    width = sum(image.width() + MARGIN_PX for image in images)
    row = QImage(width, max(image.height() for image in images), QImage.Format_RGB32)
    row.fill(Qt.white)
    painter, x = QPainter(row), 0
    for image in images:
        # Pictures have a size in millimetres too, which may differ.
        image.setDotsPerMeterX(row.dotsPerMeterX())
        image.setDotsPerMeterY(row.dotsPerMeterY())
        painter.drawImage(x, 0, image)
        x += image.width() + MARGIN_PX
    painter.end()
    return row


if __name__ == "__main__":
    main()
