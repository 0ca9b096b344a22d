"""`zlocus products`: maps of a finished surface."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from zlocus.cli.shared_options import SurfaceFolderArgument
from zlocus.core.errors import ConfigError
from zlocus.core.options import ProductOptions
from zlocus.core.progress import progress_for
from zlocus.core.requests import PRODUCTS, check_output, product_names

PRODUCTS_HELP = f"Maps to make: {', '.join(PRODUCTS)} (separated by commas), or none."


@dataclass(frozen=True)
class ProductsOptions:
    """Arguments and options of `zlocus products`."""

    out: SurfaceFolderArgument
    names: Annotated[str, typer.Option("--products", help=PRODUCTS_HELP, metavar="LIST")] = ",".join(PRODUCTS)
    config: Annotated[
        Path | None,
        typer.Option(help="File with options of every stage. Default: those of the run.", metavar="FILE"),
    ] = None


def products(options: ProductsOptions) -> None:
    """Make maps of a finished surface, replacing earlier ones."""
    chosen = product_names(options.names)
    check_output(options.out, overwrite=True)
    from zlocus.io.config import read_config
    from zlocus.io.open_raster import existing_file
    from zlocus.pipeline.finished_record import ITEM, update_finished
    from zlocus.products.derived import FILES, link_all, write_derived

    existing_file(options.out / "dsm.tif", "surface")
    product_options = (
        run_options(options.out / "run.json") if options.config is None else read_config(options.config).products
    )
    progress = progress_for(sys.stderr)
    write_derived(options.out, chosen, product_options, progress)
    link_all(options.out, progress)
    update_finished(options.out, (*(FILES[name] for name in chosen), ITEM))
    print(f"{options.out}: {', '.join(FILES[name] for name in chosen) or 'no map'} made.")


def run_options(record: Path) -> ProductOptions:
    """The product options with which a run was made, from its run.json; the default ones where there is none.

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
