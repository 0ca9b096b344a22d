"""The report's section on a reference: the results of `zlocus evaluate` as table, histogram and map."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import Evaluation, evaluate
from zlocus.evaluation.histogram import histogram_figure
from zlocus.evaluation.table import KINDS, accuracy_table, notes
from zlocus.products.match_curve_figures import svg_of
from zlocus.products.report import maps
from zlocus.products.report import text as words

HISTOGRAM_INCHES, SVG_DPI = (5.6, 4.2), 72
# The map's colours are saturated at this many times the NMAD, or at the threshold where that is larger.
SATURATED_AT_NMAD = 3.0


def comparison_part(out: Path, comparison: Comparison) -> dict[str, Any]:
    """Values of the template that compare the surface in a folder with a reference.

    Raises
    ------
    InputError, ConfigError
        See `evaluate`.
    """
    evaluation = evaluate(out / "dsm.tif", comparison)
    table = accuracy_table(evaluation)
    return {
        "sentence": words.against_reference(evaluation, comparison.reference.name), "name": comparison.reference.name,
        "table": table, "kinds": KINDS, "notes": [_sentence(note) for note in notes(evaluation)],
        "margin": f"{comparison.margin_m:g}", "is_shifted": evaluation.is_aligned,
        "histogram": _histogram(evaluation), "map": _error_map(evaluation), "bar": _scale_bar(evaluation),
    }  # fmt: skip


def _sentence(note: str) -> str:
    return note[0].upper() + note[1:].rstrip(".") + "."


def _histogram(evaluation: Evaluation) -> maps.Picture:
    figure = histogram_figure(evaluation, HISTOGRAM_INCHES)
    statistics = evaluation.statistics
    alt = (
        f"Histogram of the errors about their median {words.number(statistics.median, 'm', 3)}, "
        f"NMAD {words.number(statistics.nmad, 'm', 3)}."
    )
    width, height = (round(SVG_DPI * side) for side in HISTOGRAM_INCHES)
    return maps.Picture(maps.data_uri(svg_of(figure).encode(), "image/svg+xml"), alt, width, height)


def _error_map(evaluation: Evaluation) -> tuple[maps.Picture, maps.Scale]:
    assert evaluation.error_map is not None, "an evaluation of files has a map of errors"
    return maps.error_picture(shrunk_means(evaluation.error_map.errors, maps.MAP_PX), saturated_error_m(evaluation))


def saturated_error_m(evaluation: Evaluation) -> float:
    """Size of an error, m, from which the map's colours are saturated."""
    nmad = np.nan_to_num(evaluation.statistics.nmad)
    return float(f"{max(evaluation.threshold_m, SATURATED_AT_NMAD * nmad):.1g}")


def _scale_bar(evaluation: Evaluation) -> maps.ScaleBar | None:
    """Scale bar of the error map; None where the reference's cells are in degrees."""
    assert evaluation.error_map is not None, "an evaluation of files has a map of errors"
    geobox = evaluation.error_map.geobox
    if geobox.crs is not None and geobox.crs.geographic:
        return None
    return maps.scale_bar(geobox.shape[1] * abs(float(geobox.resolution.x)))


def shrunk_means(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Means of square blocks of cells (r, c), at most `side` blocks a side; NaN where a block has no known cell."""
    step = -(-max(values.shape) // side)
    rows, cols = (-(-n // step) for n in values.shape)
    padded = np.full((rows * step, cols * step), np.nan, np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Mean of empty slice", RuntimeWarning)
        means = np.nanmean(padded.reshape(rows, step, cols, step), axis=(1, 3))
    return np.asarray(means, np.float32)
