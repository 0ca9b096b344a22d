"""`zlocus evaluate`: options in, a table or JSON out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from zlocus.errors import ConfigError
from zlocus.request import check_output

DEFAULT_THRESHOLD_M = 1.0
# In the module of slopes too, which is slow to import.
DEFAULT_SLOPES = "5,15,30,45"


Classes = Annotated[
    Path | None,
    typer.Option(help="Classes on the reference's grid: 0-1 ground, 2 building, 3 tree.", metavar="RASTER"),
]
Align = Annotated[bool, typer.Option("--align", help="First find and remove the best shift; it is reported.")]
Margin = Annotated[float, typer.Option(help="Rim of the reference left out, m.", metavar="M")]


def evaluate(
    dsm: Annotated[Path, typer.Argument(help="Surface to judge.", metavar="DSM")],
    reference: Annotated[Path, typer.Argument(help="Reference heights.", metavar="REFERENCE")],
    classes: Classes = None,
    align: Align = False,
    coregister: Annotated[
        str | None,
        typer.Option(help="The same by slope and aspect (Nuth and Kääb 2011).", metavar="nuth-kaab"),
    ] = None,
    margin: Margin = 10.0,
    threshold: Annotated[
        list[float] | None,
        typer.Option(help="An error below this is within, m; may be repeated. Default: 1.", metavar="M"),
    ] = None,
    slopes: Annotated[
        str, typer.Option(help="Limits between bands of slope, degrees; none: no bands.", metavar="DEG,DEG...|none")
    ] = DEFAULT_SLOPES,
    geoid: Annotated[
        Path | None,
        typer.Option(
            help="Geoid's heights, added to heights above it: by CRS, else the reference's.", metavar="RASTER"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Folder for figures, error map and histogram. Default: print.", metavar="OUT"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare a surface with a reference surface."""
    edges = _slope_edges(slopes)
    thresholds = threshold or [DEFAULT_THRESHOLD_M]
    if out is not None:
        # It writes no file that a run does.
        check_output(out, overwrite=True)
    from zlocus.evaluation.evaluate import evaluate as compare
    from zlocus.evaluation.files import check_not_input, write_evaluation
    from zlocus.evaluation.table import evaluation_table

    if out is not None:
        check_not_input(out, dsm, reference, classes, geoid)
    evaluation = compare(
        dsm, reference, classes=classes, align=align, margin_m=margin, threshold_m=thresholds[0],
        more_thresholds_m=thresholds[1:], slope_edges_deg=edges, coregister=coregister, geoid=geoid,
    )  # fmt: skip
    if out is not None:
        write_evaluation(out, evaluation)
    print(json.dumps(evaluation.as_dict(), indent=2) if as_json else evaluation_table(evaluation))


def _slope_edges(text: str) -> tuple[float, ...]:
    if text == "none":
        return ()
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"--slopes {text} is no list of degrees. Give some like {DEFAULT_SLOPES}, or none."
        ) from error
