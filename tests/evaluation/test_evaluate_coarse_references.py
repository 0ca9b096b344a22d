"""References with larger cells than the surface: compared with the mean of the surface in each of their cells."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer
from rasterio.transform import from_origin

from evaluation_rasters import CRS, NORTH, WEST, rolling, write
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.table import evaluation_table

# Of ground of 15 m radius between cells of half a metre.
SHIFT_TOLERANCE_M = 0.05
# The mean of cells of a map against that of cells of degrees that lie a little askew in it.
MEAN_TOLERANCE_M = 0.05


def laid(path, z, cell_m, shift=(0.0, 0.0)):
    return write(path, np.asarray(z, np.float32), from_origin(WEST + shift[0], NORTH + shift[1], cell_m, cell_m))


def ground(n, cell_m, part=1):
    """Rolling ground on n x n cells, each the mean of part x part."""
    at = (np.arange(n * part) + 0.5) * cell_m / part
    return rolling(*np.meshgrid(at, at)).reshape(n, part, n, part).mean(axis=(1, 3))


def test_a_case_computed_by_hand(tmp_path):
    # Cells of 2 m over cells of 1 m; the surface ends in the middle of the third column.
    nan = np.nan
    surface = np.array([[1, 3, 5, nan, 9], [5, 7, nan, 11, 9], [nan, nan, 2, 2, nan], [nan, 4, 2, 2, 8]])
    reference = np.array([[4, 7, 8], [4, 2, 8]])
    result = evaluate(
        laid(tmp_path / "d.tif", surface, 1), Comparison(laid(tmp_path / "r.tif", reference, 2), margin_m=0)
    )
    # Means 4, 8 of two, 9 of two / none, for one of four is known; 2, none, for one of four is known.
    np.testing.assert_allclose(result.error_map.errors, [[0, 1, 1], [nan, 0, nan]], atol=1e-6)
    assert (result.statistics.n, result.statistics.completeness) == (6, 4 / 6)
    assert result.mvs3dm.completeness == 2 / 6
    assert result.mvs3dm.median_error_m == pytest.approx(0.5)
    assert (result.places_per_block, result.as_dict()["mean_of"]) == ((2, 2), [2, 2])
    line = "the reference is coarser: each of its cells is compared with the mean of the surface at 2 x 2 places in it"
    assert line in evaluation_table(result)


@pytest.mark.parametrize(
    ("cell_m", "side_m", "places_per_block"),
    [(0.7, 60, None), (0.98, 60, None), (1.0, 60, (2, 2)), (1.3, 60, (3, 3)), (90, 180, (32, 32))],
)
def test_cells_twice_as_large_are_compared_with_means(tmp_path, cell_m, side_m, places_per_block):
    n = round(side_m / cell_m)
    dsm, reference = (
        laid(tmp_path / "d.tif", ground(2 * side_m, 0.5), 0.5),
        laid(tmp_path / "r.tif", ground(n, cell_m), cell_m),
    )
    result = evaluate(dsm, Comparison(reference, margin_m=0))
    assert result.places_per_block == places_per_block
    assert ("coarser" in evaluation_table(result)) == (places_per_block is not None)


def test_noise_of_small_cells_is_no_error_of_large_ones(tmp_path):
    noise = np.random.default_rng(3).normal(0, 1.0, (400, 400))
    dsm = laid(tmp_path / "d.tif", ground(400, 0.5) + noise, 0.5)
    result = evaluate(dsm, Comparison(laid(tmp_path / "r.tif", ground(40, 5, part=10), 5)))
    # A hundred cells: a tenth of their noise.
    assert result.statistics.rmse == pytest.approx(0.1, abs=0.02)
    assert result.mvs3dm.median_error_m == pytest.approx(0.6745 * 0.1, abs=0.02)


def test_either_side_of_an_edge_is_right_beside_small_cells_too(tmp_path):
    # Blocks of 2 x 2 quarter-metre cells over cells of 5 cm; a wall runs through the middle of a column of blocks.
    truth = np.full((80, 80), 10.0)
    truth[:, 41:] = 20.0
    reference = laid(tmp_path / "t.tif", truth, 0.25)
    for wall in (203, 207):
        dsm = np.where(np.arange(400) < wall, 10.0, 20.0)[None] * np.ones((400, 1))
        result = evaluate(laid(tmp_path / "d.tif", dsm, 0.05), Comparison(reference, margin_m=0))
        assert result.places_per_block == (10, 10)
        assert result.statistics.rmse == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("coregister", [None, "nuth-kaab"], ids=["search", "nuth-kaab"])
@pytest.mark.parametrize(("cell_m", "noise_m"), [(1.0, 0.0), (5.0, 0.0), (5.0, 3.0)])
def test_a_shift_is_found_from_larger_cells(tmp_path, coregister, cell_m, noise_m):
    planted = (1.3, -0.7)
    noise = np.random.default_rng(8).normal(0, noise_m, (400, 400))
    dsm = laid(tmp_path / "d.tif", ground(400, 0.5) + noise + 0.4, 0.5, planted)
    n = round(200 / cell_m)
    reference = laid(tmp_path / "r.tif", ground(n, cell_m, part=10), cell_m)
    result = evaluate(dsm, Comparison(reference, align=coregister is None, coregister=coregister))
    # Of a hundred cells a tenth of their noise, on slopes of 0.3 and 1300 blocks.
    tolerance_m = SHIFT_TOLERANCE_M + 3 * noise_m / 10 / 0.3 / 1300**0.5
    assert result.shift.enu_m == pytest.approx((*planted, 0.4), abs=tolerance_m)
    assert result.statistics.rmse < SHIFT_TOLERANCE_M + 0.12 * noise_m
    assert result.mvs3dm.median_error_m < SHIFT_TOLERANCE_M + 0.08 * noise_m


def test_larger_cells_in_degrees(tmp_path):
    # Cells of 16 x 23 m, each the mean of 40 x 40 places in it; the surface has noise that hides single cells' heights.
    cells, shape, part = (3e-4, 1.5e-4), (7, 7), 40
    middle = Transformer.from_crs(CRS, 4326, always_xy=True).transform(WEST + 100, NORTH - 100)
    at = from_origin(middle[0] - cells[0] * 3.5, middle[1] + cells[1] * 3.5, *cells)
    col, row = np.meshgrid(*((np.arange(7 * part) + 0.5) / part,) * 2)
    x, y = Transformer.from_crs(4326, CRS, always_xy=True).transform(at.c + at.a * col, at.f + at.e * row)
    z = rolling(x - WEST, NORTH - y).reshape(7, part, 7, part).mean(axis=(1, 3))
    reference = write(tmp_path / "r.tif", z.astype(np.float32), at, "EPSG:4326")
    noise = np.random.default_rng(5).normal(0, 1.0, (400, 400))
    assert shape == z.shape
    result = evaluate(laid(tmp_path / "d.tif", ground(400, 0.5) + noise, 0.5), Comparison(reference, margin_m=0))
    assert result.places_per_block == (32, 32)
    assert result.statistics.completeness == 1
    assert abs(result.statistics.median) < MEAN_TOLERANCE_M
    assert result.statistics.rmse < 2 * MEAN_TOLERANCE_M


def test_many_blocks_are_looked_at_as_few_at_a_time(tmp_path, monkeypatch):
    dsm = laid(tmp_path / "d.tif", ground(100, 0.5), 0.5)
    reference = laid(tmp_path / "r.tif", ground(16, 3, part=6), 3)
    whole = evaluate(dsm, Comparison(reference))
    monkeypatch.setattr("zlocus.evaluation.frame.PLACES_AT_A_TIME", 100)
    assert evaluate(dsm, Comparison(reference)) == whole
