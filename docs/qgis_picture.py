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
SHARE, DPI = 0.6, 110


def main() -> None:
    """Draw contours over relief in colours."""
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    sys.path.insert(0, str(HERE.parent / "qgis"))
    from qgis.core import QgsApplication

    from drawing import layer_of, picture

    surface, folder = sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else HERE / "pictures"
    application = QgsApplication([], False)
    application.initQgis()
    layers = [layer_of(surface, name) for name in ("contours.gpkg", "dsm.tif", "hillshade.tif")]
    extent = layers[1].extent()
    extent.scale(SHARE)
    if not picture(layers, extent, DPI).save(str(folder / NAME)):
        sys.exit(f"{folder / NAME} cannot be written.")
    sys.stdout.flush()
    # QGIS's objects may outlive each other in a wrong order.
    os._exit(0)


if __name__ == "__main__":
    main()
