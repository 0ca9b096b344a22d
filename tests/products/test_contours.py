"""Contours of planes and cones, worked out by hand; the same lines however a raster is cut into strips."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyogrio.raw
import pytest
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox
from shapely import box, from_wkb, get_coordinates, is_closed, is_simple

import zlocus.products.contours as contours_module
from zlocus.core.errors import ConfigError
from zlocus.core.options import ProductOptions
from zlocus.io.crs import local_frame
from zlocus.io.rasters import write_cog
from zlocus.io.row_strips import BandReader
from zlocus.products.contours import batched, contours, nice_interval, write_contours

CELL_M, WEST, NORTH = 0.5, 500000.0, 4000000.0
PLACE_M = 1e-4  # coordinates are rounded to 1e-4 cells


def written(folder, z, crs="EPSG:32632"):
    grid = GeoBox(z.shape, Affine(CELL_M, 0, WEST, 0, -CELL_M, NORTH), crs)
    write_cog(folder / "dsm.tif", z.astype(np.float32), grid, nodata=np.nan, units="m")
    return folder / "dsm.tif"


def drawn(folder, z, interval_m, crs="EPSG:32632", **options):
    path = written(folder, z, crs)
    write_contours(path, folder / "contours.gpkg", ProductOptions(contour_interval_m=interval_m, **options))
    meta, _, wkb, (elevation,) = pyogrio.raw.read(folder / "contours.gpkg", layer="contours")
    assert list(meta["fields"]) == ["elevation_m"]
    return meta, from_wkb(wkb), elevation


def test_a_plane_by_hand(tmp_path):
    col = np.tile(np.arange(40), (300, 1))
    # Height is 1 m per metre of easting, 0 at the western edge of the first cell.
    meta, lines, elevation = drawn(tmp_path, (col + 0.5) * CELL_M, 5.0)
    np.testing.assert_array_equal(elevation, [5.0, 10.0, 15.0])
    assert (meta["geometry_type"], meta["crs"]) == ("LineString", "EPSG:32632")
    for line, z in zip(lines, elevation, strict=True):
        points = get_coordinates(line)
        np.testing.assert_allclose(points[:, 0], WEST + z, atol=PLACE_M)
        # One line from the last row's centre to the first one's, across all strips: higher ground is on its right.
        assert (points[0, 1], points[-1, 1]) == (NORTH - 0.25 - 299 * CELL_M, NORTH - 0.25)
        assert is_simple(line)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["contours.gpkg", "dsm.tif"]


def test_a_cone_by_hand(tmp_path):
    row, col = np.mgrid[-150:151, -150:151]
    z = 100.0 - np.hypot(row, col) * CELL_M
    _, lines, elevation = drawn(tmp_path, z, 10.0)
    np.testing.assert_array_equal(elevation[is_closed(lines)], [30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0])
    centre = (WEST + 150.5 * CELL_M, NORTH - 150.5 * CELL_M)
    for line, height in zip(lines, elevation, strict=True):
        away = np.hypot(*(get_coordinates(line) - centre).T)
        # A cone bends across a cell: by less than cell^2 / (8 radius).
        np.testing.assert_allclose(away, 100.0 - height, atol=CELL_M**2 / (8 * (100.0 - height)) + PLACE_M)
    # The four corners of the square beyond 75 m hold the lower ones, open at the rim.
    np.testing.assert_array_equal(elevation[~is_closed(lines)], np.repeat([0.0, 10.0, 20.0], 4))


def test_higher_ground_lies_on_the_right(tmp_path):
    row, col = np.mgrid[-20:21, -20:21]
    _, lines, _ = drawn(tmp_path, 100.0 - np.hypot(row, col), 50.0 / 4)
    for line in lines[is_closed(lines)]:
        x, y = get_coordinates(line).T
        assert (
            np.sum((x[:-1] - x[0]) * (y[1:] - y[0]) - (x[1:] - x[0]) * (y[:-1] - y[0])) < 0
        )  # clockwise about the top


def test_lines_end_at_holes(tmp_path):
    z = np.tile(np.arange(40.0), (40, 1)) * CELL_M
    z[10:20, 15:30] = np.nan
    _, lines, elevation = drawn(tmp_path, z, 5.0 + 5.0 / 1024)
    near = lines[np.isclose(elevation, 10.0 + 10.0 / 1024)]
    assert len(near) == 2
    for line in near:
        rows = (NORTH - get_coordinates(line)[:, 1]) / CELL_M - 0.5
        assert rows.max() <= 9 + PLACE_M or rows.min() >= 20 - PLACE_M
    # Past a corner of the hole, half a cell beside it.
    _, lines, elevation = drawn(tmp_path, z, 7.25)
    rows = [(NORTH - get_coordinates(line)[[0, -1], 1]) / CELL_M - 0.5 for line in lines[elevation == 7.25]]
    np.testing.assert_allclose(rows, [[9, 0], [39, 20]], atol=PLACE_M)


def pyramids(tops):
    """Flat ground with pyramids one cell wide, on every side, of these heights: about each, lines are squares on their
    corner, at height z with a side of (1 - z / top) times the root of two."""
    z = np.zeros((9, 6 * len(tops)))
    z[4, 3::6] = tops
    return z


def test_short_rings_are_left_out(tmp_path):
    # Perimeters at 1 m of 4 * 2 ** 0.5 * (1 - 1 / top) cells: 2.83, 4.24, 5.09 and 5.60.
    z = pyramids([2.0, 4.0, 10.0, 100.0])
    for least, n in ((0, 4), (2.8, 4), (2.9, 3), (4.3, 2), (5.05, 2), (5.1, 1), (5.7, 0)):
        _, _, elevation = drawn(tmp_path, z, 1.0, min_contour_cells=least)
        assert np.sum(np.isclose(elevation, 1.0)) == n, least
    # By default none of these is drawn, nor a ring about five cells in a row, but one about six.
    for end, lengths in ((7, []), (8, [2 * 5 + 2 * 2**0.5])):
        z[2:end, 3] = 2.0
        _, lines, elevation = drawn(tmp_path, z, 1.0)
        found = [line.length / CELL_M for line in lines[np.isclose(elevation, 1.0)]]
        assert found == pytest.approx(lengths, abs=1e-3)


def test_short_lines_that_end_at_the_rim_or_a_hole_stay(tmp_path):
    z = pyramids([4.0])
    z[4, 4:] = np.nan
    _, lines, elevation = drawn(tmp_path, z, 2.0)
    (line,) = lines[np.isclose(elevation, 2.0)]
    assert not is_closed(line)
    assert line.length / CELL_M == pytest.approx(2**0.5, abs=1e-3)


def is_ring_below(line, least_cells):
    return (line[0] == line[-1]).all() and np.hypot(*np.diff(line, axis=0).T).sum() < least_cells


def same(one, other):
    assert [level for level, _ in one] == [level for level, _ in other]
    for (_, a), (_, b) in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@settings(max_examples=50)
@given(st.lists(st.integers(2, 9)), st.integers(1, 12))
def test_batches_hold_all_lines_in_their_order(lengths, most):
    lines = [(level, np.zeros((n, 2))) for level, n in enumerate(lengths)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contours_module, "BATCH_POINTS", most)
        found = list(batched(lines))
    assert found
    assert [level for levels, _ in found for level in levels] == list(range(len(lengths)))
    assert all(sum(map(len, held[:-1])) < most for _, held in found)


def test_lines_are_written_batch_by_batch(tmp_path, monkeypatch):
    row, col = np.mgrid[-60:61, -60:61]
    z = 100.0 - np.hypot(row, col) * CELL_M
    _, whole, heights = drawn(tmp_path, z, 2.0)
    monkeypatch.setattr(contours_module, "BATCH_POINTS", 300)
    _, parts, same_heights = drawn(tmp_path, z, 2.0)
    assert len(whole) > 10
    np.testing.assert_array_equal(heights, same_heights)
    assert [line.wkb for line in whole] == [line.wkb for line in parts]


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.15]), st.booleans())
def test_strips_leave_no_seam(tmp_path_factory, seed, holes, whole_metres):
    rng = np.random.default_rng(seed)
    # Waves that many lines cross several times, or whole numbers, where heights lie exactly on the levels.
    row, col = np.mgrid[:41, :23]
    z = 3 * np.sin(row / 2.3 + rng.uniform(0, 6)) * np.cos(col / 3.1) + rng.normal(0, 0.3, row.shape)
    z = np.round(z) if whole_metres else z
    z[rng.random(z.shape) < holes] = np.nan
    path = written(tmp_path_factory.mktemp("waves"), z)
    with BandReader(path) as heights:
        whole = list(contours(heights, 1.0, 1000))
        assert whole
        for rows in (1, 2, 7, 40):
            same(list(contours(heights, 1.0, rows)), whole)
            same(list(contours(heights, 1.0, rows, 12.0)), [one for one in whole if not is_ring_below(one[1], 12.0)])


def test_the_default_interval_suits_the_relief(tmp_path):
    for deviation, interval in [(1.0, 0.2), (5.0, 1.0), (6.25, 1.0), (6.26, 2.0), (30.0, 5.0), (0.0, 0.1), (1e3, 200)]:
        assert nice_interval(deviation) == interval, deviation
    z = np.tile(np.arange(200) * 0.25, (9, 1))
    # 0 to 50 m evenly: 14.4 m, so 57.7 m hold 11.5 intervals of 5 m.
    write_contours(written(tmp_path, z), tmp_path / "c.gpkg", ProductOptions())
    _, _, _, (elevation,) = pyogrio.raw.read(tmp_path / "c.gpkg")
    np.testing.assert_array_equal(np.unique(np.diff(elevation)), [5.0])


@given(st.floats(1e-3, 1e5))
def test_default_intervals_are_few_and_round(deviation):
    interval = nice_interval(deviation)
    digits = interval / 10 ** math.floor(math.log10(interval) + 1e-9)
    assert min(abs(digits - d) for d in (1, 2, 5)) < 1e-6
    assert 4 * deviation / interval <= 25 + 1e-6
    assert interval == 0.1 or 4 * deviation / interval >= 10 - 1e-6


def test_too_many_heights_are_refused(tmp_path):
    path = written(tmp_path, np.tile(np.arange(40) * 100.0, (3, 1)))
    with pytest.raises(ConfigError, match=r"every 0\.1 m of .*dsm\.tif.*0\.0 to 3900\.0 m"):
        write_contours(path, tmp_path / "contours.gpkg", replace(ProductOptions(), contour_interval_m=0.1))
    assert not (tmp_path / "contours.gpkg").exists()


@pytest.mark.parametrize("z", [np.full((5, 5), np.nan), np.full((5, 5), 3.0), np.zeros((1, 6)), np.zeros((6, 1))])
def test_where_there_is_nothing_to_draw(tmp_path, z):
    _, lines, _ = drawn(tmp_path, z, 1.0)
    assert len(lines) == 0


def test_in_a_local_frame_lines_have_no_crs(tmp_path):
    meta, lines, _ = drawn(tmp_path, np.tile(np.arange(40.0), (3, 1)), 5.0, local_frame().to_wkt())
    assert meta["crs"] is None
    assert len(lines) == 8


@pytest.mark.parametrize("level_m", [100.0, 100.3])
def test_no_contour_crosses_a_levelled_lake(tmp_path, level_m):
    """A contour at the very level of a lake goes around it, through its outermost cells."""
    row, col = np.mgrid[:80, :90]
    z = 97.0 + 0.08 * col + 0.02 * row
    lake = np.s_[20:60, 30:70]
    z[lake] = level_m
    _, lines, _ = drawn(tmp_path, z, 0.5, min_contour_cells=0.0)
    inner = box(WEST + 30.6 * CELL_M, NORTH - 59.4 * CELL_M, WEST + 69.4 * CELL_M, NORTH - 20.6 * CELL_M)
    assert len(lines) > 10
    assert not any(line.intersects(inner) for line in lines)
