"""Files of an evaluation: statistics as JSON, a map of the errors and their histogram."""

from __future__ import annotations

from pathlib import Path

from zlocus.core.errors import OutputError
from zlocus.core.requests import EVALUATION_FILES
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.histogram import histogram_figure
from zlocus.io.atomic_write import write_atomically
from zlocus.io.rasters import write_cog
from zlocus.io.run_record import write_record

NAMES = (FIGURES, ERROR_MAP, HISTOGRAM) = EVALUATION_FILES
DPI = 120


def write_evaluation(out: Path, evaluation: Evaluation) -> None:
    """Write `FIGURES`, `ERROR_MAP` and `HISTOGRAM` into a folder, each complete or not at all; the figures last.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    assert evaluation.error_map is not None, "an evaluation of files has a map of errors"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out} cannot be made: {error.strerror}. Choose another folder with -o.") from error
    # The figures of another evaluation must not stay beside a new map.
    try:
        (out / FIGURES).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            f"{out / FIGURES} is of another evaluation and cannot be removed: {error.strerror}. Choose another folder "
            "with -o."
        ) from error
    write_cog(
        out / ERROR_MAP, evaluation.error_map.errors, evaluation.error_map.geobox, nodata=float("nan"),
        descriptions=("height of the surface less that of the reference",), units="m",
    )  # fmt: skip
    figure = histogram_figure(evaluation)
    write_atomically(out / HISTOGRAM, lambda part: figure.savefig(part, format="png", dpi=DPI))
    write_record(out / FIGURES, evaluation.as_dict())
