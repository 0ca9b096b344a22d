"""Speed of what the orientation does most, on one core: RPCs in both directions, and the search for descriptors."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS

from bench_kernels import Case, timed
from rpc_fixtures import satellite_rpc
from zlocus.orientation.kernels.descriptors import (
    DESCRIPTOR_LENGTH_UNITS,
    CurveSegments,
    SecondFeatures,
    nearest_descriptors,
)
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.rpc import RpcModel

# Features of two images of 0.6 Mpx, in a sample and all of them, and the points of a pair of images.
N_SEGMENTS, N_FEATURES, SIDE_PX, N_POINTS = 1000, 2400, 800, 400
SEED = 11


@pytest.fixture
def points():
    """An RPC, pixels of its image, and heights."""
    rng = np.random.default_rng(SEED)
    model = RpcModel(satellite_rpc(), CRS.from_epsg(32631))
    return model, rng.uniform(0, 40_000, (N_POINTS, 2)), rng.uniform(0, 900, N_POINTS)


def test_rpc_ground_from_image(benchmark, points):
    model, xy, z = points
    timed(benchmark, Case(lambda: model.ground_from_image(xy, z), len(xy), "point"))


def test_rpc_image_from_ground(benchmark, points):
    model, xy, z = points
    xyz = model.ground_from_image(xy, z)
    timed(benchmark, Case(lambda: model.image_from_ground(xyz), len(xyz), "point"))


def test_ideal_positions(benchmark):
    """Positions of a lens whose distortion is removed."""
    lens = BrownDistortion(k1=-0.26, k2=0.10, p1=7e-4, p2=3e-4, k3=-0.025)
    at = np.random.default_rng(SEED).uniform(-0.4, 0.4, (N_POINTS, 2))
    timed(benchmark, Case(lambda: lens.undistorted(at), len(at), "point"))


def descriptors(rng, n):
    """Descriptors (n, 128) int16 of random directions."""
    values = rng.random((n, 128)) ** 3
    return np.rint(values / np.linalg.norm(values, axis=1, keepdims=True) * DESCRIPTOR_LENGTH_UNITS).astype(np.int16)


@pytest.mark.parametrize("max_px", [30.0, 3.0])
def test_nearest_descriptors(benchmark, max_px):
    """Along curves across the whole image: of the first search, and of the second one."""
    rng = np.random.default_rng(SEED)
    low = np.column_stack([np.zeros(N_SEGMENTS), rng.uniform(0, SIDE_PX, N_SEGMENTS)])
    segments = CurveSegments(low, low + SIDE_PX * np.array([1.0, 0.3]), descriptors(rng, N_SEGMENTS))
    features = SecondFeatures(rng.uniform(0, SIDE_PX, (N_FEATURES, 2)), descriptors(rng, N_FEATURES))
    best_a, best_b = np.empty(N_SEGMENTS, np.int64), np.empty(N_FEATURES, np.int64)

    def search():
        nearest_descriptors(segments, features, max_px, 0.8, best_a, best_b)

    timed(benchmark, Case(search, N_SEGMENTS * N_FEATURES, "pair of features"))
