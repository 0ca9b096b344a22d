"""Cells of surfaces on other grids: taken as they are, interpolated, averaged, and never between roof and ground."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS, Transformer

from overlapping_surfaces import write_raster, write_run
from zlocus.core.grid import CellWindow
from zlocus.io.surface_cells import PlacedSurface, read_cells
from zlocus.io.surface_inputs import surface_input

# Bilinear interpolation of a plane is exact but for the rounding of float32.
PLANE_M = 2e-4
WHOLE = CellWindow(0, 0, 30, 40)
GRID = Affine(1.0, 0.0, 4e5, 0.0, -1.0, 5e6)


def plane(transform, rows, cols):
    col, row = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    x, y = transform.a * col + transform.c, transform.e * row + transform.f
    return (50.0 + 0.3 * (x - 4e5) - 0.2 * (y - 5e6)).astype(np.float32)


@pytest.fixture
def grid(tmp_path):
    return surface_input(write_raster(tmp_path / "grid.tif", plane(GRID, 30, 40), GRID))


def placed(path, grid, **more):
    return PlacedSurface(surface_input(path), grid.geobox, grid.crs, **more)


def test_cells_that_lie_on_the_grid_are_taken_as_they_are(tmp_path, grid):
    rng = np.random.default_rng(0)
    z, moved = rng.normal(size=(20, 25)), GRID * Affine.translation(-3, 5)
    quality = rng.integers(0, 60000, z.shape).astype(np.uint16)
    run = placed(write_run(tmp_path / "run", z, np.full(z.shape, 0.2), moved, quality=quality), grid, offset_m=0.5)
    assert run.is_on_grid
    assert run.window == CellWindow(5, -3, 20, 25)
    cells = read_cells(run, WHOLE)
    assert np.array_equal(cells.height[5:25, :22], z.astype(np.float32)[:, 3:] - np.float32(0.5))
    assert np.isnan(cells.height[:5]).all()
    assert np.isnan(cells.height[:, 22:]).all()
    assert np.array_equal(cells.flags["quality.tif"][5:25, :22], quality[:, 3:])
    assert cells.is_inside.sum() == 20 * 22


def test_a_plane_between_cells_is_exact(tmp_path, grid):
    moved = Affine(0.8, 0.0, 4e5 - 5.3, 0.0, -0.8, 5e6 + 7.1)
    run = placed(f"{write_raster(tmp_path / 'a.tif', plane(moved, 60, 70), moved)}=0.4", grid)
    cells = read_cells(run, WHOLE)
    assert not run.is_on_grid
    assert np.allclose(cells.height, plane(GRID, 30, 40), atol=PLANE_M)
    assert np.allclose(cells.sigma, 0.4)


def test_a_plane_in_another_crs(tmp_path, grid):
    """Heights of a plane in the grid's CRS, on cells of another zone."""
    to_grid = Transformer.from_crs("EPSG:32633", CRS.from_epsg(32632), always_xy=True)
    x, y = Transformer.from_crs("EPSG:32632", "EPSG:32633", always_xy=True).transform(4e5 + 20, 5e6 - 15)
    other = Affine(1.0, 0.0, x - 60, 0.0, -1.0, y + 60)
    col, row = np.meshgrid(np.arange(120) + 0.5, np.arange(120) + 0.5)
    at_x, at_y = to_grid.transform(other.a * col + other.c, other.e * row + other.f)
    z = (50.0 + 0.3 * (at_x - 4e5) - 0.2 * (at_y - 5e6)).astype(np.float32)
    run = placed(write_raster(tmp_path / "a.tif", z, other, "EPSG:32633"), grid)
    assert np.allclose(read_cells(run, WHOLE).height, plane(GRID, 30, 40), atol=10 * PLANE_M)


def test_a_jump_is_not_interpolated(tmp_path, grid):
    moved = GRID * Affine.translation(0.4, 0.4)
    z = np.full((30, 40), 10.0, np.float32)
    z[:, 20:] = 22.0
    cells = read_cells(placed(write_raster(tmp_path / "a.tif", z, moved), grid), WHOLE)
    assert set(np.unique(cells.height[1:, 1:])) == {10.0, 22.0}


def test_smaller_cells_are_averaged(tmp_path, grid):
    fine = Affine(0.25, 0.0, 4e5, 0.0, -0.25, 5e6)
    rng = np.random.default_rng(2)
    z = rng.normal(size=(120, 160)).astype(np.float32)
    z[:4, :4], z[4:8, :2] = np.nan, np.nan
    cells = read_cells(placed(write_raster(tmp_path / "a.tif", z, fine), grid), WHOLE)
    means = np.nanmean(z[8:].reshape(28, 4, 40, 4), axis=(1, 3))
    assert np.allclose(cells.height[2:], means, atol=1e-6)
    assert np.isnan(cells.height[0, 0])
    assert cells.height[1, 0] == pytest.approx(np.nanmean(z[4:8, :4]), abs=1e-6), "half of the cells are enough"


def test_much_smaller_cells_are_read_from_fewer(tmp_path, grid):
    fine = Affine(0.05, 0.0, 4e5, 0.0, -0.05, 5e6)
    run = placed(write_raster(tmp_path / "a.tif", plane(fine, 600, 800), fine, nodata=float("nan")), grid)
    cells = read_cells(run, WHOLE)
    assert np.allclose(cells.height, plane(GRID, 30, 40), atol=0.02)


def test_missing_heights_stay_missing(tmp_path, grid):
    z = plane(GRID, 30, 40)
    z[3, 4], z[5, 6], z[7, 8] = -9999.0, np.nan, 77.0
    cells = read_cells(placed(write_raster(tmp_path / "a.tif", z, GRID, nodata=77.0), grid), WHOLE)
    assert np.isnan(cells.height[[3, 5, 7], [4, 6, 8]]).all()
    assert np.isfinite(cells.height).sum() == 30 * 40 - 3
