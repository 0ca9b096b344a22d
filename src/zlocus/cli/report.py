"""`zlocus report`: the page of a surface that is there."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from zlocus.cli.evaluate import (
    DEFAULT_SLOPES,
    Align,
    Classes,
    Coregister,
    Geoid,
    Margin,
    Slopes,
    Thresholds,
    judging,
)
from zlocus.core.errors import ConfigError


def report(
    out: Annotated[Path, typer.Argument(help="Folder of a surface.", metavar="OUT")],
    reference: Annotated[Path | None, typer.Option(help="Reference heights to compare with.", metavar="RASTER")] = None,
    classes: Classes = None,
    align: Align = False,
    coregister: Coregister = None,
    margin: Margin = 10.0,
    threshold: Thresholds = None,
    slopes: Slopes = DEFAULT_SLOPES,
    geoid: Geoid = None,
) -> None:
    """Make report.html of a surface again, with a reference where one is given."""
    check_about(reference, {"--classes": classes, "--align": align, "--coregister": coregister, "--geoid": geoid})
    judged_by = judging(classes, align, coregister, margin, threshold, slopes, geoid)
    from zlocus.core.progress import SilentProgress
    from zlocus.pipeline.finished_record import ITEM, update_finished
    from zlocus.products.derived import link_all
    from zlocus.products.report.comparison import Comparison
    from zlocus.products.report.page import write_report

    comparison = None if reference is None else Comparison(reference, **judged_by)
    path = write_report(out, comparison)
    link_all(out, SilentProgress())
    update_finished(out, (path.name, ITEM))
    print(f"{path}: open it in a browser.")


def check_about(reference: Path | None, about: dict[str, Any]) -> None:
    """Refuse what says how to compare with a reference where there is none. about : values by option.

    Raises
    ------
    ConfigError
        One is given without a reference.
    """
    given = [name for name, value in about.items() if value]
    if reference is None and given:
        raise ConfigError(
            f"{given[0]} is about a reference, and none is given. Add --reference RASTER, or leave it out."
        )
