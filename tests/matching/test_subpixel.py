"""Sub-step heights: the parabola, and a planted fraction of a step on a rendered plane."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from scipy.ndimage import spline_filter

from rendered_scenes import CENTRE, FIELD, GSD_M, LOOKS, SIZE_PX, camera
from zlocus.core.options import RefineOptions
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.subpixel import (
    MAX_GROUP_DISTANCE_STEPS,
    MeasuredDistances,
    combined_windows,
    curvature_at_centre,
    group_distances,
    lee_filtered,
    parabola_peaks,
    peak_variance,
    refine,
    smoothed,
)
from zlocus.matching.tile_views import TileGrid, tile_views
from zlocus.matching.view_pixels import ViewPixels
from zlocus.synthetic.render import Sun, render
from zlocus.synthetic.terrain import analytic_ground

# Steps of 0.4 m are half a pixel; noise-free images.
STEP_M, STEPS = 0.4, 0.02


def test_the_parabola_through_three_samples():
    offsets = np.linspace(-1.5, 1.5, 7, dtype=np.float32)
    peaks = np.array([[-0.9, 0.0, 0.26, 0.74]], np.float32)
    profile = 0.8 - 0.3 * (offsets[:, None, None] - peaks) ** 2
    at, value, inside = parabola_peaks(profile, offsets)
    np.testing.assert_allclose(at, peaks, rtol=0, atol=1e-5)
    np.testing.assert_allclose(value, 0.8, rtol=0, atol=1e-6)
    assert inside.all()


def test_a_maximum_at_an_end_is_not_believed():
    offsets = np.linspace(-1, 1, 5, dtype=np.float32)
    profile = np.stack([offsets, -offsets, 0 * offsets], axis=1)[:, None, :].astype(np.float32)
    at, _, inside = parabola_peaks(profile, offsets)
    assert not inside.any()
    assert np.isfinite(at).all()
    assert np.abs(at).max() <= 1.0


def test_bend_and_distance_of_two_parabolas():
    """0.8 - a (x - p)^2: the bend is 2 a per step squared, wherever the peak is."""
    x, spacing = np.array([-0.5, 0.0, 0.5], np.float32)[:, None, None], np.float32(0.5)
    peaks = np.array([[[-0.3, 0.0, 0.2]], [[0.1, 0.4, 0.2]]], np.float32)
    profiles = np.stack([0.8 - 0.3 * (x - peaks[0]) ** 2, 0.7 - 0.5 * (x - peaks[1]) ** 2])
    np.testing.assert_allclose(curvature_at_centre(profiles[0], spacing), 0.6, rtol=0, atol=1e-5)
    np.testing.assert_allclose(curvature_at_centre(-profiles[0], spacing), 0.0)
    np.testing.assert_allclose(group_distances(profiles, spacing), [[0.4, 0.4, 0.0]], rtol=0, atol=1e-5)
    assert np.isnan(group_distances(np.stack([profiles[0], 0 * profiles[0]]), spacing)).all(), "a group of no pair"
    assert np.isnan(group_distances(np.stack([profiles[0], -profiles[0]]), spacing)).all(), "a pit has no peak"
    nearly_flat = 0.5 + 0.1 * x - 1e-4 * x**2 + np.zeros((1, 1, 3), np.float32)
    assert (group_distances(np.stack([profiles[0], nearly_flat]), spacing) == MAX_GROUP_DISTANCE_STEPS).all()


@pytest.mark.parametrize("n_samples", [3, 4, 7])
def test_peaks_of_any_profile(n_samples):
    """Against the parabola of each cell by itself; a third of the cells are flat or have equal samples."""
    rng, offsets = np.random.default_rng(n_samples), np.linspace(-0.6, 0.6, n_samples, dtype=np.float32)
    profile = rng.random((n_samples, 8, 9)).astype(np.float32)
    profile[:, :, :3] = np.round(2 * profile[:, :, :3]) / 2
    at, value, inside = parabola_peaks(profile, offsets)
    for cell in np.ndindex(8, 9):
        y = profile[:, *cell].astype(float)
        k = min(max(int(y.argmax()), 1), n_samples - 2)
        bend, lean = y[k - 1] - 2 * y[k] + y[k + 1], y[k - 1] - y[k + 1]
        shift = 0.5 * lean / min(bend, -1e-6)
        assert inside[cell] == (bend < -1e-6 and abs(shift) < 1)
        shift = float(np.clip(shift, -1, 1))
        assert at[cell] == pytest.approx(offsets[k] + shift * (offsets[1] - offsets[0]), abs=1e-4)
        assert value[cell] == pytest.approx(y[k] - 0.25 * lean * shift, abs=1e-4)


def test_differences_of_groups_of_any_profiles():
    rng, spacing = np.random.default_rng(0), np.float32(0.4)
    profiles = rng.random((2, 3, 8, 9)).astype(np.float32)
    found, known = group_distances(profiles, spacing), 0
    for cell in np.ndindex(8, 9):
        low, middle, high = profiles[:, :, *cell].astype(float).T
        bend = 2 * middle - low - high
        if (bend <= 1e-6).any():
            assert np.isnan(found[cell])
            continue
        vertex = (high - low) / (2 * bend)
        expected = min(abs(vertex[0] - vertex[1]) * spacing, MAX_GROUP_DISTANCE_STEPS)
        assert found[cell] == pytest.approx(expected, abs=1e-3)
        known += 1
    assert 10 < known < 70


def test_a_peak_beyond_the_largest_sample_lies_between_the_samples():
    """Of three samples the largest is an end one; the parabola's vertex still lies within them, or it does not."""
    offsets = np.linspace(-0.5, 0.5, 3, dtype=np.float32)
    peaks = np.array([[0.3, -0.45, 0.55]], np.float32)
    at, _, inside = parabola_peaks(0.8 - 0.3 * (offsets[:, None, None] - peaks) ** 2, offsets)
    np.testing.assert_allclose(at[0, :2], peaks[0, :2], rtol=0, atol=1e-5)
    assert inside.tolist() == [[True, True, False]]


def test_variance_of_a_peak():
    """2 (1 - rho) / (c N m): 2 x 0.1 / (0.5 x 49 x 4)."""
    grid = np.ones((1, 1), np.float32)
    assert peak_variance(0.9 * grid, 0.5 * grid, np.array([[4]]), 49)[0, 0] == pytest.approx(0.2 / 98, rel=1e-5)
    assert np.isfinite(peak_variance(grid, 0 * grid, np.array([[0]]), 49)).all()


def test_noise_about_a_smooth_surface_is_reduced_and_relief_kept():
    """White noise of a variance that is known shrinks about its mean, which stays; so does relief, which is larger."""
    rng = np.random.default_rng(5)
    away = (0.4 + rng.normal(0.0, 0.1, (60, 120))).astype(np.float32)
    away[:, 60:] += np.float32(2.0) * (np.arange(60) // 6 % 2 - np.float32(0.5))
    known = np.ones(away.shape, bool)
    found = lee_filtered(away, known, np.full(away.shape, 0.01, np.float32))
    assert np.abs(found[:, :50] - 0.4).mean() < 0.3 * np.abs(away[:, :50] - 0.4).mean()
    assert abs(found[:, :50].mean() - 0.4) < 0.01
    np.testing.assert_allclose(found[:, 70:], away[:, 70:], rtol=0, atol=0.05)
    np.testing.assert_allclose(lee_filtered(away, known, np.zeros(away.shape, np.float32)), away, rtol=0, atol=1e-6)


def test_what_does_not_count_says_nothing_of_the_spread():
    """Far distances that were not believed would pass for relief."""
    away = np.full((40, 40), 0.1, np.float32) * np.where(np.arange(40) % 2, 1, -1).astype(np.float32)
    known, variance = np.ones(away.shape, bool), np.full(away.shape, 0.005, np.float32)
    away[10:30, 10:30:3] = 0.0
    expected = lee_filtered(away, known & (away != 0), variance)
    away[10:30, 10:30:3], known[10:30, 10:30:3] = 5.0, False
    np.testing.assert_allclose(lee_filtered(away, known, variance)[known], expected[known], rtol=0, atol=1e-6)


def test_narrow_windows_count_where_they_find_relief():
    """Left, what they differ by is their own noise; right, relief that wide windows level."""
    rng = np.random.default_rng(3)
    wide = rng.normal(0.0, 0.1, (60, 120)).astype(np.float32)
    narrow = wide + rng.normal(0.0, 0.05, wide.shape).astype(np.float32)
    narrow[:, 60:] += np.float32(0.5) * (np.arange(60) // 3 % 2 - np.float32(0.5))
    known = np.ones(wide.shape, bool)
    variance, of_narrow = (np.full(wide.shape, value, np.float32) for value in (0.002, 0.004))
    found, together = combined_windows(MeasuredDistances(wide, variance), MeasuredDistances(narrow, of_narrow), known)
    assert np.abs(found - wide)[:, :50].mean() < 0.2 * np.abs(narrow - wide)[:, :50].mean()
    np.testing.assert_allclose(found[:, 70:], narrow[:, 70:], rtol=0, atol=0.05)
    assert (together[:, :50] < 0.0022).all()
    assert (together[:, 70:] > 0.0035).all()
    nothing, same = combined_windows(MeasuredDistances(wide, variance), MeasuredDistances(narrow, of_narrow), ~known)
    np.testing.assert_array_equal(nothing, wide)
    np.testing.assert_array_equal(same, variance)


def test_relief_is_small():
    """Another peak far away, found by a narrow window, moves no height and does not pass for its neighbours' relief."""
    wide, known = np.zeros((40, 40), np.float32), np.ones((40, 40), bool)
    narrow = np.where(np.arange(40) % 4 == 0, np.float32(0.8), np.float32(0.01)) * np.ones_like(wide)
    variance, of_narrow = (np.full(wide.shape, value, np.float32) for value in (0.001, 0.003))
    found, _ = combined_windows(MeasuredDistances(wide, variance), MeasuredDistances(narrow, of_narrow), known)
    np.testing.assert_allclose(found, 0.0, rtol=0, atol=1e-6)


def test_smoothing_removes_single_cells_and_keeps_jumps():
    surface = np.full((20, 30), 10.0, np.float32)
    surface[:, 15:] = 40.0
    surface[5, 5] = 90.0
    out = smoothed(surface, 3.0)
    np.testing.assert_allclose(out[:, :15], 10.0, rtol=0, atol=1e-3)
    np.testing.assert_allclose(out[:, 15:], 40.0, rtol=0, atol=1e-3)


@pytest.fixture(scope="module")
def plane():
    """The views of a plane at 50 m."""
    ground, shape = analytic_ground("plane", CENTRE, GSD_M / 2, FIELD, seed=5), (SIZE_PX, SIZE_PX)
    images = []
    for name in LOOKS:
        pixels = render(ground, camera(name), shape, Sun(150.0, 50.0), samples=3)
        images.append((camera(name), (pixels / pixels.std()).astype(np.float32)))
    return images


def splines(plane) -> np.ndarray:
    """Their coefficients."""
    return np.concatenate([spline_filter(pixels, 3, output=np.float32, mode="mirror").ravel() for _, pixels in plane])


@pytest.mark.parametrize("fraction", [0.0, 0.13, 0.37, 0.5, 0.81])
def test_a_planted_fraction_of_a_step(plane, fraction):
    """The lattice starts 20 + fraction steps below the plane: refinement finds it from 20.5."""
    shape, block = (48, 50), 16
    origin = 50.0 - (20 + fraction) * STEP_M
    transform = Affine(GSD_M, 0, CENTRE[0] - 12.5, 0, -GSD_M, CENTRE[1] + 12.0)
    windows = [ViewPixels(sensor, (0, 0), pixels, np.ones(pixels.shape, bool)) for sensor, pixels in plane]
    z = (origin, origin + 50 * STEP_M)
    views = tile_views(windows, TileGrid(0, transform, shape, block, origin, STEP_M), z, 2)
    visible = VisibleHeights(*(np.full((len(LOOKS), *shape), index, np.int32) for index in (0, 50, 0)))
    coarse = np.full(shape, 20.5, np.float32)
    found = refine(views, splines(plane), coarse, visible, STEP_M / GSD_M, RefineOptions(rounds=3))
    inner = (slice(4, -4), slice(4, -4))
    assert found.is_refined[inner].mean() > 0.99
    assert abs(np.median(found.height[inner]) - 20 - fraction) < STEPS
    assert np.median(found.ncc) > 0.95
    assert (found.curvature[inner] > 0).all()
    assert np.median(found.group_distance[inner]) < 0.1
    assert np.median(found.variance[inner]) < STEPS**2


def test_what_is_too_far_keeps_the_coarse_height(plane):
    shape, origin = (32, 32), 50.0 - 20 * STEP_M
    transform = Affine(GSD_M, 0, CENTRE[0] - 8, 0, -GSD_M, CENTRE[1] + 8)
    windows = [ViewPixels(sensor, (0, 0), pixels, np.ones(pixels.shape, bool)) for sensor, pixels in plane]
    views = tile_views(windows, TileGrid(0, transform, shape, 16, origin, STEP_M), (40.0, 70.0), 2)
    visible = VisibleHeights(*(np.full((len(LOOKS), *shape), index, np.int32) for index in (0, 50, 0)))
    coarse = np.full(shape, 32.0, np.float32)
    options = RefineOptions(rounds=1, max_correction_steps=0.1)
    found = refine(views, splines(plane), coarse, visible, STEP_M / GSD_M, options)
    kept = found.height[~found.is_refined]
    assert kept.size > 100
    assert (kept == 32.0).all()
    none = refine(views, splines(plane), coarse, visible, STEP_M / GSD_M, RefineOptions(rounds=0))
    assert (none.height == 32.0).all()
    assert not none.is_refined.any()
    assert np.isnan(none.group_distance).all()
    assert (none.curvature == 0).all()
