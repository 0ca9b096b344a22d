from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS
from rasterio.transform import RPCTransformer

from reference import rpc as plain
from rpc_fixtures import satellite_rpc
from zlocus.core.sensor_model import SensorModel
from zlocus.io.cameras.rpc import read_rpc
from zlocus.products.rpc_copies import gdal_rpc
from zlocus.sensors.rpc import TOLERANCE_PX, RpcModel, rpc_terms
from zlocus.sensors.rpc_kernel import ground_positions, positions

UTM31 = CRS.from_epsg(32631)
ROUND_TRIP_PX = 1e-6
GDAL_PX = 1e-3
# Of normalised coordinates: the order of sums; and two Newton steps that both reach TOLERANCE_PX.
NORMALISED, GROUND = 1e-10, 1e-9
METRES_PER_DEGREE = 111_000.0
CROPS = ("pleiades_triplet_calanques/img_01.tif", "pleiades_pair_ventoux/img_02.tif", "rendered-city/img_f1.tif")


@pytest.fixture(scope="module")
def model() -> RpcModel:
    return RpcModel(satellite_rpc(), UTM31)


def test_terms_stand_in_the_order_of_rpc00b():
    terms = rpc_terms(np.array([2.0]), np.array([3.0]), np.array([5.0]))[:, 0]
    expected = [1, 2, 3, 5, 6, 10, 15, 4, 9, 25, 30, 8, 18, 50, 12, 27, 75, 20, 45, 125]
    assert terms.tolist() == expected


def test_slopes_are_the_derivatives_of_the_polynomials():
    rng = np.random.default_rng(5)
    polynomials = ("line_num", "line_den", "samp_num", "samp_den")
    rpc = replace(satellite_rpc(), **{name: tuple(rng.normal(size=20)) for name in polynomials})
    (lon, lat, height), d = rng.uniform(-1, 1, (3, 7)), 1e-5
    found = (rpc.slopes @ rpc_terms(lon, lat, height)[:10]).reshape(2, 4, 7)
    by_lon = rpc.matrix @ (rpc_terms(lon + d, lat, height) - rpc_terms(lon - d, lat, height)) / (2 * d)
    by_lat = rpc.matrix @ (rpc_terms(lon, lat + d, height) - rpc_terms(lon, lat - d, height)) / (2 * d)
    np.testing.assert_allclose(found, [by_lon, by_lat], rtol=0, atol=1e-7)


def any_rpc(seed, relief):
    """An RPC whose polynomials differ from those of a satellite by random terms."""
    rng, rpc = np.random.default_rng(seed), satellite_rpc()
    names = ("line_num", "line_den", "samp_num", "samp_den")
    near = {name: np.array(getattr(rpc, name)) + np.r_[0.0, rng.uniform(-relief, relief, 19)] for name in names}
    return replace(rpc, **{name: tuple(values) for name, values in near.items()})


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.02, 0.3]))
def test_kernels_are_their_plain_twins(seed, relief):
    """Also where polynomials have poles, and where no ground shows at a pixel."""
    rpc, rng = any_rpc(seed, relief), np.random.default_rng(seed + 1)
    lon, lat, height = rng.uniform(-1.5, 1.5, (3, 40))
    height[0] = np.nan
    found, expected = np.empty((40, 2)), plain.positions(rpc, lon, lat, height)
    positions(rpc.by_term, lon, lat, height, found)
    np.testing.assert_allclose(found, expected, rtol=NORMALISED, atol=NORMALISED)
    target = rng.uniform(-1.2, 1.2, (40, 2))
    ground, expected = np.empty((40, 2)), plain.ground_positions(rpc, target, height)
    tolerance = TOLERANCE_PX / np.array([rpc.samp_scale, rpc.line_scale])
    ground_positions(rpc.by_term, rpc.slopes_by_term, target, height, tolerance, ground)
    # Where a path passes a pole, a rounding decides whether and where it ends.
    apart = ~np.isclose(ground, expected, rtol=0, atol=GROUND, equal_nan=True).all(axis=1)
    assert apart.sum() <= (0 if relief < 0.1 else 4)
    assert np.isnan(ground[0]).all()
    assert np.isfinite(ground[1:]).all() or relief > 0


def test_is_a_sensor_model_that_travels_between_processes(model: RpcModel):
    copy = pickle.loads(pickle.dumps(model))
    assert isinstance(copy, SensorModel)
    xyz = model.ground_from_image(np.array([[100.0, 200.0]]), np.array([300.0]))
    np.testing.assert_array_equal(copy.image_from_ground(xyz), model.image_from_ground(xyz))


@given(st.floats(-1000, 41000), st.floats(-1000, 41000), st.floats(-50, 950))
def test_image_to_ground_to_image_inside_the_box(model: RpcModel, column: float, row: float, z: float):
    xyz = model.ground_from_image(np.array([[column, row]]), np.array([z]))
    assert xyz[0, 2] == z
    np.testing.assert_allclose(model.image_from_ground(xyz), [[column, row]], atol=ROUND_TRIP_PX)


@given(st.floats(-0.95, 0.95), st.floats(-0.95, 0.95), st.floats(-50, 950))
def test_ground_to_image_to_ground_inside_the_box(model: RpcModel, lon: float, lat: float, z: float):
    rpc = model.rpc
    place = (rpc.lon_off + lon * rpc.lon_scale, rpc.lat_off + lat * rpc.lat_scale, z)
    xy = model.image_from_geographic(*(np.array([value]) for value in place))
    back = model.geographic_from_image(xy, np.array([z]))
    np.testing.assert_allclose(np.ravel(back), place[:2], atol=ROUND_TRIP_PX * 0.5 / METRES_PER_DEGREE)


@given(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3))
def test_any_ground_point_is_projected_or_nan(model: RpcModel, xyz: tuple[float, float, float]):
    xy = model.image_from_ground(np.array([xyz]))
    assert np.isfinite(xy).all() or np.isnan(xy).all()


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9), st.floats(-1e6, 1e6))
def test_any_image_point_converges_or_is_nan(model: RpcModel, column: float, row: float, z: float):
    lon, lat = model.geographic_from_image(np.array([[column, row]]), np.array([z]))
    if np.isfinite(lon[0]):
        again = model.image_from_geographic(lon, lat, np.array([z]))
        np.testing.assert_allclose(again, [[column, row]], rtol=1e-9, atol=ROUND_TRIP_PX)
    else:
        assert np.isnan(lon[0])
        assert np.isnan(lat[0])


def test_one_lost_point_does_not_harm_its_neighbours(model: RpcModel):
    xy = np.array([[100.0, 200.0], [np.nan, 0.0], [1e9, -1e9], [100.0, 200.0]])
    xyz = model.ground_from_image(xy, np.full(4, 300.0))
    assert np.isnan(xyz[1]).all()
    assert np.isnan(model.ground_from_image(xy[:1], np.array([np.nan]))).all()
    np.testing.assert_array_equal(xyz[0], xyz[3])
    np.testing.assert_allclose(model.image_from_ground(xyz[:1]), xy[:1], atol=ROUND_TRIP_PX)
    assert model.ground_from_image(np.empty((0, 2)), np.empty(0)).shape == (0, 3)


def test_beyond_a_pole_is_nan():
    rpc = satellite_rpc()
    model = RpcModel(replace(rpc, line_den=(1.0, 0.5) + (0.0,) * 18), UTM31)
    lon = rpc.lon_off + rpc.lon_scale * np.array([-1.9, -2.1])
    xy = model.image_from_geographic(lon, np.full(2, rpc.lat_off), np.full(2, rpc.height_off))
    assert np.isfinite(xy[0]).all()
    assert np.isnan(xy[1]).all()


def test_a_target_near_a_pole_is_reached_in_short_steps():
    rpc = satellite_rpc()
    linear = (0.0, 1.0) + (0.0,) * 18
    model = RpcModel(replace(rpc, samp_num=linear, samp_den=(1.0, 0.5) + (0.0,) * 18), UTM31)
    height = np.array([rpc.height_off])
    lon = np.array([rpc.lon_off - 1.5 * rpc.lon_scale])
    xy = model.image_from_geographic(lon, np.array([rpc.lat_off]), height)
    np.testing.assert_allclose(model.geographic_from_image(xy, height)[0], lon, atol=1e-11)


def test_longitudes_across_the_date_line_are_neighbours(model: RpcModel):
    rpc = replace(model.rpc, lon_off=179.95)
    across, zero = RpcModel(rpc, CRS.from_epsg(32660)), np.zeros(1)
    xy = across.image_from_geographic(np.array([-179.97]), np.array([43.25]), zero)
    np.testing.assert_allclose(xy, model.image_from_geographic(np.array([5.58]), np.array([43.25]), zero), atol=1e-5)
    lon, _ = across.geographic_from_image(xy, zero)
    np.testing.assert_allclose(lon, [-179.97], atol=1e-11)


def test_moved_shifts_the_image(model: RpcModel):
    xyz = model.ground_from_image(np.array([[100.0, 200.0]]), np.array([300.0]))
    moved = RpcModel(model.rpc.moved(column=2.5, row=-1.0), UTM31)
    np.testing.assert_allclose(moved.image_from_ground(xyz), [[102.5, 199.0]], atol=ROUND_TRIP_PX)


def assert_agrees_with_gdal(model: RpcModel, xy: np.ndarray, z: np.ndarray) -> None:
    """GDAL's (0, 0) is the outer corner of the first pixel: half a pixel more than ours."""
    lon, lat = model.geographic_from_image(xy, z)
    with RPCTransformer(gdal_rpc(model.rpc), RPC_PIXEL_ERROR_THRESHOLD=1e-6, RPC_MAX_ITERATIONS=50) as gdal:
        rows, cols = gdal.rowcol(lon, lat, zs=z, op=lambda value: value)
        gdal_lon, gdal_lat = gdal.xy(xy[:, 1] + 0.5, xy[:, 0] + 0.5, zs=z, offset="ul")
    np.testing.assert_allclose(np.column_stack([cols, rows]) - 0.5, xy, atol=GDAL_PX)
    there = model.image_from_geographic(np.asarray(gdal_lon), np.asarray(gdal_lat), z)
    np.testing.assert_allclose(there, xy, atol=GDAL_PX)


def test_agrees_with_gdal_in_both_directions(model: RpcModel):
    rng = np.random.default_rng(1)
    assert_agrees_with_gdal(model, rng.uniform(0, 40000, (50, 2)), rng.uniform(0, 900, 50))


@pytest.mark.parametrize("name", CROPS)
def test_crops_with_a_box_far_larger_than_the_image(shared_data, name: str):
    rpc = read_rpc(shared_data / name)
    model = RpcModel(rpc, UTM31)
    rng = np.random.default_rng(2)
    xy = rng.uniform(-100, 1200, (200, 2))
    z = rng.uniform(rpc.height_off - rpc.height_scale, rpc.height_off + rpc.height_scale, 200)
    np.testing.assert_allclose(model.image_from_ground(model.ground_from_image(xy, z)), xy, atol=ROUND_TRIP_PX)
    assert_agrees_with_gdal(model, xy, z)
