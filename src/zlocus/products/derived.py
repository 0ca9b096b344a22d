"""Products derived from a finished surface: terrain, hillshade, contours and points."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from zlocus.core.errors import ConfigError, ZlocusError
from zlocus.core.options import ProductOptions
from zlocus.core.progress import Progress
from zlocus.io.atomic_write import remove_earlier
from zlocus.io.styles.file_names import OF_SURFACE, remove_styles
from zlocus.products.contours import write_contours
from zlocus.products.dtm import write_dtm
from zlocus.products.hillshade import write_hillshade
from zlocus.products.metadata import METADATA, write_metadata
from zlocus.products.stac_item import write_item

# Files by the names of --products, in the order in which they are made: contours may need the terrain.
FILES = {
    "dtm": "dtm.tif", "hillshade": "hillshade.tif", "contours": "contours.gpkg", "laz": "surface.laz",
    "copc": "surface.copc.laz",
}  # fmt: skip


def write_derived(folder: Path, names: Collection[str], options: ProductOptions, progress: Progress) -> None:
    """Derive products from the rasters in a folder, each complete or not at all; where one fails, the others are made.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    ConfigError
        An option does not suit the surface.
    OutputError
        A file cannot be written.
    """
    check_derived(names, options, (folder / FILES["dtm"]).exists())
    wanted = [name for name in FILES if name in names]
    failures = []
    with progress.stage("Products", len(wanted)) as stage:
        for name in wanted:
            try:
                _MAKERS[name](folder, folder / FILES[name], options)
            except ZlocusError as error:
                failures.append(error)
            stage.advance()
    if failures:
        raise failures[0]


def link_all(folder: Path, progress: Progress) -> None:
    """Write the metadata of a surface, and the item that links all files of its folder, or note why there is none.

    Raises
    ------
    InputError, OutputError
        See `write_metadata` and `write_item`.
    """
    write_metadata(folder)
    if not write_item(folder):
        progress.note("No item.json: the frame is local, and STAC is about places on the Earth.")


def check_derived(names: Collection[str], options: ProductOptions, has_terrain: bool = False) -> None:
    """Refuse products that need a missing one, before any work. has_terrain : whether the folder holds a terrain.

    Raises
    ------
    ConfigError
        Contours of the terrain are wanted, and there is no terrain.
    """
    if "contours" in names and options.contours_of == "dtm" and "dtm" not in names and not has_terrain:
        raise ConfigError(
            "products.contours_of = 'dtm' draws contours of the terrain, which is not among the products. Add dtm to "
            "--products."
        )


def remove_derived(folder: Path) -> None:
    """Remove the derived products of an earlier run, before another surface takes its place.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    remove_earlier(folder, (*FILES.values(), METADATA, "item.json", "ranking.gpkg"))
    remove_styles(folder, OF_SURFACE)


def _hillshade(folder: Path, path: Path, options: ProductOptions) -> None:
    write_hillshade(folder / "dsm.tif", path, options)


def _dtm(folder: Path, path: Path, options: ProductOptions) -> None:
    write_dtm(folder / "dsm.tif", folder / "quality.tif", path, options)


def _contours(folder: Path, path: Path, options: ProductOptions) -> None:
    write_contours(folder / f"{options.contours_of}.tif", path, options)


def _laz(folder: Path, path: Path, options: ProductOptions) -> None:
    # Only this product and the next one need laspy.
    from zlocus.products.surface_points import write_surface_points

    write_surface_points(folder, path)


def _copc(folder: Path, path: Path, options: ProductOptions) -> None:
    from zlocus.products.surface_points import write_surface_copc

    write_surface_copc(folder, path)


_MAKERS: dict[str, Callable[[Path, Path, ProductOptions], None]] = {
    "dtm": _dtm, "hillshade": _hillshade, "contours": _contours, "laz": _laz, "copc": _copc,
}  # fmt: skip
