from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from location_grids import WGS84, grid_of
from reference import location_grid as plain
from rpc_fixtures import satellite_rpc
from zlocus.core.sensor_model import SensorModel
from zlocus.sensors.earth_frame import EarthSpace
from zlocus.sensors.location_grid import MARGIN_PX, LocationGrid, LocationGridModel, spline_coefficients
from zlocus.sensors.rpc import RpcModel

UTM31 = CRS.from_epsg(32631)
ROUND_TRIP_PX = 1e-6
# Between nodes 500 px apart.
INTERPOLATED_PX = 1e-4
# The same sums in another order, of coordinates of 5000 km.
SAME_M = 1e-7
FIRST_NODE, STEP, SHAPE = (18000.0, 17000.5), (500.0, 400.0), (9, 11)
LAST_NODE = (23000.0, 20200.5)
HEIGHTS = (-100.0, 150.0, 500.0, 900.0, 1000.0)


@pytest.fixture(scope="module")
def exact() -> RpcModel:
    return RpcModel(satellite_rpc(), UTM31)


@pytest.fixture(scope="module")
def location_grid(exact: RpcModel) -> LocationGrid:
    return grid_of(exact, UTM31, HEIGHTS, FIRST_NODE, STEP, SHAPE)


@pytest.fixture(scope="module")
def model(location_grid: LocationGrid) -> LocationGridModel:
    return LocationGridModel(location_grid, UTM31)


def test_is_the_sensor_that_it_was_made_of_between_its_nodes(model, exact):
    rng = np.random.default_rng(1)
    xy, z = rng.uniform(FIRST_NODE, LAST_NODE, (500, 2)), rng.uniform(HEIGHTS[0], HEIGHTS[-1], 500)
    xyz = model.ground_from_image(xy, z)
    assert (xyz[:, 2] == z).all()
    np.testing.assert_allclose(exact.image_from_ground(xyz), xy, rtol=0, atol=INTERPOLATED_PX)
    assert model.height_bounds() == (HEIGHTS[0], HEIGHTS[-1])
    assert model.location_grid.last_node == LAST_NODE


@given(st.floats(14000, 27000), st.floats(13000, 24000), st.floats(-340, 1090))
def test_image_to_ground_to_image(model: LocationGridModel, column: float, row: float, z: float):
    """Also outside of the nodes, and below and above the heights."""
    xyz = model.ground_from_image(np.array([[column, row]]), np.array([z]))
    np.testing.assert_allclose(model.image_from_ground(xyz), [[column, row]], rtol=0, atol=ROUND_TRIP_PX)


@given(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3))
def test_any_point_is_mapped_or_nan(model: LocationGridModel, point: tuple[float, float, float]):
    for found in (
        model.image_from_ground(np.array([point])),
        model.ground_from_image(np.array([point[:2]]), np.array(point[2:])),
    ):
        assert np.isfinite(found).all() or np.isnan(found).all()


@pytest.mark.parametrize("shape", [(2, 2), (3, 5), (4, 3)])
@pytest.mark.parametrize("n_heights", [3, 5])
def test_kernels_are_their_plain_twins(exact, shape, n_heights):
    own = grid_of(exact, UTM31, HEIGHTS[:n_heights], FIRST_NODE, STEP, shape)
    model, own = LocationGridModel(own, UTM31), own.in_crs(UTM31)
    rng = np.random.default_rng(2)
    xy = rng.uniform(np.subtract(FIRST_NODE, 900), np.add(own.last_node, 900), (25, 2))
    z = rng.uniform(HEIGHTS[0] - 50, own.heights[-1] + 50, 25)
    expected = [plain.ground_position(own, *place, height) for place, height in zip(xy, z, strict=True)]
    xyz = model.ground_from_image(xy, z)
    np.testing.assert_allclose(xyz[:, :2], expected, rtol=0, atol=SAME_M)
    np.testing.assert_allclose(model.image_from_ground(xyz), xy, rtol=0, atol=ROUND_TRIP_PX)


@pytest.mark.parametrize("n", [2, 3, 4, 7])
def test_splines_go_through_their_values_and_keep_polynomials(n):
    """Values at nodes are those given, and a polynomial of the degree that n values determine is met between them."""
    at = np.arange(n)
    values = np.stack([1.0 + 2.0 * at, (at - 0.5) ** min(n - 1, 3)], axis=-1)
    found = spline_coefficients(values, 0)
    between = (found[:-3] + 23 * found[1:-2] + 23 * found[2:-1] + found[3:]) / 48
    np.testing.assert_allclose((found[:-2] + 4 * found[1:-1] + found[2:]) / 6, values, rtol=0, atol=1e-12)
    expected = np.stack([1.0 + 2.0 * (at[:-1] + 0.5), at[:-1] ** float(min(n - 1, 3))], axis=-1)
    np.testing.assert_allclose(between, expected, rtol=0, atol=1e-12)


def test_ends_where_it_says(model):
    edge = np.array([FIRST_NODE[0] - MARGIN_PX, FIRST_NODE[1]])
    assert np.isfinite(model.ground_from_image(edge[None], np.array([0.0]))).all()
    for xy, z in (
        (edge - [1.0, 0.0], 0.0), (np.add(LAST_NODE, [0.0, MARGIN_PX + 1.0]), 0.0),
        (edge, HEIGHTS[0] - 251.0), (edge, HEIGHTS[-1] + 101.0), ((np.nan, 0.0), 0.0), (edge, np.nan),
    ):  # fmt: skip
        assert np.isnan(model.ground_from_image(np.array([xy]), np.array([z]))).all()
    xyz = model.ground_from_image(np.array([FIRST_NODE]), np.array([0.0]))
    assert np.isnan(model.image_from_ground(np.add(xyz, [1e5, 0.0, 0.0]))).all()
    assert np.isnan(model.image_from_ground(np.add(xyz, [0.0, 0.0, 2000.0]))).all()


def test_two_heights_have_straight_rays_between_them(exact, location_grid):
    """Rays from a point in space, whose horizontal coordinates are not linear in the height, by 0.1 m."""
    space, low, high = EarthSpace(UTM31), 0.0, 3000.0
    camera = space.cartesian_from_ground(np.array([[500_000.0, 4_700_000.0, 600_000.0]]))

    class Pencil:
        def ground_from_image(self, xy, z):
            plane = np.column_stack([200_000.0 + xy[:, 0] + 250_000.0, 4_500_000.0 - xy[:, 1], np.zeros(len(xy))])
            return space.meet(camera[0], space.cartesian_from_ground(plane) - camera, np.asarray(z, float))

    model = LocationGridModel(grid_of(Pencil(), UTM31, (low, high), (0.0, 0.0), (500.0, 500.0), (5, 6)), UTM31)
    rng = np.random.default_rng(4)
    xy, z = rng.uniform(0, 2000, (100, 2)), rng.uniform(low, high, 100)
    truth = Pencil().ground_from_image(xy, z)
    np.testing.assert_allclose(model.ground_from_image(xy, z), truth, rtol=0, atol=1e-4)
    assert model.height_bounds() == (low, high)
    ends = [Pencil().ground_from_image(xy, np.full(100, height)) for height in (low, high)]
    straight = ends[0] + ((z - low) / (high - low))[:, None] * (ends[1] - ends[0])
    assert np.abs(straight - truth).max() > 0.1


def test_a_folded_cell_is_found(location_grid):
    assert location_grid.folded_cell() is None
    assert replace(location_grid, xy=location_grid.xy[..., ::-1]).folded_cell() is None  # mirrored as a whole
    exchanged = location_grid.xy.copy()
    exchanged[2, 4, [6, 7]] = exchanged[2, 4, [7, 6]]
    assert replace(location_grid, xy=exchanged).folded_cell() == (2, 3, 6)
    same = location_grid.xy.copy()
    same[:, :, 5] = same[:, :, 4]
    assert replace(location_grid, xy=same).folded_cell() == (0, 0, 4)
    assert replace(location_grid, xy=np.zeros_like(same)).folded_cell() == (0, 0, 0)


def test_any_crs_of_the_nodes(location_grid, model):
    on_map = LocationGridModel(location_grid.in_crs(CRS.from_epsg(32632)), UTM31)
    xyz = model.ground_from_image(np.array([[20000.0, 18000.0]]), np.array([300.0]))
    np.testing.assert_allclose(on_map.image_from_ground(xyz), [[20000.0, 18000.0]], rtol=0, atol=INTERPOLATED_PX)
    assert location_grid.crs == WGS84


def test_is_a_sensor_model_that_travels_between_processes(model):
    copy = pickle.loads(pickle.dumps(model))
    assert isinstance(copy, SensorModel)
    xyz = model.ground_from_image(np.array([[20000.0, 18000.0]]), np.array([300.0]))
    np.testing.assert_array_equal(copy.image_from_ground(xyz), model.image_from_ground(xyz))
