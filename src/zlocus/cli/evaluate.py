"""`zlocus evaluate`: options in, a table or JSON out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.point_options import POINT_FILES, POINTS, PointFileOptions, check_for_points
from zlocus.core.errors import ConfigError, InputError
from zlocus.core.requests import EVALUATION_FILES, POINT_EVALUATION_FILES, check_output

DEFAULT_THRESHOLD_M = 1.0
# In the module of slopes too, which is slow to import.
DEFAULT_SLOPES = "5,15,30,45"


Classes = Annotated[
    Path | None,
    typer.Option(help="Raster of classes on the reference's grid: 0-1 ground, 2 building, 3 tree.", metavar="RASTER"),
]
Align = Annotated[
    bool,
    typer.Option("--align", help="Remove the best shift first, found by a search: aligned errors are the main ones."),
]
Coregister = Annotated[
    str | None,
    typer.Option(
        help="Like --align, but find the shift from slope and aspect (Nuth and Kääb 2011).", metavar="nuth-kaab"
    ),
]
Margin = Annotated[float, typer.Option(help="Width of the rim of the reference that is left out, m.", metavar="M")]
Thresholds = Annotated[
    list[float] | None,
    typer.Option(help="Report the share of errors below this, m; may be repeated. Default: 1.", metavar="M"),
]
Slopes = Annotated[
    str, typer.Option(help="Limits between slope bands, degrees; none: no bands.", metavar="DEG,DEG...|none")
]
Geoid = Annotated[
    Path | None,
    typer.Option(
        help="Geoid raster, added to the heights whose CRS is above a geoid, else to the reference.",
        metavar="RASTER",
    ),
]


@dataclass(frozen=True)
class ComparisonOptions:
    """How a surface is compared with reference heights, as several commands ask for it."""

    classes: Classes = None
    align: Align = False
    coregister: Coregister = None
    margin: Margin = 10.0
    threshold: Thresholds = None
    slopes: Slopes = DEFAULT_SLOPES
    geoid: Geoid = None

    def arguments(self) -> dict[str, Any]:
        """The options by the names that `zlocus.evaluation` gives them.

        Raises
        ------
        ConfigError
            Slopes that are not numbers.
        """
        first, *more = self.threshold or [DEFAULT_THRESHOLD_M]
        return {
            "classes": self.classes, "align": self.align, "margin_m": self.margin, "threshold_m": first,
            "more_thresholds_m": more, "slope_edges_deg": _slope_edges(self.slopes), "coregister": self.coregister,
            "geoid": self.geoid,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(PointFileOptions, ComparisonOptions):
    """Arguments and options of `zlocus evaluate`."""

    dsm: Annotated[Path, typer.Argument(help="Surface to be evaluated.", metavar="DSM")]
    references: Annotated[
        list[Path],
        typer.Argument(
            help=f"Reference heights: a raster, points ({POINT_FILES}), or several clouds.", metavar="REFERENCE"
        ),
    ]
    vegetated: Annotated[
        str | None,
        typer.Option(
            help="Kinds of ground of points that are vegetated, or none. Default: by their usual names.",
            metavar="NAME,NAME...", rich_help_panel=POINTS,
        ),
    ] = None  # fmt: skip
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Folder for figures, error map and histogram. Default: none; the table is printed.",
            metavar="OUT",
        ),
    ] = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace another evaluation in the output folder.")] = (
        False
    )


def evaluate(options: EvaluateOptions, console: Console) -> Answer:
    """Compare a surface with a reference surface, or with points."""
    arguments = options.arguments()
    if options.out is not None:
        check_not_input(options.out, options.dsm, *options.references, options.classes, options.geoid)
        names = tuple(dict.fromkeys([*EVALUATION_FILES, *POINT_EVALUATION_FILES]))
        check_output(options.out, options.overwrite, names, "evaluation")
    from zlocus.io.points.open_points import are_points

    if are_points(options.references):
        return _at_points(options, arguments, console)
    check_for_points([*options.given(), *["--vegetated"] * (options.vegetated is not None)], str(options.references[0]))
    from zlocus.evaluation.comparison import Comparison
    from zlocus.evaluation.evaluate import evaluate as compare
    from zlocus.evaluation.files import ERROR_MAP, write_evaluation
    from zlocus.evaluation.table import evaluation_table, main_figures_line
    from zlocus.products.other_styles import write_other_styles

    comparison = Comparison(options.references[0], **arguments)
    with console.progress.stage("Comparing"):
        evaluation = compare(options.dsm, comparison)
    if evaluation.nothing_compared is not None:
        raise InputError(evaluation.nothing_compared)
    text, values = f"{evaluation_table(evaluation)}\n{main_figures_line(evaluation)}", evaluation.as_dict()
    if options.out is None:
        return Answer(text, values, is_asked_for=True)
    write_evaluation(options.out, evaluation)
    write_other_styles(options.out, [ERROR_MAP])
    _tell_in_metadata(options.out, options.dsm)
    files = [str(options.out / name) for name in EVALUATION_FILES]
    return Answer(f"{text}\n{options.out}: {', '.join(EVALUATION_FILES)} written.", {**values, "files": files}, True)


def _at_points(options: EvaluateOptions, arguments: dict[str, Any], console: Console) -> Answer:
    """Compare a surface with points."""
    point_options = options.point_options(options.vegetated)
    from zlocus.evaluation.comparison import Comparison
    from zlocus.evaluation.files import ERROR_MAP, write_point_evaluation
    from zlocus.evaluation.point_evaluation import evaluate_at_points
    from zlocus.evaluation.point_table import point_table
    from zlocus.evaluation.table import main_figures_line
    from zlocus.io.styles.file_names import remove_styles

    comparison = Comparison(options.references[0], **arguments)
    with console.progress.stage("Comparing"):
        found = evaluate_at_points(options.dsm, comparison, point_options, options.references[1:])
    text, values = f"{point_table(found)}\n{main_figures_line(found.evaluation)}", found.as_dict()
    if options.out is None:
        return Answer(text, values, is_asked_for=True)
    names = write_point_evaluation(options.out, found)
    remove_styles(options.out, [ERROR_MAP])
    _tell_in_metadata(options.out, options.dsm)
    files = [str(options.out / name) for name in names]
    return Answer(f"{text}\n{options.out}: {', '.join(names)} written.", {**values, "files": files}, True)


def _tell_in_metadata(out: Path, dsm: Path) -> None:
    """Write the accuracy into the metadata of the surface where the evaluation lies in the folder of its run."""
    from zlocus.products.metadata import METADATA, write_metadata

    if dsm.resolve().parent == out.resolve() and (out / METADATA).is_file():
        write_metadata(out)


def check_not_input(out: Path, *inputs: Path | None) -> None:
    """Refuse to write over a raster that is to be read.

    Raises
    ------
    ConfigError
        An input is one of the files that the evaluation writes.
    """
    for path in inputs:
        if (
            path is not None
            and path.name in (*EVALUATION_FILES, *POINT_EVALUATION_FILES)
            and path.resolve().parent == out.resolve()
        ):
            raise ConfigError(f"{path} would be written over. Choose another folder with -o.")


def _slope_edges(text: str) -> tuple[float, ...]:
    if text == "none":
        return ()
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"--slopes {text} is no list of degrees. Give some like {DEFAULT_SLOPES}, or none."
        ) from error
