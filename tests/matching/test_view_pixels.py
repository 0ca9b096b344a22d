"""Windows of pixels: what a level reads of an image, and the reduced parts that are kept."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from affine import Affine

from zlocus.core.scene import ImageWindow, View
from zlocus.matching import view_pixels
from zlocus.matching.radiometry import GreyScale, GreyTrend
from zlocus.matching.view_pixels import PART_PX, PixelWindow, Pyramids, halved, read_pixels, unseen, window_showing
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles

SHAPE = (2300, 3100)
SCALE = GreyScale(100.0, 20.0, GreyTrend(SHAPE, (3.0, -2.0, 1.0, 0.5, -1.0)))
# Grey values on the scale of the scene, as float32.
GREY = 1e-5


@dataclass
class CountedImage:
    """An image in memory that notes which windows are read."""

    pixels: np.ndarray
    valid: np.ndarray
    read_windows: list = field(default_factory=list)

    @property
    def shape(self):
        return self.pixels.shape

    def read(self, row, col, rows, cols):
        self.read_windows.append((row, col, rows, cols))
        part = np.s_[row : row + rows, col : col + cols]
        return ImageWindow(self.pixels[part].copy(), self.valid[part].copy())


@pytest.fixture
def image():
    rng = np.random.default_rng(6)
    pixels, valid = rng.uniform(0, 255, SHAPE).astype(np.float32), np.ones(SHAPE, bool)
    valid[1000:1100, 1000:1300] = False
    pixels[~valid] = 0.0
    return CountedImage(pixels, valid)


@pytest.fixture
def view(image, monkeypatch):
    monkeypatch.setattr(view_pixels, "PYRAMIDS", Pyramids(64 << 20))
    return View("v", Path("v.tif"), image, camera())


def camera(k1=-0.26):
    """A lens with distortion 100 m above the ground, whose image shows about 103 by 77 m."""
    lens = BrownDistortion(k1=k1)
    return FrameModel((0.0, 0.0, 100.0), rotation_from_angles(0, 0, 0), 3000.0, (1549.5, 1149.5), distortion=lens)


def whole(image, level):
    """The whole image at a level, on the grey scale."""
    trend = SCALE.trend.window(0, 0, *SHAPE)
    made = ((image.pixels - trend - np.float32(SCALE.mean)) * np.float32(1 / SCALE.contrast), image.valid)
    for _ in range(level):
        made = halved(*made)
    return made


@pytest.mark.parametrize("level", range(6))
def test_windows_of_every_level_are_parts_of_the_whole_level(view, image, level):
    """Also across the borders of the parts that are kept, and at the end of the image."""
    pixels, valid = whole(image, level)
    rows, cols = pixels.shape
    for window in (PixelWindow(0, 0, rows, cols), PixelWindow(rows // 3, cols // 4, rows // 2, cols // 2)):
        found, part = read_pixels(view, window, SCALE, level), np.s_[
            window.row : window.row + window.rows, window.col : window.col + window.cols
        ]  # fmt: skip
        np.testing.assert_array_equal(found.valid, valid[part])
        np.testing.assert_allclose(found.pixels, pixels[part], rtol=0, atol=GREY)
        assert found.window == window


def test_levels_coarser_than_a_part_are_read_too(view, image):
    level = PART_PX.bit_length()
    pixels, _ = whole(image, level)
    found = read_pixels(view, PixelWindow(0, 0, *pixels.shape), SCALE, level)
    np.testing.assert_allclose(found.pixels, pixels, rtol=0, atol=10 * GREY)


def test_coarse_levels_are_read_once_and_the_oldest_parts_are_forgotten(view, image):
    level = 3
    window = PixelWindow(0, 0, SHAPE[0] >> level, SHAPE[1] >> level)
    read_pixels(view, window, SCALE, level)
    n = len(image.read_windows)
    assert n == -(-SHAPE[0] // PART_PX) * -(-SHAPE[1] // PART_PX)
    read_pixels(view, window, SCALE, level + 1 - 1)
    read_pixels(view, PixelWindow(3, 5, 40, 50), SCALE, level + 1)
    assert len(image.read_windows) == n
    small = Pyramids(1 << 20)
    small.read(image, window, SCALE, level)
    small.read(image, window, SCALE, level)
    assert len(image.read_windows) == 3 * n


def test_a_smaller_limit_forgets_parts_at_once(image):
    pyramids, window = Pyramids(64 << 20), PixelWindow(0, 0, SHAPE[0] >> 2, SHAPE[1] >> 2)
    before = pyramids.read(image, window, SCALE, 2)
    assert 2e6 < pyramids.held_bytes < 4e6
    pyramids.limit(1_000_000)
    assert 0 < pyramids.held_bytes <= 1_000_000
    pyramids.limit(0)
    assert pyramids.held_bytes == 0
    np.testing.assert_array_equal(pyramids.read(image, window, SCALE, 2).pixels, before.pixels)
    assert pyramids.held_bytes == 0


def test_other_scales_and_images_have_parts_of_their_own(view, image):
    window = PixelWindow(0, 0, 20, 20)
    first, other = (read_pixels(view, window, GreyScale(mean, 1.0), 3).pixels for mean in (0.0, 50.0))
    np.testing.assert_allclose(first - 50.0, other, rtol=0, atol=1e-3)
    dark = View("d", Path("d.tif"), CountedImage(image.pixels - 30.0, image.valid), camera())
    np.testing.assert_allclose(read_pixels(dark, window, GreyScale(0.0, 1.0), 3).pixels, first - 30.0, atol=1e-3)


def grid(west, north, side_m, per_side=9):
    across, down = np.linspace(0, side_m, per_side), np.linspace(0, side_m, per_side)
    transform = Affine(1, 0, west, 0, -1, north)
    return np.array([transform * (c, r) for c in across for r in down])


@pytest.mark.parametrize("level", [0, 1, 3])
@pytest.mark.parametrize(("west", "north"), [(-10.0, 5.0), (30.0, 30.0), (-70.0, 60.0)])
def test_a_window_shows_all_of_the_ground_that_the_image_shows(view, level, west, north):
    """Also where the patch reaches so far beyond the image that the lens cannot map its far side."""
    side_m = 45.0
    window = window_showing(view, grid(west, north, side_m), (0.0, 20.0), level)
    rng = np.random.default_rng(3)
    x, y, z = west + rng.uniform(0, side_m, 4000), north - rng.uniform(0, side_m, 4000), rng.uniform(0, 20, 4000)
    xy = (view.sensor.image_from_ground(np.column_stack([x, y, z])) + 0.5) / 2**level - 0.5
    last = np.array([SHAPE[1] >> level, SHAPE[0] >> level]) - 1
    shown = xy[((xy >= 0) & (xy <= last)).all(axis=1)]
    assert len(shown) > 50
    assert (shown >= (window.col, window.row)).all()
    assert (shown <= (window.col + window.cols - 1, window.row + window.rows - 1)).all()


def test_a_window_beside_points_that_no_lens_maps_is_not_the_whole_image(view):
    """Beyond 1.2 times the half diagonal this lens maps nothing; a quarter of the patch is there."""
    ground = grid(20.0, 90.0, 60.0)
    assert np.isnan(view.sensor.image_from_ground(np.column_stack([ground, np.zeros(len(ground))]))).any()
    window = window_showing(view, ground, (0.0, 10.0))
    assert window.rows * window.cols < 0.5 * SHAPE[0] * SHAPE[1]


def test_ground_that_the_image_does_not_show_has_no_window(view):
    assert window_showing(view, grid(300.0, 300.0, 20.0), (0.0, 10.0)) is None
    nothing = unseen(view, SCALE, 2)
    assert (nothing.pixels.shape, nothing.valid.any(), nothing.level) == ((2, 2), False, 2)
