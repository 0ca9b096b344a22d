"""Names of the style files beside a product."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from zlocus.core.errors import OutputError

QML, SLD, TABLE = ".qml", ".sld", ".aux.xml"
# Flags in groups, as a raster that GDAL makes of quality.tif when it is read.
REASONS = "reasons.vrt"
# Products of a surface that have a style, and the one that also has an attribute table and the groups of its flags.
OF_SURFACE = (
    "dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif", "hillshade.tif", "dtm.tif",
    "contours.gpkg", "ties.gpkg", "ranking.gpkg",
)  # fmt: skip
WITH_TABLE = "quality.tif"


def style_files(product: str) -> tuple[str, ...]:
    """Names of the files that say how a product is drawn: `dsm.qml` and `dsm.sld`; of flags also what they mean."""
    stem = Path(product).stem
    of_flags = (f"{product}{TABLE}", REASONS) if product == WITH_TABLE else ()
    return (f"{stem}{QML}", f"{stem}{SLD}", *of_flags)


def remove_styles(folder: Path, products: Iterable[str]) -> None:
    """Remove the style files of products, as far as there are any.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    for name in (name for product in products for name in style_files(product)):
        try:
            with suppress(FileNotFoundError):
                (folder / name).unlink()
        except OSError as error:
            raise OutputError(
                f"{folder / name} is the style of an earlier result and cannot be removed: {error.strerror}. Remove "
                "it, or choose another folder with -o."
            ) from error
