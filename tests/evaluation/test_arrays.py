"""Evaluation of arrays: the figures of the command, without files."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
import xarray
from affine import Affine

from zlocus.core.errors import ConfigError
from zlocus.evaluation.arrays import evaluate
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate as evaluate_files

CELL_M = 0.5


def surfaces():
    """Rolling ground, and a surface of it with noise, a hole and some gross errors."""
    rng, (row, col) = np.random.default_rng(3), np.indices((80, 90))
    truth = 50 + 5 * np.sin(col / 11) * np.cos(row / 9)
    height = truth + 0.3 + rng.normal(0, 0.1, truth.shape)
    height[10:14, 20:30] = np.nan
    height[rng.random(truth.shape) < 0.05] += 8.0
    return height, truth


def written(path, values):
    profile = {"driver": "GTiff", "width": values.shape[1], "height": values.shape[0], "count": 1}
    where = Affine(CELL_M, 0, 4e5, 0, -CELL_M, 5e6)
    with rasterio.open(path, "w", dtype=values.dtype, crs="EPSG:32632", transform=where, **profile) as file:
        file.write(values, 1)
    return path


@pytest.mark.parametrize("align", [False, True])
def test_the_figures_are_those_of_files(tmp_path, align):
    height, truth = surfaces()
    classes = np.where(truth > 50, 2, 0).astype(np.uint8)
    found = evaluate(height, truth, CELL_M, classes=classes, align=align, margin_m=2.0, threshold_m=0.5)
    comparison = Comparison(
        written(tmp_path / "truth.tif", truth), align=align, margin_m=2.0, threshold_m=0.5,
        classes=written(tmp_path / "classes.tif", classes),
    )  # fmt: skip
    expected = evaluate_files(written(tmp_path / "dsm.tif", height), comparison)
    ours, theirs = found.as_dict(), expected.as_dict()
    assert ours.pop("places_assumed") != theirs.pop("places_assumed")  # arrays have no CRS
    assert ours.keys() == theirs.keys()
    for name in ("all", "ground", "building"):
        assert ours[name].pop("within_m") == theirs[name].pop("within_m"), name
        assert ours[name] == pytest.approx(theirs[name], abs=1e-6), name
    assert ours["all"]["n"] == (80 - 8) * (90 - 8)


def test_arrays_of_other_libraries_and_types_are_taken():
    height, truth = surfaces()
    expected = evaluate(height, truth, CELL_M).statistics
    assert evaluate(xarray.DataArray(height), truth.tolist(), CELL_M).statistics == expected
    whole = evaluate(np.rint(truth).astype(int), truth, CELL_M).statistics
    assert whole.within == 1.0
    assert whole.completeness == 1.0


@pytest.mark.parametrize(
    ("height", "reference", "more", "said"),
    [
        (np.zeros((5, 6)), np.zeros((6, 5)), {}, r"reference has \(6, 5\) cells, and height \(5, 6\)\. Give both"),
        (np.zeros(5), np.zeros(5), {}, r"height has the shape \(5,\)\. Give one of \(rows, columns\)"),
        (np.zeros((5, 6)), "dsm.tif", {}, r"reference holds values of type <U7\. Give real numbers"),
        (np.zeros((1, 6)), np.zeros((1, 6)), {}, "too few for a surface"),
        (np.zeros((5, 6), complex), np.zeros((5, 6)), {}, "type complex128"),
        (np.zeros((5, 6)), np.zeros((5, 6)), {"resolution": -1.0}, "resolution is -1.0, which is no size"),
        (np.zeros((5, 6)), np.zeros((5, 6)), {"classes": np.zeros((6, 5))}, r"classes has \(6, 5\) cells"),
        (np.zeros((5, 6)), np.zeros((5, 6)), {"threshold_m": 0.0}, "--threshold 0 is not a size"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(height, reference, more, said):
    with pytest.raises(ConfigError, match=said):
        evaluate(height, reference, **{"resolution": CELL_M} | more)
