from __future__ import annotations

import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.grid import CellWindow, cells_of_bounds, grid_from_bounds, grid_from_geobox

UTM = CRS.from_epsg(32632)


def box(transform, shape=(20, 30)):
    return GeoBox(shape, transform, UTM)


def check_lattice(grid):
    """The window's first cell has the transform's origin as its corner."""
    t = grid.geobox.transform
    assert grid.anchor[0] + grid.window.col * grid.cell_m == pytest.approx(t.c, abs=1e-6 * grid.cell_m)
    assert grid.anchor[1] - grid.window.row * grid.cell_m == pytest.approx(t.f, abs=1e-6 * grid.cell_m)
    assert (grid.window.rows, grid.window.cols) == tuple(grid.geobox.shape)


def test_bounds_are_widened_to_whole_cells():
    grid = grid_from_bounds((100.3, 200.2, 109.9, 205.0), 0.5, UTM)
    assert tuple(grid.geobox.boundingbox.bbox) == (100.0, 200.0, 110.0, 205.0)
    assert tuple(grid.geobox.shape) == (10, 20)
    assert grid.anchor == (0.0, 0.0)
    check_lattice(grid)


@given(st.integers(1_500_000, 1_600_000), st.integers(17_000_000, 18_000_000), st.sampled_from([0.1, 0.3, 0.7, 2.0]))
def test_bounds_on_cell_edges_stay(col, row, cell):
    """Also where the size of a cell is no binary fraction."""
    grid = grid_from_bounds((col * cell, row * cell, (col + 40) * cell, (row + 25) * cell), cell, UTM)
    assert tuple(grid.geobox.shape) == (25, 40)
    check_lattice(grid)


@given(
    st.floats(-1000, 1000),
    st.floats(-1000, 1000),
    st.floats(0.5, 90),
    st.floats(0.5, 90),
    st.sampled_from([0.3, 0.5, 1.7]),
)
def test_the_grid_contains_the_bounds_and_no_cell_lies_outside_them(x, y, width, height, cell):
    grid = grid_from_bounds((x, y, x + width, y + height), cell, UTM)
    xmin, ymin, xmax, ymax = grid.geobox.boundingbox.bbox
    near = 1e-5 * cell
    assert x - cell - near < xmin <= x + near
    assert x + width - near <= xmax < x + width + cell + near
    assert y - cell - near < ymin <= y + near
    assert y + height - near <= ymax < y + height + cell + near
    check_lattice(grid)


def test_an_area_without_a_cell_is_refused():
    with pytest.raises(GeometryError, match="holds no cell"):
        grid_from_bounds((1.0, 1.0, 1.0 + 1e-9, 1.0 + 1e-9), 1.0, UTM)


@pytest.mark.parametrize("origin", [(462_000.0, 5_247_000.0), (462_000.2, 5_247_000.35), (-3.3, -0.1)])
def test_the_grid_of_a_raster_is_taken_as_it_is(origin):
    geobox = box(Affine(0.5, 0, origin[0], 0, -0.5, origin[1]))
    grid = grid_from_geobox(geobox, "like.tif")
    assert grid.geobox is geobox
    assert 0 <= grid.anchor[0] < 0.5
    assert 0 <= grid.anchor[1] < 0.5
    check_lattice(grid)


@pytest.mark.parametrize("cell", [0.1, 0.3, 0.7, 0.5])
@pytest.mark.parametrize("column", [1_540_001, 1_540_002, 1_540_003, 1_540_007])
def test_a_raster_on_multiples_of_its_cells_shares_the_lattice_of_bounds(cell, column):
    """Else the same cells would be cut into other tiles."""
    bounds = (column * cell, 17_490_000 * cell, (column + 40) * cell, 17_490_025 * cell)
    asked = grid_from_bounds(bounds, cell, UTM)
    like = grid_from_geobox(asked.geobox, "like.tif")
    assert like.anchor == (0.0, 0.0)
    assert like.window == asked.window


@pytest.mark.parametrize(
    "transform", [Affine(0.5, 0, 0, 0, -0.7, 0), Affine(0.5, 0.1, 0, 0, -0.5, 0), Affine(0.5, 0, 0, 0, 0.5, 0)]
)
def test_a_raster_that_is_not_north_up_with_square_cells_is_refused(transform):
    with pytest.raises(ConfigError, match=r"like\.tif is not north up with square cells"):
        grid_from_geobox(box(transform), "like.tif")


def test_bounds_of_a_window_of_the_lattice():
    grid = grid_from_bounds((100.0, 200.0, 110.0, 205.0), 0.5, UTM)
    assert grid.bounds(grid.window) == (100.0, 200.0, 110.0, 205.0)
    first = grid.window
    assert grid.bounds(CellWindow(first.row + 2, first.col - 4, 3, 6)) == (98.0, 202.5, 101.0, 204.0)


def test_cells_of_bounds_are_whole_coarsest_cells():
    window = cells_of_bounds((100.3, -7.0, 140.2, 21.0), (0.5, 0.5), 0.5, 4)
    assert (window.row % 8, window.col % 8, window.rows % 8, window.cols % 8) == (0, 0, 0, 0)
    west, north = 0.5 + window.col * 0.5, 0.5 - window.row * 0.5
    assert west <= 100.3 < west + 4
    assert north >= 21.0 > north - 4
    assert west + window.cols * 0.5 >= 140.2
    assert north - window.rows * 0.5 <= -7.0
