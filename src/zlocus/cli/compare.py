"""`zlocus compare`: two runs, two surfaces, or one of each, side by side on one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.evaluate import Geoid
from zlocus.core.errors import ConfigError
from zlocus.core.requests import COMPARISON_FILES, check_output

SURFACE = "Folder that `zlocus dsm` wrote, or a raster of heights"


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Arguments and options of `zlocus compare`."""

    first: Annotated[Path, typer.Argument(help=f"{SURFACE}, whose grid is that of the comparison.", metavar="A")]
    second: Annotated[Path, typer.Argument(help=f"{SURFACE}.", metavar="B")]
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the page and the raster of the differences.")] = (
        Path("comparison")
    )
    geoid: Geoid = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace another comparison in the output folder.")] = (
        False
    )


def compare(options: CompareOptions, console: Console) -> Answer:
    """Compare two runs or two surfaces: heights, options, times and cameras, on one page."""
    for path in (options.first, options.second):
        if path.name in COMPARISON_FILES and path.resolve().parent == options.out.resolve():
            raise ConfigError(f"{path} would be written over. Choose another folder with -o.")
    check_output(options.out, options.overwrite, COMPARISON_FILES, "comparison")
    with console.progress.stage("Comparing"):
        from zlocus.products.other_styles import write_other_styles
        from zlocus.products.report.compare_page import (
            compared_runs,
            comparison_text,
            comparison_values,
            write_comparison,
        )

        comparison = compared_runs(options.first, options.second, options.geoid)
        page = write_comparison(options.out, comparison)
        write_other_styles(options.out, COMPARISON_FILES)
    text = [*comparison_text(comparison), f"{page}: open it in a browser."]
    return Answer("\n".join(text), {"page": str(page), **comparison_values(comparison)}, is_asked_for=True)
