"""`zlocus evaluate`: options in, a table or JSON out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from zlocus.core.errors import ConfigError
from zlocus.core.requests import EVALUATION_FILES, check_output

DEFAULT_THRESHOLD_M = 1.0
# In the module of slopes too, which is slow to import.
DEFAULT_SLOPES = "5,15,30,45"


Classes = Annotated[
    Path | None,
    typer.Option(help="Classes on the reference's grid: 0-1 ground, 2 building, 3 tree.", metavar="RASTER"),
]
Align = Annotated[bool, typer.Option("--align", help="First find and remove the best shift; it is reported.")]
Coregister = Annotated[
    str | None, typer.Option(help="The same by slope and aspect (Nuth and Kääb 2011).", metavar="nuth-kaab")
]
Margin = Annotated[float, typer.Option(help="Rim of the reference left out, m.", metavar="M")]
Thresholds = Annotated[
    list[float] | None,
    typer.Option(help="An error below this is within, m; may be repeated. Default: 1.", metavar="M"),
]
Slopes = Annotated[
    str, typer.Option(help="Limits between bands of slope, degrees; none: no bands.", metavar="DEG,DEG...|none")
]
Geoid = Annotated[
    Path | None,
    typer.Option(help="Geoid's heights, added to heights above it: by CRS, else the reference's.", metavar="RASTER"),
]


def evaluate(
    dsm: Annotated[Path, typer.Argument(help="Surface to judge.", metavar="DSM")],
    reference: Annotated[Path, typer.Argument(help="Reference heights.", metavar="REFERENCE")],
    classes: Classes = None,
    align: Align = False,
    coregister: Coregister = None,
    margin: Margin = 10.0,
    threshold: Thresholds = None,
    slopes: Slopes = DEFAULT_SLOPES,
    geoid: Geoid = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Folder for figures, error map and histogram. Default: print.", metavar="OUT"),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace another evaluation in the output folder.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare a surface with a reference surface."""
    judged_by = judging(classes, align, coregister, margin, threshold, slopes, geoid)
    if out is not None:
        check_not_input(out, dsm, reference, classes, geoid)
        check_output(out, overwrite, EVALUATION_FILES, "evaluation")
    from zlocus.evaluation.evaluate import evaluate as compare
    from zlocus.evaluation.files import write_evaluation
    from zlocus.evaluation.table import evaluation_table

    evaluation = compare(dsm, reference, **judged_by)
    if out is not None:
        write_evaluation(out, evaluation)
    print(json.dumps(evaluation.as_dict(), indent=2) if as_json else evaluation_table(evaluation))


def check_not_input(out: Path, *inputs: Path | None) -> None:
    """Refuse to write over a raster that is to be read.

    Raises
    ------
    ConfigError
        An input is one of the files that the evaluation writes.
    """
    for path in inputs:
        if path is not None and path.name in EVALUATION_FILES and path.resolve().parent == out.resolve():
            raise ConfigError(f"{path} would be written over. Choose another folder with -o.")


def judging(
    classes: Path | None, align: bool, coregister: str | None, margin: float, threshold: list[float] | None,
    slopes: str, geoid: Path | None,
) -> dict[str, Any]:  # fmt: skip
    """The options as the arguments of `zlocus.evaluation.evaluate.evaluate`.

    Raises
    ------
    ConfigError
        Slopes that are no numbers.
    """
    first, *more = threshold or [DEFAULT_THRESHOLD_M]
    return {
        "classes": classes, "align": align, "margin_m": margin, "threshold_m": first, "more_thresholds_m": more,
        "slope_edges_deg": _slope_edges(slopes), "coregister": coregister, "geoid": geoid,
    }  # fmt: skip


def _slope_edges(text: str) -> tuple[float, ...]:
    if text == "none":
        return ()
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"--slopes {text} is no list of degrees. Give some like {DEFAULT_SLOPES}, or none."
        ) from error
