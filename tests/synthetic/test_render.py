"""Rays compared with closed forms and with a slow twin; light, optics and noise."""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.synthetic.cameras import LineScanner, SatelliteCamera
from zlocus.synthetic.raycast import MISS, TOP, WALL_U, WALL_V, cast_rays
from zlocus.synthetic.render import Optics, Sun, expose, field_of, render, sunlit, visible_ground_points
from zlocus.synthetic.terrain import (
    ANALYTIC_KINDS,
    GROUND,
    PATTERN_GRAIN,
    SyntheticGround,
    analytic_ground,
    analytic_height,
    plain_material,
)

CENTRE = (500_000.0, 5_200_000.0)
STEP = 0.25
SHAPE = (411, 390)
RAY_PX = 1e-3
# Half a cell's diagonal squared, over eight, times the largest curvature (1/60 on the sphere, 3/64 on the sine), and
# the float32 of the heights.
SURFACE_M = {"plane": 1e-5, "tilt": 1e-5, "step": 1e-5, "sphere": 1e-3, "sine": 1e-3}
WALL_M = 1e-6


def camera(along: float = 20.0, across: float = -8.0, heading: float = 3.0) -> SatelliteCamera:
    return SatelliteCamera((*CENTRE, 50.0), (60.0, 60.0), 0.5, along, across, heading)


def some_pixels() -> NDArray[np.float64]:
    return np.random.default_rng(2).uniform(20.0, 100.0, (3000, 2))


@pytest.mark.parametrize("kind", ANALYTIC_KINDS)
@pytest.mark.parametrize("scanned", [False, True])
def test_rays_meet_analytic_surfaces(kind: str, scanned: bool) -> None:
    """What a pixel sees lies on the surface, on the pixel's own ray, and nothing of the surface is above the ray."""
    ground = analytic_ground(kind, CENTRE, STEP, SHAPE)
    sensor = camera()
    if scanned:
        position = (CENTRE[0] - 100.0, CENTRE[1] - 2000.0 * np.tan(np.deg2rad(26.0)), 2050.0)
        sensor = LineScanner(position, (-420.0, 60.0), 0.0, 26.0, 0.208, wobble_m=0.5, wobble_deg=0.03)
    xy = some_pixels()
    seen = visible_ground_points(ground, sensor, xy)
    east, north = seen[:, 0] - CENTRE[0], seen[:, 1] - CENTRE[1]
    assert np.isfinite(seen).all()
    np.testing.assert_allclose(sensor.image_from_ground(seen), xy, rtol=0, atol=RAY_PX)
    on_wall = (kind == "step") & (seen[:, 2] < 64.999) & (seen[:, 2] > 50.001)
    np.testing.assert_allclose(east[on_wall], 0.0, rtol=0, atol=WALL_M)
    rest = ~on_wall & ~rim_of_sphere(kind, east, north)
    height = analytic_height(kind, east[rest], north[rest])
    np.testing.assert_allclose(seen[rest, 2], height, rtol=0, atol=SURFACE_M[kind])
    for above in np.linspace(0.05, 20.0, 40):
        passed = sensor.ground_from_image(xy[rest], seen[rest, 2] + above)
        under = analytic_height(kind, passed[:, 0] - CENTRE[0], passed[:, 1] - CENTRE[1])
        assert (under < passed[:, 2] + SURFACE_M[kind]).all()


def rim_of_sphere(kind: str, east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where the cap meets its plane the surface has a kink inside a cell."""
    rim = np.sqrt(60.0**2 - 40.0**2)
    return (kind == "sphere") & (np.abs(np.hypot(east, north) - rim) < STEP)


def test_a_step_occludes_the_ground_behind_it() -> None:
    """A camera that looks east from the west sees all; one that looks west misses 15 m times the tangent."""
    ground = analytic_ground("step", CENTRE, STEP, SHAPE)
    for across, hidden in ((15.0, 0.0), (-15.0, 15.0 * np.tan(np.deg2rad(15.0)))):
        sensor = camera(along=0.0, across=across, heading=0.0)
        low = visible_ground_points(
            ground, sensor, np.column_stack([np.linspace(20, 100, 20001), np.full(20001, 60.0)])
        )
        east = low[low[:, 2] < 50.001, 0] - CENTRE[0]
        assert east.max() == pytest.approx(-hidden, abs=0.01)
        on_wall = (low[:, 2] > 50.001) & (low[:, 2] < 64.999)
        assert on_wall.any() == (across > 0.0)


def rough_field(shape: tuple[int, int], seed: int) -> SyntheticGround:
    """Towers and holes with random slopes: nothing smooth."""
    rng = np.random.default_rng(seed)
    ground = analytic_ground("plane", CENTRE, 1.0, shape)
    planes = rng.normal(0.0, 0.4, (*shape, 3)).astype(np.float32)
    planes[..., 0] = rng.choice([0.0, 1.0, 3.0, 12.0], shape, p=[0.6, 0.2, 0.15, 0.05])
    return replace(ground, planes=planes)


def slow_cast(ray: NDArray[np.float64], ground: SyntheticGround) -> tuple[int, float]:
    """Plain loops: every border of every cell that the ray crosses, in order, then each piece against its plane."""
    (u, v, z, du, dv, dz), (rows, cols) = ray, ground.heights.shape
    crossings = {0.0: TOP, 1.0: TOP}
    for start, step, count, kind in ((u, du, cols, WALL_U), (v, dv, rows, WALL_V)):
        for border in range(count + 1):
            if step != 0.0 and 0.0 < (border - start) / step < 1.0:
                crossings[(border - start) / step] = kind
    places = sorted(crossings)
    for first, last in pairwise(places):
        middle = 0.5 * (first + last)
        i, j = int(np.floor(v + middle * dv)), int(np.floor(u + middle * du))
        if not (0 <= i < rows and 0 <= j < cols):
            return MISS, 1.0
        height, by_col, by_row = (float(a) for a in ground.planes[i, j])

        def above(t: float, i: int = i, j: int = j, plane: tuple[float, ...] = (height, by_col, by_row)) -> float:
            return z + t * dz - plane[0] - plane[1] * (u + t * du - j - 0.5) - plane[2] * (v + t * dv - i - 0.5)

        if first > 0.0 and above(first) <= 0.0:
            return crossings[first], first
        if above(first) > 0.0 and above(last) <= 0.0:
            return TOP, first + (last - first) * above(first) / (above(first) - above(last))
    return MISS, 1.0


@pytest.mark.parametrize("shape", [(1, 1), (16, 16), (17, 33), (53, 37)])
def test_the_kernel_agrees_with_its_slow_twin(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[0])
    ground = rough_field(shape, seed=shape[1])
    n = 300
    start = rng.uniform((0, 0), (shape[1], shape[0]), (n, 2))
    end = rng.uniform((-3, -3), (shape[1] + 3, shape[0] + 3), (n, 2))
    end[:20] = start[:20]
    end[20:40, 0] = start[20:40, 0]
    end[40:60, 1] = start[40:60, 1]
    rays = np.column_stack([start, np.full(n, 20.0), end - start, np.full(n, -25.0)])
    kinds, places = cast_rays(rays, field_of(ground))
    expected = [slow_cast(ray, ground) for ray in rays]
    np.testing.assert_array_equal(kinds, [kind for kind, _ in expected])
    assert shape == (1, 1) or {MISS, TOP, WALL_U, WALL_V} == set(kinds)
    hit = kinds != MISS
    t = np.array([t for _, t in expected])[hit, None]
    np.testing.assert_allclose(places[hit], (rays[:, :3] + 0.0)[hit] + t * rays[hit, 3:], rtol=0, atol=1e-9)
    assert np.isnan(places[~hit]).all()


@pytest.mark.parametrize(("azimuth", "is_dark"), [(90.0, True), (270.0, False), (0.0, False), (180.0, False)])
def test_shadows_fall_away_from_the_sun(azimuth: float, is_dark: bool) -> None:
    """The step rises 15 m to the east: a sun at 30 degrees in the east darkens 15 / tan(30) m to its west."""
    ground = analytic_ground("step", CENTRE, STEP, SHAPE)
    lit = sunlit(ground, Sun(azimuth, 30.0))
    east = (np.arange(SHAPE[1]) + 0.5 - SHAPE[1] / 2) * STEP
    dark = (east < 0.0) & (east > -(15.0 - 0.02) / np.tan(np.deg2rad(30.0)))
    np.testing.assert_array_equal(lit, np.broadcast_to(~(dark & is_dark), SHAPE))


def two_tone(split: float) -> SyntheticGround:
    """A plane that is dark west of `split` m and bright east of it, without texture."""
    ground = analytic_ground("plane", CENTRE, STEP, (80, 80))
    tones = [plain_material(GROUND, PATTERN_GRAIN, albedo, 0.0) for albedo in (0.2, 0.6)]
    east = (np.arange(80) + 0.5 - 40) * STEP
    material = np.broadcast_to((east > split).astype(np.uint16), (80, 80)).copy()
    return replace(ground, material=material, materials=np.array(tones))


def test_a_pixel_is_the_mean_of_what_it_covers() -> None:
    """Pixels of 1 m, the middle one from -0.5 to 0.5 m, a quarter of it bright: neighbours are pure."""
    sensor = SatelliteCamera((*CENTRE, 50.0), (2.0, 2.0), 1.0, 0.0, 0.0)
    radiance = render(two_tone(0.25), sensor, (5, 5), Sun(90.0, 90.0), samples=4)
    row = radiance[2] / radiance[2, 0]
    np.testing.assert_allclose(row, [1.0, 1.0, 1.5, 3.0, 3.0], rtol=1e-5)
    np.testing.assert_array_equal(radiance, np.broadcast_to(radiance[2], (5, 5)))


def test_slopes_to_the_sun_are_brighter() -> None:
    """Lambert: sky light and the cosine to the sun, here of the plane's normal (east 0.2, north -0.15 per metre)."""
    ground = replace(two_tone(100.0), planes=analytic_ground("tilt", CENTRE, STEP, (80, 80)).planes)
    sensor = SatelliteCamera((*CENTRE, 50.0), (2.0, 2.0), 1.0, 0.0, 0.0)
    normal = np.array([-0.20, 0.15, 1.0]) / np.sqrt(1.0 + 0.2**2 + 0.15**2)
    for azimuth in (0.0, 90.0, 200.0):
        a, e = np.deg2rad(azimuth), np.deg2rad(40.0)
        to_sun = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])
        radiance = render(ground, sensor, (5, 5), Sun(azimuth, 40.0), samples=2)
        np.testing.assert_allclose(radiance, 0.2 * (0.27 + normal @ to_sun), rtol=1e-4)


def test_nothing_is_seen_beyond_the_field() -> None:
    sensor = SatelliteCamera((CENTRE[0] + 10.0, CENTRE[1], 50.0), (10.0, 8.0), 1.0, 0.0, 0.0)
    radiance = render(two_tone(0.0), sensor, (17, 21), Sun(90.0, 60.0))
    assert (radiance[:, :10] > 0.0).all()
    assert (radiance[:, 11:] == 0.0).all()
    assert (expose(radiance, Optics(), np.random.default_rng(0))[:, 11:] == 0).all()


def test_any_number_of_threads_gives_the_same_image(monkeypatch: pytest.MonkeyPatch) -> None:
    ground = analytic_ground("sine", CENTRE, STEP, SHAPE)
    images = []
    for threads in (1, 3):
        monkeypatch.setattr(os, "cpu_count", lambda threads=threads: threads)
        images.append(render(ground, camera(), (120, 117), Sun(120.0, 40.0)))
    np.testing.assert_array_equal(*images)
    assert images[0].std() > 0.01


def test_a_camera_that_shakes_too_fast_is_refused() -> None:
    ground = analytic_ground("plane", CENTRE, STEP, SHAPE)
    shaken = LineScanner((*CENTRE, 2050.0), (60.0, 60.0), 0.0, 0.0, 0.208, wobble_deg=0.05, wobble_rows=4.0)
    with pytest.raises(GeometryError, match="smooth its motion"):
        render(ground, shaken, (120, 120), Sun(120.0, 40.0))


@pytest.mark.parametrize("radiance", [0.05, 0.5])
def test_gain_haze_and_noise(radiance: float) -> None:
    optics = Optics(gain=1000.0, haze=150.0, noise=0.02, noise_floor=5.0)
    numbers = expose(np.full((400, 400), radiance, np.float32), optics, np.random.default_rng(1)).astype(float)
    sigma = np.sqrt((0.02 * 1000.0 * radiance) ** 2 + 5.0**2 + 1 / 12)
    assert numbers.mean() == pytest.approx(150.0 + 1000.0 * radiance, abs=4 * sigma / 400)
    assert numbers.std() == pytest.approx(sigma, rel=0.01)


def test_the_point_spread() -> None:
    """A bright point becomes a Gaussian of the stated width and keeps its energy."""
    radiance = np.full((41, 41), 0.1, np.float32)
    radiance[20, 20] = 10.1
    quiet = Optics(gain=5000.0, haze=0.0, blur_px=1.5, noise=0.0, noise_floor=0.0)
    spread = expose(radiance, quiet, np.random.default_rng(0)) - 500.0
    assert spread.sum() == pytest.approx(50_000.0, rel=1e-3)
    rows = np.arange(41) - 20
    assert (spread.sum(axis=1) * rows**2).sum() / spread.sum() == pytest.approx(1.5**2, rel=0.02)


def test_eight_bits_saturate_and_zero_is_nodata() -> None:
    optics = Optics(gain=400.0, haze=0.0, dtype="uint8")
    radiance = np.repeat(np.array([[0.0, 1e-6, 0.3, 5.0]], np.float32), 50, axis=0).repeat(20, axis=1)
    numbers = expose(radiance, replace(optics, blur_px=0.01), np.random.default_rng(0))
    assert numbers.dtype == np.uint8
    assert (numbers[:, :20] == 0).all()
    assert (numbers[:, 20:40] >= 1).all()
    assert (numbers[:, 60:] == 255).all()


def test_clouds_hide_and_are_bright() -> None:
    radiance = np.full((300, 300), 0.3, np.float32)
    clear, cloudy = (expose(radiance, Optics(n_clouds=n), np.random.default_rng(4)).astype(float) for n in (0, 5))
    share = (cloudy > clear.max()).mean()
    assert 0.01 < share < 0.5
    assert cloudy.max() > 1.1 * Optics().gain
