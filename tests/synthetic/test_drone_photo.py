"""Photographs of a drone: exact rays, and light, blur, noise and colour as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from zlocus.synthetic.drone_block import DroneBlockSpec, build_drone_ground, drone_exposures, small_drone_block_spec
from zlocus.synthetic.drone_photo import (
    DronePhoto,
    SplinedRays,
    developed,
    photographed,
    seen_colours,
    toned,
    vignette,
)
from zlocus.synthetic.render import render, sunlit, visible_ground_points

RAY_PX = 1e-4
QUIET = DronePhoto(electrons=1e12, vignetting=0.0, sharpening=0.0)
# Rise of a slope over half a cell.
TOP_M = 0.03
# Three bands are rounded, each by half a grey value at most.
ROUNDED = 0.6


@pytest.mark.parametrize("spec", [DroneBlockSpec(), small_drone_block_spec()], ids=["large", "small"])
def test_interpolated_rays_are_those_of_the_camera(spec: DroneBlockSpec) -> None:
    """In the whole frame and a few pixels around it, at two heights."""
    for exposure in drone_exposures(spec)[:2]:
        rays = SplinedRays(exposure.sensor, exposure.shape)
        rows, cols = (np.linspace(-5.0, n + 4.0, 83) for n in exposure.shape)
        col, row = np.meshgrid(cols, rows)
        xy = np.column_stack([col.ravel(), row.ravel()])
        for z in spec.height_range:
            xyz = rays.ground_from_image(xy, np.full(len(xy), z))
            np.testing.assert_allclose(exposure.sensor.image_from_ground(xyz), xy, rtol=0, atol=RAY_PX)
            assert (xyz[:, 2] == z).all()


def test_corners_get_less_light() -> None:
    light = vignette((301, 401), 0.3)
    assert light[150, 200] == pytest.approx(1.0)
    np.testing.assert_allclose(light[[0, 0, -1, -1], [0, -1, 0, -1]], 0.7, rtol=0, atol=0.01)


def test_the_drone_moves_along_the_columns() -> None:
    """Second moments of the image of a point: the point spread function, and along the columns the motion."""
    point = np.zeros((61, 61), np.float32)
    point[30, 30] = 1e-3
    photo = replace(QUIET, blur_px=1.0, motion_px=3.0)
    grey = developed(point, photo, np.random.default_rng(1))
    # A gamma widens both directions; the share between them stays.
    along, across = (float((grey.sum(axis=axis) * (np.arange(61) - 30) ** 2).sum() / grey.sum()) for axis in (1, 0))
    assert along / across == pytest.approx((1.0 + 3.0**2 / 12) / 1.0, rel=0.05)


def test_noise_is_that_of_the_electrons() -> None:
    """The light at full scale has 6000; the tone curve passes noise on by its slope."""
    flat = np.full((300, 300), 0.2, np.float32)
    photo = replace(QUIET, electrons=6000.0)
    grey = developed(flat, photo, np.random.default_rng(2))
    slope = 255.0 * float(toned(np.array([[0.201]]))[0, 0] - toned(np.array([[0.199]]))[0, 0]) / 0.002
    assert grey.std() == pytest.approx(slope * np.sqrt(0.2 / 6000.0), rel=0.03)
    assert grey.mean() == pytest.approx(255.0 * float(toned(flat)[0, 0]), abs=0.05)


def test_colours_leave_the_luminance_as_it_is() -> None:
    spec = small_drone_block_spec(7, columns=160, rows=120, strips=1, frames_per_strip=2, samples=1)
    exposures = drone_exposures(spec)
    coloured = build_drone_ground(spec, exposures)
    lit, exposure = sunlit(coloured.ground, spec.sun), exposures[0]
    shot = (coloured, exposure.sensor, exposure.shape, lit, spec.sun, 1, QUIET)
    bands = photographed(*shot, np.random.default_rng(3))
    assert bands.shape == (3, 120, 160)
    radiance = render(coloured.ground, SplinedRays(exposure.sensor, exposure.shape), exposure.shape, spec.sun, 1, lit)
    assert (radiance > 0).all()
    grey = developed(radiance, QUIET, np.random.default_rng(3))
    luminance = np.tensordot((0.299, 0.587, 0.114), bands.astype(float), axes=1)
    unsaturated = bands.max(axis=0) < 255
    assert unsaturated.mean() > 0.95
    np.testing.assert_allclose(luminance[unsaturated], grey[unsaturated], rtol=0, atol=ROUNDED)


def test_a_pixel_has_the_colour_of_the_material_that_it_shows() -> None:
    """On tops; the rest are walls, whose point lies on the border of two cells."""
    spec = small_drone_block_spec(7, columns=160, rows=120, strips=1, frames_per_strip=1)
    exposure = drone_exposures(spec)[0]
    coloured = build_drone_ground(spec, (exposure,))
    ground, found = coloured.ground, seen_colours(coloured, exposure.sensor, exposure.shape)
    assert found.shape == (3, 60, 80)
    row, col = np.mgrid[:60, :80]
    xy = np.column_stack([2.0 * col.ravel() + 0.5, 2.0 * row.ravel() + 0.5])
    seen = visible_ground_points(ground, exposure.sensor, xy)
    i, j = ((ground.y0 - seen[:, 1]) / ground.step).astype(int), ((seen[:, 0] - ground.x0) / ground.step).astype(int)
    expected = coloured.top_colours[ground.material[i, j]]
    is_top = np.abs(seen[:, 2] - ground.heights[i, j]) < TOP_M
    equal = (expected == found.reshape(3, -1).T).all(axis=1)
    assert is_top.mean() > 0.6
    assert equal[is_top].mean() > 0.97
    assert len(np.unique(expected, axis=0)) > 4
