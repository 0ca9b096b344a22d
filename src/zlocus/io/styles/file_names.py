"""Names of the style files beside a product."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from zlocus.io.atomic_write import remove_earlier

QML, SLD, TABLE = ".qml", ".sld", ".aux.xml"
# Point clouds, which no style of map servers can describe.
CLOUD = ".laz"
# Flags in groups, as a raster that GDAL makes of quality.tif when it is read.
REASONS = "reasons.vrt"
# Products of a surface that have a style, and the one that also has an attribute table and the groups of its flags.
OF_SURFACE = (
    "dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif", "hillshade.tif", "dtm.tif",
    "contours.gpkg", "surface.laz", "surface.copc.laz", "ties.gpkg", "ranking.gpkg", "footprints.geojson",
)  # fmt: skip
WITH_TABLE = "quality.tif"


def style_files(product: str) -> tuple[str, ...]:
    """Names of the files that say how a product is drawn: `dsm.qml` and `dsm.sld`; of flags also what they mean.

    A point cloud has a style for QGIS only. The flags of an image of a cloud, `NAME_quality.tif`, have
    `NAME_reasons.vrt`.
    """
    stem = Path(product).stem
    if product.endswith(CLOUD):
        return (f"{stem}{QML}",)
    is_flags = product.endswith(WITH_TABLE)
    of_flags = (f"{product}{TABLE}", f"{product.removesuffix(WITH_TABLE)}{REASONS}") if is_flags else ()
    return (f"{stem}{QML}", f"{stem}{SLD}", *of_flags)


def remove_styles(folder: Path, products: Iterable[str]) -> None:
    """Remove the style files of products, as far as there are any.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    remove_earlier(folder, (name for product in products for name in style_files(product)))
