"""Maps, drawings and tables of report.html, each by itself: colours, scales, numbers, shares, and what cards say."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine

from surveys import small
from zlocus.core.grid import CellWindow
from zlocus.core.options import ProductOptions
from zlocus.matching.quality import Quality
from zlocus.pipeline.report_inputs import sample_cores
from zlocus.products.contours import write_contours
from zlocus.products.demo_figure import relief
from zlocus.products.hillshade import hillshade
from zlocus.products.report import maps, tables
from zlocus.products.report import text as words
from zlocus.products.report.page import NUMBER_BOX, curve_card, number_places

CELL_M = 0.5
SUN = (315.0, 45.0)
# JPEG, of grey values.
SAME_GREY = 6.0


def write(path: Path, values: np.ndarray, mask: np.ndarray | None = None) -> Path:
    bands = values if values.ndim == 3 else values[None]
    profile = {"driver": "GTiff", "width": bands.shape[2], "height": bands.shape[1], "count": len(bands)}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            path, "w", dtype=values.dtype.name, crs="EPSG:32632", transform=Affine(CELL_M, 0, 5e5, 0, -CELL_M, 5e6),
            **profile,
        ) as file,
    ):  # fmt: skip
        file.write(bands)
        if mask is not None:
            file.write_mask(mask)
    return path


def pixels_of(shown: maps.Picture) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(shown.uri.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)


def test_colours_of_heights_run_evenly():
    """Level strips all have the same light: half way up stands the colour half way along the scale."""
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_VIRIDIS)[0].astype(float)
    for share in (0.0, 0.25, 0.5, 1.0):
        level = np.full((5, 5), 10.0 + 40.0 * share, np.float32)
        shade = 0.35 + 0.75 * (float(hillshade(level, 1.0, *SUN)[2, 2]) - 1) / 254
        np.testing.assert_allclose(relief(level, 1.0, (10.0, 50.0))[2, 2], table[int(255 * share)] * shade, atol=1.0)


def test_the_relief_has_the_light_of_the_hillshade():
    rng = np.random.default_rng(5)
    z = cv2.GaussianBlur(rng.normal(size=(40, 50)), (0, 0), 3).astype(np.float32) * 8
    z[10:14, 20:30] = np.nan
    for sun in (SUN, (90.0, 20.0)):
        shaded = relief(z, CELL_M, (-1e6, 1e6), sun).astype(float).sum(axis=2)
        shade = hillshade(z, CELL_M, *sun).astype(float)
        known = np.isfinite(z)
        assert np.corrcoef(shaded[known], shade[known])[0, 1] > 0.999
        assert (relief(z, CELL_M, (-1.0, 1.0), sun)[~known] == 255).all()


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [(400.0, 500.0, "402.0 426.0 450.0 474.0 498.0"), (7.0, 7.2, "7.004 7.052 7.100 7.148 7.196")],
)
def test_ticks_of_heights_lie_evenly_between_the_percentiles(tmp_path, low, high, ticks):
    write(tmp_path / "dsm.tif", np.tile(np.linspace(low, high, 201), (9, 1)).astype(np.float32))
    _, scale = maps.height_map(tmp_path / "dsm.tif", small(np.zeros((9, 201), np.uint16)), SUN)
    assert " ".join(scale.ticks) == ticks
    assert scale.gradient.split(", ")[0] == "#440154"


def test_a_scale_bar_is_round_and_as_long_as_it_says():
    assert maps.scale_bar(312.5) == maps.ScaleBar(100 * 50 / 312.5, "50 m")
    assert maps.scale_bar(10_000.0) == maps.ScaleBar(20.0, "2 km")
    assert maps.scale_bar(1.0) == maps.ScaleBar(20.0, "0.2 m")
    for width in np.geomspace(0.3, 3e5, 60):
        assert 12 <= maps.scale_bar(float(width)).percent <= 100 * maps.MAX_BAR_SHARE + 1e-6


def test_corners_are_those_of_the_grid():
    found = small(np.zeros((6, 8), np.uint16))  # cells of 2 m from 100, 50
    assert words.corners(found, is_local=False) == [
        "E 100.0, N 50.0", "E 116.0, N 50.0", "E 100.0, N 38.0", "E 116.0, N 38.0",
    ]  # fmt: skip
    assert words.corners(found, is_local=True)[0] == "x 100.0, y 50.0"


@pytest.mark.parametrize(
    ("azimuth", "side"), [(0, "top"), (315, "upper left"), (350, "top"), (95, "right"), (225, "lower left")]
)
def test_where_the_light_comes_from(azimuth, side):
    assert words.sun(azimuth, 30) == f"lit from the {side} (azimuth {azimuth} degrees), 30 degrees above the horizon"


def test_the_ortho_image_is_shown_in_its_colours(tmp_path):
    assert maps.ortho_map(tmp_path) is None
    bands = np.zeros((3, 60, 60), np.uint16)
    bands[0, :, :30], bands[2, :, 30:] = 4000, 4000  # red, then blue
    mask = np.full((60, 60), 255, np.uint8)
    mask[:10] = 0
    write(tmp_path / "ortho.tif", bands, mask)
    shown = pixels_of(maps.ortho_map(tmp_path))
    np.testing.assert_allclose(shown[40, 10], (0, 0, 255), atol=SAME_GREY)
    np.testing.assert_allclose(shown[40, 50], (255, 0, 0), atol=SAME_GREY)
    assert (shown[3, 10] == 255).all()


def test_a_large_grey_ortho_image_is_a_small_jpeg(tmp_path):
    grey = np.tile(np.linspace(0, 1000, 1700), (900, 1)).astype(np.float32)
    write(tmp_path / "ortho.tif", grey)
    picture = maps.ortho_map(tmp_path)
    assert picture.uri.startswith("data:image/jpeg")
    assert (picture.width, picture.height) == (800, 424)
    row = pixels_of(picture)[200].astype(float)
    # From the 1st to the 99th percentile of 0 to 1000.
    np.testing.assert_allclose(row[400], 255 * 0.5, atol=SAME_GREY)
    assert row[0].max() < SAME_GREY
    assert row[-1].min() > 255 - SAME_GREY


def square(x: float, y: float, side: float) -> np.ndarray:
    return np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)])


def test_numbers_of_outlines_that_are_alike_stand_apart():
    rings = [square(10.0 + i, 20.0 - i, 900.0) for i in range(24)]
    places = number_places(rings)
    assert all(places)
    at = np.array(places)
    apart = np.abs(at[:, None] - at[None]) / NUMBER_BOX
    np.fill_diagonal(apart[..., 0], np.inf)
    assert (apart.max(axis=-1) >= 1).all()
    for (x, y), ring in zip(places, rings, strict=True):  # each on its own outline
        low, high = ring.min(axis=0), ring.max(axis=0)
        assert min(abs(x - low[0]), abs(x - high[0]), abs(y - low[1]), abs(y - high[1])) < 0.06


def test_numbers_without_room_are_left_out():
    places = number_places([square(0.0, 0.0, 30.0)] * 3)
    assert places[0] is not None
    assert places[1:] == [None, None]


def test_whole_percent_is_all_only_of_all():
    assert [tables.whole_percent(n, 1000) for n in (0, 1, 499, 996, 999, 1000)] == ["0", "1", "50", "99", "99", "100"]


def test_labels_of_a_sample():
    pairs = [{"images": ["a", "b"], "points": 4, "good": 3, "fair": 0, "poor": 1}]
    found = tables.sampled_matrix(pairs, ["b", "a", "c"])
    assert [[cell.text for cell in row] for row in found.cell_rows] == [
        ["", "75", "–"],
        ["75", "", "–"],
        ["–", "–", ""],
    ]
    assert found.cell_rows[0][1].title == "a against b: good at 75.0 %, fair at 0.00 %, poor at 25.0 % of 4 tie points"
    assert tables.sampled_matrix(pairs, ["a", "c"]) is None


@pytest.mark.parametrize(("letters", "n", "below"), [(5, 3, 0), (6, 4, 400), (12, 6, 1100), (60, 30, 9999)])
def test_matrices_say_on_which_pages_they_scroll(letters, n, below):
    names = tuple(f"{i}".rjust(letters, "x") for i in range(n))
    assert tables.Matrix(names, ()).wider_than == below


def scene_with(xy: np.ndarray):
    """A scene of 1000 x 800 cells of 1 m from column 0, row 0, with ties there (columns and rows)."""
    from types import SimpleNamespace

    ties = np.column_stack([xy[:, 0], -xy[:, 1], np.full(len(xy), 10.0)])
    return SimpleNamespace(ties=ties, anchor=(0.0, 0.0), cell_size=1.0, overlap_window=CellWindow(0, 0, 800, 1000))


def test_places_of_a_sample_are_spread_and_inside():
    xy = np.random.default_rng(2).uniform((0, 0), (1000, 800), (3000, 2))
    xy[:20] += 5000.0  # beyond the ground that two images see
    cores = sample_cores(scene_with(xy), 64, 16)
    assert len(cores) == 9
    middle = np.array([(core.col + 32, core.row + 32) for core in cores])
    apart = np.hypot(*(middle[:, None] - middle[None]).transpose(2, 0, 1))
    assert apart[np.triu_indices(9, 1)].min() > 200
    assert abs(middle[0] - (500, 400)).max() < 60  # whatever the time allows: the middle, then the corners
    assert apart[0, 1] > 350
    assert all(core.rows <= 64 and core.cols <= 64 for core in cores)


def test_few_ties_give_few_places():
    assert len(sample_cores(scene_with(np.array([(10.0, 10.0)])), 64, 16)) == 1
    assert sample_cores(scene_with(np.zeros((0, 2))), 64, 16) == []
    only = sample_cores(scene_with(np.array([(10.0, 10.0)])), 64, 16)[0]
    assert (only.row, only.col, only.rows, only.cols) == (0, 0, 42, 42)


def test_a_scene_smaller_than_all_places_is_one_place():
    xy = np.random.default_rng(2).uniform((0, 0), (1000, 800), (3000, 2))
    assert sample_cores(scene_with(xy), 64, 118) == [CellWindow(0, 0, 800, 1000)]  # nine times 300 x 300 cells
    assert len(sample_cores(scene_with(xy), 64, 117)) == 9


def card(kind: str, why: str, rho1: float, **more: float) -> list[str]:
    mean = {"label": 1, "rho1": rho1, "ratio": 2.0, "peak_m": 12.0}
    cell = {
        "kind": kind, "why": why, "row": 1, "col": 2, "x": 3.0, "y": 4.0, "height_m": None, "sigma_m": None,
        "quality": int(Quality.NO_MATCH), "n_shown": 1, "svg": "<svg/>", "point": {"reference": "a", "means": [mean]},
        **more,
    }  # fmt: skip
    run = {"heights": {"searched_m": [1.25, 99.0]}, "config": {"options": {"checks": {"min_ncc": -0.2}}}}
    return curve_card(cell, run)["lines"]


def contours_of_a_plane(folder: Path) -> maps.Picture | None:
    """Contours, 4 m apart, of a plane that rises by 1 m per cell to the east."""
    surface = write(folder / "dsm.tif", np.tile(np.arange(40, dtype=np.float32), (20, 1)))
    write_contours(surface, folder / "contours.gpkg", ProductOptions(contour_interval_m=4.0))
    return maps.contour_map(folder / "contours.gpkg", surface, SUN)


def test_contours_are_drawn_where_they_lie(tmp_path):
    pixels = pixels_of(contours_of_a_plane(tmp_path))
    grow = pixels.shape[1] // 40
    is_line = pixels[pixels.shape[0] // 2, :, 0].astype(int) < 120
    starts = np.flatnonzero(np.diff(is_line.astype(int)) == 1) + 1
    widths = np.array([np.flatnonzero(~is_line[start:])[0] for start in starts])
    # The centre of the cell with 4 m is 4.5 cells from the edge, and that with 0 m half a cell.
    np.testing.assert_allclose((starts + widths / 2) / grow, np.arange(0, 40, 4) + 0.5, atol=2 / grow)
    assert np.flatnonzero(widths > widths.min()).tolist() == [0, 5]  # 0 m and 20 m


def test_too_many_contours_are_not_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(maps, "MAX_DRAWN_CONTOURS", 1)
    assert contours_of_a_plane(tmp_path) is None


def test_a_failed_cell_with_a_high_peak_says_why_it_has_no_height():
    (said,) = (line for line in card("failed", "NO_MATCH", 0.97) if line.startswith("No height in spite of the peak"))
    assert "below -0.2 (checks.min_ncc)" in said
    assert "1.2 to 99.0 m" in card("failed", "RANGE_END", 0.97)[-1]
    assert "-48.8 to 49.0 m" in card("failed", "RANGE_END", 0.97, undulation_m=50.0)[-1]
    assert not any("in spite" in line for line in card("failed", "NO_MATCH", 0.3))
    assert not any("in spite" in line for line in card("doubtful", "WEAK", 0.97))


def test_every_reason_whose_cells_get_curves_has_its_sentence():
    from zlocus.products.report.example_cells import FAILURES

    assert set(words.DESPITE_PEAK) == set(FAILURES)
