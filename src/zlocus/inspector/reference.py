"""The surface less a reference, as `zlocus evaluate` finds it, kept as a raster with overviews."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zlocus.evaluation.evaluate import evaluate
from zlocus.io.raster import RasterSink
from zlocus.products.report.comparison import Comparison, full_colour_m
from zlocus.products.report.words import against_reference


@dataclass(frozen=True)
class Difference:
    """Surface less reference.

    path : of the raster, NaN where it cannot be told; name : of the reference; full_m : size from which its colours are
    full; sentence : how the two compare.
    """

    path: Path
    name: str
    full_m: float
    sentence: str


def difference_to(dsm: Path, comparison: Comparison, scratch: Path) -> Difference:
    """Compare a surface with a reference. scratch : folder that the raster is written to.

    Raises
    ------
    InputError, ConfigError
        See `evaluate`.
    """
    evaluation = evaluate(dsm, **vars(comparison))
    assert evaluation.error_map is not None, "an evaluation of files has a map of errors"
    path = scratch / "difference.tif"
    with RasterSink(path, evaluation.error_map.geobox, "float32", nodata=float("nan"), units="m") as sink:
        sink.write(0, 0, evaluation.error_map.errors)
    name = comparison.reference.name
    return Difference(path, name, full_colour_m(evaluation), against_reference(evaluation, name))
