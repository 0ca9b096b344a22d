"""`zlocus products`: maps of a finished surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import Settings, SurfaceFolderArgument
from zlocus.core.errors import ConfigError
from zlocus.core.options import ProductOptions
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
    settings: Settings = None


def products(options: ProductsOptions, console: Console) -> Answer:
    """Make maps of a finished surface, replacing earlier ones."""
    chosen = product_names(options.names)
    check_output(options.out, overwrite=True)
    from zlocus.io.open_raster import existing_file
    from zlocus.pipeline.finished_record import ITEM, update_finished
    from zlocus.products.derived import FILES, link_all, write_derived
    from zlocus.products.metadata import METADATA
    from zlocus.products.report.file_names import REPORT
    from zlocus.products.styles import write_styles

    existing_file(options.out / "dsm.tif", "surface")
    if options.config is None:
        product_options = run_options(options.out / "run.json", options.settings or ())
    else:
        product_options = config_of(options.config, options.settings).products
    progress = console.progress
    write_derived(options.out, chosen, product_options, progress)
    write_styles(options.out, product_options, [FILES[name] for name in chosen])
    link_all(options.out, progress)
    update_finished(options.out, (*(FILES[name] for name in chosen), ITEM, METADATA))
    made = [FILES[name] for name in chosen]
    shown = f" `zlocus report {options.out}` shows them." if made and (options.out / REPORT).exists() else ""
    return Answer(f"{options.out}: {', '.join(made) or 'no map'} made.{shown}", {"products": made})


def run_options(record: Path, settings: Sequence[str]) -> ProductOptions:
    """The product options with which a run was made, from its run.json; the default ones where there is none.

    settings : of --set, in place of single ones.

    Raises
    ------
    InputError
        It is damaged.
    ConfigError
        It holds options that are none here.
    """
    from zlocus.io.run_record import read_record
    from zlocus.io.settings import config_with_settings, with_settings

    if not record.exists():
        return config_with_settings(None, settings).products
    found: Any = read_record(record)
    for name in ("config", "options", "products"):
        found = found.get(name, {}) if isinstance(found, dict) else {}
    try:
        return with_settings({"products": found}, str(record), settings).products
    except ConfigError as error:
        raise ConfigError(f"{error} Or give the options with --config.") from error
