"""Water surfaces of rasters that are being written: levelled to the cell, with the level of the whole surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from affine import Affine
from odc.geo.geobox import GeoBox

import zlocus.products.water as water_module
from zlocus.core.options import WaterOptions
from zlocus.io.water_polygons import WaterPolygons
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.matching.water_level import MAX_SIGMA_CELLS, is_confident, shore_cells, tells_level
from zlocus.products.rasters import SurfaceRasters, WaterKind
from zlocus.products.water import level_water, without_cells

ROWS, COLS, CELL_M, WEST, NORTH = 150, 210, 0.5, 500_000.0, 5_200_000.0
GRID = GeoBox((ROWS, COLS), Affine(CELL_M, 0, WEST, 0, -CELL_M, NORTH), "EPSG:32632")
LAKE_M, POND_M, LAND_M, LEVEL_ERROR_M = 200.0, 210.0, 215.0, 0.02
# Outlines off the borders of cells, in cells from the upper left corner (column, row); the lake has an island.
LAKE_SHAPE = shapely.Polygon(
    [(20.3, 15.2), (120.7, 25.1), (110.2, 120.6), (60.4, 95.9), (15.8, 110.3)],
    [[(60.1, 50.2), (75.7, 52.3), (70.4, 70.8)]],
)
POND_SHAPE = shapely.box(150.4, 40.6, 185.2, 80.9)
OPTIONS = WaterOptions()


def placed(shape):
    return shapely.transform(shape, lambda xy: np.column_stack([WEST + CELL_M * xy[:, 0], NORTH - CELL_M * xy[:, 1]]))


def cells_of(shape):
    """Whether each cell's centre lies in a shape: the slow twin, point by point."""
    col, row = np.meshgrid(np.arange(COLS) + 0.5, np.arange(ROWS) + 0.5)
    return shapely.contains_xy(shape, col, row)


def polygons(*shapes, levels=None):
    names = tuple(f"polygon {k + 1}" for k in range(len(shapes)))
    known = np.full(len(shapes), np.nan) if levels is None else np.array(levels, float)
    return WaterPolygons(Path("water.gpkg"), np.array([placed(shape) for shape in shapes], object), names, known)


@pytest.fixture
def matched():
    """Land, with noise on the water but for the cells at its shore; each water is lower than the land."""
    rng = np.random.default_rng(6)
    height = (LAND_M + 0.05 * rng.standard_normal((ROWS, COLS))).astype(np.float32)
    quality = np.zeros((ROWS, COLS), np.uint16)
    for shape, level in ((LAKE_SHAPE, LAKE_M), (POND_SHAPE, POND_M)):
        inside, away = cells_of(shape), cells_of(shape.buffer(-3.5))
        height[inside] = level + 0.01 * rng.standard_normal(int(inside.sum()))
        height[away] += rng.normal(0.0, 3.0, int(away.sum()))
        quality[away] = Quality.WEAK | Quality.JUMP
    sigma = np.full(height.shape, 0.1, np.float32)
    grey = np.where(quality == 0, rng.integers(300, 700, height.shape), 200).astype(np.float32)
    return Surface(height, sigma, quality, np.full(height.shape, 3, np.uint8), grey)


def made(folder, surface, water=None, level_possible=False, options=OPTIONS, side=70):
    """The rasters of a surface that is written in tiles, and what was found of water."""
    with SurfaceRasters(folder, GRID, "uint16") as rasters:
        for row in range(0, ROWS, side):
            for col in range(0, COLS, side):
                part = (np.s_[row : row + side, col : col + side],)
                rasters.write(row, col, Surface(*(array[part[0]] for array in surface.arrays)))
        found = level_water(rasters, GRID, water, level_possible, options)
    read = {}
    for name in ("dsm", "sigma", "quality", "views", "water"):
        with rasterio.open(folder / f"{name}.tif") as file:
            read[name] = file.read(1)
    return read, found


def test_two_ponds_an_island_and_every_cell(tmp_path, matched):
    """Two levels; cells whose centre lies inside have it, all with the same bytes, and no other cell changes."""
    read, found = made(tmp_path, matched, polygons(LAKE_SHAPE, POND_SHAPE))
    lake, pond = cells_of(LAKE_SHAPE), cells_of(POND_SHAPE)
    for inside, level, one in zip((lake, pond), (LAKE_M, POND_M), found.levelled_surfaces, strict=True):
        (value,) = np.unique(read["dsm"][inside])
        assert value == np.float32(one.level.height_m)
        assert abs(value - level) < LEVEL_ERROR_M
        (sigma,) = np.unique(read["sigma"][inside])
        assert sigma == np.float32(one.level.sigma_m)
        assert (one.level.source, one.n_cells, one.water_kind) == ("rim", inside.sum(), WaterKind.LEVELLED)
    both = lake | pond
    np.testing.assert_array_equal(read["water"], np.where(both, WaterKind.LEVELLED, WaterKind.LAND))
    np.testing.assert_array_equal(read["quality"][both], Quality.WATER)
    np.testing.assert_array_equal(read["views"][both], 0)
    for name, before in (("dsm", matched.height), ("quality", matched.quality), ("views", matched.views)):
        np.testing.assert_array_equal(read[name][~both], before[~both])
    assert not lake[60, 68]  # the island
    assert found.left == []


def test_a_level_of_an_attribute_is_written_as_it_is(tmp_path, matched):
    read, found = made(tmp_path, matched, polygons(LAKE_SHAPE, POND_SHAPE, levels=[199.37, np.nan]))
    assert set(read["dsm"][cells_of(LAKE_SHAPE)]) == {np.float32(199.37)}
    assert np.isnan(read["sigma"][cells_of(LAKE_SHAPE)]).all()
    lake, pond = found.levelled_surfaces
    assert (lake.level.source, pond.level.source) == ("attribute", "rim")
    record = found.as_dict()["levelled"][0]
    assert record == {
        "name": "polygon 1", "kind": "levelled", "level_m": 199.37, "sigma_m": pytest.approx(np.nan, nan_ok=True),
        "source": "attribute", "n_cells": int(cells_of(LAKE_SHAPE).sum()), "n_used": 0,
    }  # fmt: skip


def test_levels_do_not_depend_on_tiles_and_strips(tmp_path, matched, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    whole, found = made(tmp_path / "a", matched, polygons(LAKE_SHAPE, POND_SHAPE), True)
    monkeypatch.setattr(water_module, "STRIP_ROWS", 13)
    cut, again = made(tmp_path / "b", matched, polygons(LAKE_SHAPE, POND_SHAPE), True, side=33)
    assert found == again
    for name, values in whole.items():
        np.testing.assert_array_equal(values, cut[name])


@pytest.mark.parametrize("strip_rows", [128, 13])
def test_every_cell_beside_the_shore_is_used_once(tmp_path, matched, monkeypatch, strip_rows):
    monkeypatch.setattr(water_module, "STRIP_ROWS", strip_rows)
    matched.sigma[::3] = MAX_SIGMA_CELLS * CELL_M * 1.01  # too imprecise
    _, found = made(tmp_path, matched, polygons(LAKE_SHAPE, POND_SHAPE))
    lake, pond = cells_of(LAKE_SHAPE), cells_of(POND_SHAPE)
    sure = tells_level(is_confident(matched.height, matched.quality), matched.sigma, matched.views, CELL_M)
    for one, inside in zip(found.levelled_surfaces, (lake, pond), strict=True):
        at_shore = shore_cells(inside, lake | pond, OPTIONS.shore_cells)
        assert one.level.n_used == (sure & (at_shore.water | at_shore.land)).sum()


def test_the_border_of_the_grid_is_no_shore(tmp_path, matched):
    """A lake that goes on beyond the grid: what is matched beside the border, by chance, does not count."""
    shape = shapely.box(-50.0, -20.0, 60.2, 70.3)
    inside, away, beside_border = cells_of(shape), cells_of(shape.buffer(-3.5)), np.indices((ROWS, COLS))[0] < 3
    matched.height[inside] = LAKE_M
    matched.quality[away] = Quality.WEAK
    matched.height[inside & beside_border] -= 7.0
    matched.quality[inside & beside_border] = 0
    read, found = made(tmp_path, matched, polygons(shape))
    (one,) = found.levelled_surfaces
    assert one.level.height_m == pytest.approx(LAKE_M, abs=LEVEL_ERROR_M)
    assert set(read["dsm"][inside]) == {np.float32(one.level.height_m)}


def test_cells_that_were_not_asked_for_or_failed_stay_empty(tmp_path, matched):
    """Cells that the images do not see are levelled, and say why they had no height."""
    for rows, flag in ((np.s_[40:45], Quality.OUTSIDE), (np.s_[50:55], Quality.FAILED), (np.s_[60:65], Quality.UNSEEN)):
        matched.height[rows], matched.quality[rows], matched.sigma[rows] = np.nan, flag, np.nan
    read, found = made(tmp_path, matched, polygons(POND_SHAPE))
    pond = cells_of(POND_SHAPE)
    for rows, flag in ((np.s_[40:45], Quality.OUTSIDE), (np.s_[50:55], Quality.FAILED)):
        assert np.isnan(read["dsm"][rows]).all()
        assert (read["quality"][rows] == flag).all()
        assert (read["water"][rows] == WaterKind.LAND).all()
    assert set(read["quality"][60:65][pond[60:65]]) == {Quality.UNSEEN | Quality.WATER}
    (one,) = found.levelled_surfaces
    assert one.n_cells == pond.sum() - pond[40:45].sum() - pond[50:55].sum()
    assert found.n_seen == one.n_cells - pond[60:65].sum()
    assert found.n_matched == found.n_seen


def test_a_filled_cell_is_not_taken_off_the_matched_ones(tmp_path, matched):
    matched.quality[60:65] = Quality.NO_MATCH | Quality.FILLED
    _, found = made(tmp_path, matched, polygons(POND_SHAPE))
    assert found.n_seen - found.n_matched == cells_of(POND_SHAPE)[60:65].sum()


def test_a_polygon_without_evidence_is_left_as_it_is(tmp_path, matched):
    doubtful = replace(matched, quality=np.full_like(matched.quality, Quality.WEAK))
    read, found = made(tmp_path, doubtful, polygons(LAKE_SHAPE, POND_SHAPE, levels=[np.nan, 5.0]))
    assert found.left == ["polygon 1"]
    assert [one.name for one in found.levelled_surfaces] == ["polygon 2"]
    lake = cells_of(LAKE_SHAPE)
    np.testing.assert_array_equal(read["dsm"][lake], matched.height[lake])
    assert (read["water"][lake] == WaterKind.POSSIBLE).all()


def test_of_two_polygons_over_one_cell_the_last_counts(tmp_path, matched):
    inner = POND_SHAPE.buffer(-6.0)
    read, _ = made(tmp_path, matched, polygons(POND_SHAPE, inner, levels=[1.0, 2.0]))
    expected = np.where(cells_of(inner), 2.0, 1.0)[cells_of(POND_SHAPE)]
    np.testing.assert_array_equal(read["dsm"][cells_of(POND_SHAPE)], expected.astype(np.float32))


def test_surfaces_that_touch_have_no_shore_between_them(tmp_path, matched):
    """One lake in two polygons, whose common edge lies in the noise: both have the level of the shore."""
    west, east = (shapely.box(150.4, 40.6, 167.6, 80.9), shapely.box(167.6, 40.6, 185.2, 80.9))
    edge = cells_of(shapely.box(165.0, 45.0, 170.0, 76.0))
    matched.quality[edge] = 0
    matched.height[edge] = POND_M - 20.0
    _, found = made(tmp_path, matched, polygons(west, east))
    for one in found.levelled_surfaces:
        assert one.level.height_m == pytest.approx(POND_M, abs=LEVEL_ERROR_M)


def test_possible_water_is_marked_and_levelled_on_request(tmp_path, matched):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    lake, pond = cells_of(LAKE_SHAPE), cells_of(POND_SHAPE)
    matched.height[~lake & ~pond] += LAKE_M + 0.1 - LAND_M
    matched.height[pond] += LAKE_M - POND_M
    options = WaterOptions(min_area_m2=100.0)
    read, found = made(tmp_path / "a", matched, options=options)
    assert found.n_possible == 2
    assert found.levelled_surfaces == []
    marked = read["water"] == WaterKind.POSSIBLE
    assert set(np.unique(read["water"])) == {WaterKind.LAND, WaterKind.POSSIBLE}
    away = cells_of(LAKE_SHAPE.buffer(-9.0)) | cells_of(POND_SHAPE.buffer(-9.0))
    beyond = ~cells_of(LAKE_SHAPE.buffer(4.0)) & ~cells_of(POND_SHAPE.buffer(4.0))
    assert marked[away].mean() > 0.9
    assert not marked[beyond].any()
    np.testing.assert_array_equal(read["dsm"], matched.height)
    read, found = made(tmp_path / "b", matched, level_possible=True, options=options)
    assert [one.name for one in found.levelled_surfaces] == ["possible water 1", "possible water 2"]
    np.testing.assert_array_equal(read["water"] == WaterKind.POSSIBLE_LEVELLED, marked)
    assert (read["quality"][marked] == Quality.WATER).all()
    assert np.abs(read["dsm"][marked] - LAKE_M).max() < 0.1
    # What a polygon holds is known, and no possible water.
    (tmp_path / "c").mkdir()
    assert made(tmp_path / "c", matched, polygons(LAKE_SHAPE, POND_SHAPE), options=options)[1].n_possible == 0
    assert len(np.unique(read["dsm"][marked])) == 2


def test_polygons_without_a_cell_are_named():
    far, small = shapely.box(-90.0, -90.0, -50.0, -50.0), shapely.box(10.6, 10.6, 10.9, 10.9)
    assert without_cells(polygons(far, POND_SHAPE, small), GRID) == ["polygon 1", "polygon 3"]
