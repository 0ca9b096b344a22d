"""Lens distortion: against OpenCV and COLMAP, there and back, and what lies beyond the fold."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zlocus.sensors.distortion import MAX_ANGLE_FROM_AXIS_DEG, BrownDistortion, FisheyeDistortion

FOCAL_PX = 3000.0
SAME_PX = 1e-6
# Positions of a lens whose corners are 50 degrees from the axis.
WIDE = np.tan(np.deg2rad(50.0))
GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 15), np.linspace(-0.6, 0.6, 13)), axis=-1).reshape(-1, 2)

small = st.floats(-0.3, 0.3)
tangential = st.floats(-2e-3, 2e-3)
brown = st.builds(BrownDistortion, small, small, tangential, tangential, small, small, small, small)
fisheye = st.builds(FisheyeDistortion, *(st.floats(-0.05, 0.05),) * 4)
positions = st.tuples(st.floats(-WIDE, WIDE), st.floats(-WIDE, WIDE))


def opencv(model, at):
    """OpenCV's own projection of points at depth 1 with a focal length of 1."""
    points, eye, none = np.column_stack([at, np.ones(len(at))])[:, None], np.eye(3), np.zeros(3)
    if isinstance(model, BrownDistortion):
        numbers = np.array([model.k1, model.k2, model.p1, model.p2, model.k3, model.k4, model.k5, model.k6])
        return cv2.projectPoints(points, none, none, eye, numbers)[0][:, 0]
    numbers = np.array([model.k1, model.k2, model.k3, model.k4])
    return cv2.fisheye.projectPoints(points, none, none, eye, numbers)[0][:, 0]


@given(brown | fisheye)
def test_agrees_with_opencv(model):
    here = model.distorted(GRID)
    known = np.isfinite(here).all(axis=1)
    gap = FOCAL_PX * np.abs(here - opencv(model, GRID))[known]
    assert known[len(GRID) // 2]
    assert gap.max() < SAME_PX


def colmap_cameras():
    """Models of COLMAP with their parameters and ours."""
    pinhole = [FOCAL_PX, FOCAL_PX * 1.01, 1500.0, 1000.0]
    numbers = (-0.21, 0.09, 8e-4, -5e-4, 0.03, 0.02, -0.01, 0.004)
    k = (0.03, -0.02, 0.008, -0.003)
    return [
        ("OPENCV", [*pinhole, *numbers[:4]], BrownDistortion(*numbers[:4])),
        ("FULL_OPENCV", [*pinhole, *numbers], BrownDistortion(*numbers)),
        ("OPENCV_FISHEYE", [*pinhole, *k], FisheyeDistortion(*k)),
        ("SIMPLE_RADIAL", [FOCAL_PX, 1500.0, 1000.0, -0.1], BrownDistortion(-0.1)),
        ("RADIAL", [FOCAL_PX, 1500.0, 1000.0, -0.1, 0.03], BrownDistortion(-0.1, 0.03)),
        ("SIMPLE_RADIAL_FISHEYE", [FOCAL_PX, 1500.0, 1000.0, -0.02], FisheyeDistortion(-0.02)),
        ("RADIAL_FISHEYE", [FOCAL_PX, 1500.0, 1000.0, -0.02, 0.01], FisheyeDistortion(-0.02, 0.01)),
    ]


@pytest.mark.parametrize(("name", "numbers", "model"), colmap_cameras(), ids=[c[0] for c in colmap_cameras()])
def test_agrees_with_colmap(name, numbers, model):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: no second opinion on COLMAP's models")
    camera = pycolmap.Camera(model=name, width=3000, height=2000, params=numbers)
    theirs = camera.img_from_cam(np.column_stack([GRID, np.ones(len(GRID))]))
    fy = numbers[1] if len(numbers) > 6 else numbers[0]
    here = model.distorted(GRID) * [numbers[0], fy] + [1500.0, 1000.0]
    known = np.isfinite(here).all(axis=1)
    assert known.mean() > 0.9
    assert np.abs(here - theirs)[known].max() < SAME_PX


@given(brown | fisheye, st.lists(positions, min_size=1, max_size=20))
def test_there_and_back(model, at):
    at = np.array(at)
    there = model.distorted(at)
    known = np.isfinite(there).all(axis=1)
    back = model.undistorted(there)
    assert np.isnan(back[~known]).all()
    assert np.abs(back - at)[known].max(initial=0.0) * FOCAL_PX < SAME_PX


@given(brown | fisheye, st.lists(positions, min_size=1, max_size=20))
def test_back_and_there(model, at):
    ideal = model.undistorted(np.array(at))
    known = np.isfinite(ideal).all(axis=1)
    # On the very rim rounding decides.
    inside = known & (np.hypot(*ideal.T) < np.hypot(*ideal.T).max(initial=0.0, where=known) * (1 - 1e-9))
    assert np.abs(model.distorted(ideal) - at)[inside].max(initial=0.0) * FOCAL_PX < SAME_PX


def test_the_axis_is_always_seen():
    for model in (BrownDistortion(0.1), FisheyeDistortion(0.1), BrownDistortion(), FisheyeDistortion()):
        zero = np.zeros((1, 2))
        np.testing.assert_array_equal(model.distorted(zero), zero)
        np.testing.assert_array_equal(model.undistorted(zero), zero)


def test_no_coefficients_are_no_distortion():
    np.testing.assert_array_equal(BrownDistortion().distorted(GRID), GRID)
    np.testing.assert_allclose(BrownDistortion().undistorted(GRID), GRID, atol=1e-15)


def test_beyond_the_fold_is_nothing():
    # r (1 - r2 / 3) is largest at r = 1, where it is 2 / 3.
    model = BrownDistortion(-1.0 / 3.0)
    at = np.array([[0.9, 0.0], [0.0, 0.98], [0.999, 0.0], [0.0, 5.0], [np.nan, 0.0], [1e200, 1.0]])
    assert np.isfinite(model.distorted(at)).all(axis=1).tolist() == [True, True, False, False, False, False]
    seen = np.array([[0.6, 0.0], [0.0, 0.67], [0.7, 0.0], [1e300, 0.0], [np.nan, 0.0]])
    assert np.isfinite(model.undistorted(seen)).all(axis=1).tolist() == [True, False, False, False, False]


def test_the_tangential_part_folds_too():
    # On the y axis y + 3 p1 y2, whose slope is 0 at y = -1 / (6 p1).
    model = BrownDistortion(p1=0.05)
    at = np.array([[0.0, -3.2], [0.0, -3.4], [0.0, 3.4]])
    assert np.isfinite(model.distorted(at)).all(axis=1).tolist() == [True, False, False]


def test_poles_end_the_disc():
    model = BrownDistortion(k4=-1.0)  # 1 / (1 - r2)
    at = np.array([[0.5, 0.0], [0.999, 0.0], [1.5, 0.0]])
    assert np.isfinite(model.distorted(at)).all(axis=1).tolist() == [True, True, False]


def test_a_fisheye_sees_nearly_to_its_side():
    model = FisheyeDistortion()
    at = np.tan(np.deg2rad([[80.0, 0.0], [MAX_ANGLE_FROM_AXIS_DEG - 0.1, 0.0], [MAX_ANGLE_FROM_AXIS_DEG + 0.1, 0.0]]))
    there = model.distorted(at)
    np.testing.assert_allclose(there[:2, 0], np.deg2rad([80.0, MAX_ANGLE_FROM_AXIS_DEG - 0.1]), atol=1e-12)
    assert np.isnan(there[2]).all()


@given(brown | fisheye)
def test_nothing_is_seen_twice(model):
    """The map of a fine polar grid of the disc keeps its orientation in every cell."""
    radius, turn = np.meshgrid(np.linspace(0.01, 1.2, 60), np.linspace(0.0, 2 * np.pi, 49))
    at = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
    there = model.distorted(at.reshape(-1, 2)).reshape(at.shape)
    along, across = there[:-1, 1:] - there[:-1, :-1], there[1:, :-1] - there[:-1, :-1]
    area = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    assert (area[np.isfinite(area)] > 0).all()
