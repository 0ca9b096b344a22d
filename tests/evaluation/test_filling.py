"""Why nothing can be compared: a surface that fills no cell of a coarse reference."""

from __future__ import annotations

import numpy as np
import pytest
from rasterio.transform import from_origin

from evaluation_rasters import NORTH, WEST, write
from zlocus.core.errors import InputError
from zlocus.evaluation import evaluate as module
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.spread import LeastSpread


@pytest.fixture
def coarse(tmp_path):
    """A reference of 40 x 40 cells of 30 x 20 m, in whose first cells a surface may lie."""
    row, col = np.mgrid[:40, :40]
    heights = 100 + 20 * np.sin(row / 4) + 20 * np.sin(col / 5)  # on which a shift could be found
    return write(tmp_path / "r.tif", heights.astype(np.float32), from_origin(WEST, NORTH, 20, 30))


def surface(tmp_path, shape, left_m, top_m):
    heights = np.full(shape, 100, np.float32)
    return write(tmp_path / "d.tif", heights, from_origin(WEST + left_m, NORTH - top_m, 1, 1))


def test_the_reason_counts_the_cells_that_are_touched(tmp_path, coarse, monkeypatch):
    monkeypatch.setattr(LeastSpread, "least", None)  # which a search for a shift calls
    dsm = surface(tmp_path, (14, 14), 53, 53)  # rows 53 to 67, columns 53 to 67: two by two cells of 30 x 20 m
    result = evaluate(dsm, Comparison(coarse, slope_edges_deg=()))
    assert result.nothing_compared == (
        f"{dsm} fills none of the 1520 cells of 30 x 20 m of {coarse} that count: its heights reach into 4 of them, "
        "and a comparison needs heights in at least half of one. Give a finer reference or a larger surface."
    )


@pytest.mark.parametrize("asks", [False, True])
def test_a_surface_in_the_border_is_told_to_leave_out_the_margin(tmp_path, coarse, asks):
    comparison = Comparison(coarse, margin_m=25.0, align=asks)
    says = "Give a finer reference, a larger surface or --margin 0, which counts the border of the reference too."
    if asks:
        with pytest.raises(InputError, match=says):
            evaluate(surface(tmp_path, (30, 20), 0, 0), comparison)
    else:
        assert evaluate(surface(tmp_path, (30, 20), 0, 0), comparison).nothing_compared.endswith(says)


def test_where_something_is_compared_there_is_no_reason(tmp_path, coarse):
    result = evaluate(surface(tmp_path, (30, 20), 40, 60), Comparison(coarse))
    assert result.nothing_compared is None
    assert result.statistics.completeness == 1 / 1520
    assert module.NOTHING_IN_COMMON not in str(result.as_dict())
