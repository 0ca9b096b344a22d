"""`zlocus report`: report.html of a finished surface."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.evaluate import ComparisonOptions
from zlocus.cli.shared_options import Reference, SurfaceFolderArgument
from zlocus.core.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class ReportOptions(ComparisonOptions):
    """Arguments and options of `zlocus report`."""

    out: SurfaceFolderArgument
    reference: Reference = None


def report(options: ReportOptions, console: Console) -> Answer:
    """Make report.html of a surface again.

    With --reference, the report compares the surface with it; the other options say how.
    """
    check_reference(
        options.reference,
        {
            "--classes": options.classes, "--align": options.align, "--coregister": options.coregister,
            "--geoid": options.geoid,
        },
    )  # fmt: skip
    arguments = options.arguments()
    from zlocus.evaluation.comparison import Comparison
    from zlocus.pipeline.finished_record import ITEM, update_finished
    from zlocus.products.derived import link_all
    from zlocus.products.metadata import METADATA
    from zlocus.products.report.page import write_report

    comparison = None if options.reference is None else Comparison(options.reference, **arguments)
    with console.progress.stage("Report" if comparison is None else "Comparing, and making the report"):
        path = write_report(options.out, comparison)
    link_all(options.out, console.progress)
    update_finished(options.out, (path.name, ITEM, METADATA))
    return Answer(f"{path}: open it in a browser.", {"report": str(path)})


def check_reference(reference: Path | None, options: dict[str, Any]) -> None:
    """Refuse options that say how to compare with a reference where there is no reference.

    options : values by name of the option.

    Raises
    ------
    ConfigError
        Such an option is given without a reference.
    """
    given = [name for name, value in options.items() if value]
    if reference is None and given:
        raise ConfigError(
            f"{given[0]} is about a reference, and none is given. Add --reference RASTER, or leave it out."
        )
