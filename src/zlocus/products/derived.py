"""What is made of a finished surface, as far as it is asked for: terrain, hillshade, contours, points."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path

from zlocus.core.errors import ConfigError, OutputError, ZlocusError
from zlocus.core.options import ProductOptions
from zlocus.core.progress import Progress
from zlocus.products.contours import write_contours
from zlocus.products.dtm import write_dtm
from zlocus.products.hillshade import write_hillshade
from zlocus.products.stac_item import write_item

# By the names of --products, in the order of making: contours may be those of the terrain.
FILES = {"dtm": "dtm.tif", "hillshade": "hillshade.tif", "contours": "contours.gpkg", "laz": "surface.laz"}


def make_maps(folder: Path, names: Collection[str], options: ProductOptions, progress: Progress) -> None:
    """Make products of the rasters in a folder, each whole or not at all, and the others where one fails.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    ConfigError
        An option does not suit the surface.
    OutputError
        A file cannot be written.
    """
    check_maps(names, options, (folder / FILES["dtm"]).exists())
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
    """The item that links all files of a folder, or a note why there is none.

    Raises
    ------
    InputError, OutputError
        As `write_item`.
    """
    if not write_item(folder):
        progress.note("No item.json: the frame is local, and STAC is about places on the Earth.")


def check_maps(names: Collection[str], options: ProductOptions, has_terrain: bool = False) -> None:
    """Refuse, before any work, products that need another. has_terrain : whether it is there already.

    Raises
    ------
    ConfigError
        Contours of a terrain that is not made.
    """
    if "contours" in names and options.contours_of == "dtm" and "dtm" not in names and not has_terrain:
        raise ConfigError(
            "products.contours_of = 'dtm' draws contours of the terrain, which is not among the products. Add dtm to "
            "--products."
        )


def remove_maps(folder: Path) -> None:
    """Remove what an earlier run made of its surface, before another surface takes its place.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    for name in (*FILES.values(), "item.json", "ranking.gpkg"):
        try:
            with suppress(FileNotFoundError):
                (folder / name).unlink()
        except OSError as error:
            raise OutputError(
                f"{folder / name} is of an earlier run and cannot be removed: {error.strerror}. Remove it, or choose "
                "another folder with -o."
            ) from error


def _hillshade(folder: Path, path: Path, options: ProductOptions) -> None:
    write_hillshade(folder / "dsm.tif", path, options)


def _dtm(folder: Path, path: Path, options: ProductOptions) -> None:
    write_dtm(folder / "dsm.tif", folder / "quality.tif", path, options)


def _contours(folder: Path, path: Path, options: ProductOptions) -> None:
    write_contours(folder / f"{options.contours_of}.tif", path, options)


def _laz(folder: Path, path: Path, options: ProductOptions) -> None:
    # laspy is not needed otherwise.
    from zlocus.products.surface_points import write_surface_points

    write_surface_points(folder, path)


_MAKERS: dict[str, Callable[[Path, Path, ProductOptions], None]] = {
    "dtm": _dtm, "hillshade": _hillshade, "contours": _contours, "laz": _laz,
}  # fmt: skip
