"""Files of an evaluation: statistics as JSON, a map of the errors and their histogram."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from zlocus.core.errors import OutputError
from zlocus.core.requests import EVALUATION_FILES, POINT_EVALUATION_FILES
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.histogram import errors_figure, histogram_figure
from zlocus.evaluation.point_evaluation import PointEvaluation
from zlocus.io.atomic_write import write_atomically
from zlocus.io.number_table import write_number_table
from zlocus.io.rasters import write_cog
from zlocus.io.run_record import write_record

NAMES = (FIGURES, ERROR_MAP, HISTOGRAM) = EVALUATION_FILES
POINT_ERRORS = POINT_EVALUATION_FILES[1]
DPI = 120


def write_evaluation(out: Path, evaluation: Evaluation) -> None:
    """Write `FIGURES`, `ERROR_MAP` and `HISTOGRAM` into a folder, each complete or not at all; the figures last.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    assert evaluation.error_map is not None, "an evaluation of files has a map of errors"
    _begin(out)
    write_cog(
        out / ERROR_MAP, evaluation.error_map.errors, evaluation.error_map.geobox, nodata=float("nan"),
        descriptions=("height of the surface less that of the reference",), units="m",
    )  # fmt: skip
    _write_figure(out, histogram_figure(evaluation))
    write_record(out / FIGURES, evaluation.as_dict())


def write_point_evaluation(out: Path, point_evaluation: PointEvaluation) -> tuple[str, ...]:
    """Write the files of an evaluation at points, as `write_evaluation` does; the names of those that were written.

    `POINT_ERRORS` lists each point with its error; it is left out for clouds.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    _begin(out)
    names: tuple[str, ...] = POINT_EVALUATION_FILES
    if point_evaluation.is_cloud:
        names = tuple(name for name in names if name != POINT_ERRORS)
    else:
        write_number_table(
            out / POINT_ERRORS, point_evaluation.columns(),
            "x, y in the surface's CRS; heights in its vertical datum, m",
            {"class": point_evaluation.cover},
        )  # fmt: skip
    _write_figure(out, errors_figure(point_evaluation.evaluation, point_evaluation.errors, places="points"))
    write_record(out / FIGURES, point_evaluation.as_dict())
    return names


def _begin(out: Path) -> None:
    """Make the folder, and remove another evaluation: its figures must not stay beside a new map."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out} cannot be made: {error.strerror}. Choose another folder with -o.") from error
    for name in (FIGURES, ERROR_MAP, POINT_ERRORS):
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"{out / name} is of another evaluation and cannot be removed: {error.strerror}. Choose another folder "
                "with -o."
            ) from error


def _write_figure(out: Path, figure: Figure) -> None:
    write_atomically(out / HISTOGRAM, lambda part: figure.savefig(part, format="png", dpi=DPI))
