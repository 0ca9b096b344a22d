"""`zlocus products`: maps of a surface that is there already."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from zlocus.core.errors import ConfigError
from zlocus.core.options import ProductOptions
from zlocus.core.progress import progress_for
from zlocus.core.requests import PRODUCTS, check_output, product_names

PRODUCTS_HELP = f"Made of the surface: {', '.join(PRODUCTS)} (with commas between them), or none."


def products(
    out: Annotated[Path, typer.Argument(help="Folder of a surface made by `zlocus dsm`.", metavar="OUT")],
    names: Annotated[str, typer.Option("--products", help=PRODUCTS_HELP, metavar="LIST")] = ",".join(PRODUCTS),
    config: Annotated[
        Path | None, typer.Option(help="Options of every stage. Default: those of the run.", metavar="FILE")
    ] = None,
) -> None:
    """Make maps of a surface that is there already; those of the same name are replaced."""
    chosen = product_names(names)
    check_output(out, overwrite=True)
    from zlocus.io.config import read_config
    from zlocus.io.open_raster import existing_file
    from zlocus.pipeline.finished_record import ITEM, update_finished
    from zlocus.products.derived import FILES, link_all, make_maps

    existing_file(out / "dsm.tif", "surface")
    options = run_options(out / "run.json") if config is None else read_config(config).products
    progress = progress_for(sys.stderr)
    make_maps(out, chosen, options, progress)
    link_all(out, progress)
    update_finished(out, (*(FILES[name] for name in chosen), ITEM))
    print(f"{out}: {', '.join(FILES[name] for name in chosen) or 'no map'} made.")


def run_options(record: Path) -> ProductOptions:
    """The options of products with which a run was made, by its run.json; where there is none, those by default.

    Raises
    ------
    InputError
        It is damaged.
    ConfigError
        It holds options that are none here.
    """
    from zlocus.io.config import config_from_dict
    from zlocus.io.run_record import read_record

    if not record.exists():
        return ProductOptions()
    found: Any = read_record(record)
    for name in ("config", "options", "products"):
        found = found.get(name, {}) if isinstance(found, dict) else {}
    try:
        return config_from_dict({"products": found}, str(record)).products
    except ConfigError as error:
        raise ConfigError(f"{error} Or give the options with --config.") from error
