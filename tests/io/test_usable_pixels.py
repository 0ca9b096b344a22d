"""Pixels without a grey value that no tag declares: too large values, and plateaus at the border."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from rasterio.errors import NotGeoreferencedWarning
from scipy.ndimage import gaussian_filter

from rendered_scenes import HEIGHTS, errors_of, read, run
from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.core.scene import ImageWindow
from zlocus.io.images import check_grey_values, open_image, with_plateau
from zlocus.io.usable_pixels import MIN_PLATEAU_SHARE, BorderPlateau, border_plateau

# Heights beside a border of zeros were off by tens of metres while it was matched.
GROSS_M = 3.0


@dataclass
class ArrayImage:
    """An image in memory that counts the pixels that are read."""

    pixels: np.ndarray
    valid: np.ndarray | None = None
    dtype: str = "uint16"
    n_read: int = 0
    places: list = field(default_factory=list)

    @property
    def shape(self):
        return self.pixels.shape

    def read(self, row, col, rows, cols):
        self.n_read += rows * cols
        part = self.pixels[row : row + rows, col : col + cols].astype(np.float32)
        valid = np.ones(part.shape, bool) if self.valid is None else self.valid[row : row + rows, col : col + cols]
        return ImageWindow(part, valid)


def textured(shape=(300, 420), seed=0):
    return np.random.default_rng(seed).integers(300, 2000, shape).astype(np.uint16)


def with_turned_border(pixels, value, degrees=8.0, width=20):
    """The image within a turned rectangle, as an image that was warped by other software; the border has one value."""
    row, col = np.indices(pixels.shape)
    t = np.radians(degrees)
    y, x = row - pixels.shape[0] / 2, col - pixels.shape[1] / 2
    along, across = x * np.cos(t) + y * np.sin(t), -x * np.sin(t) + y * np.cos(t)
    outside = (np.abs(along) > pixels.shape[1] / 2 - width) | (np.abs(across) > pixels.shape[0] / 2 - width)
    return np.where(outside, value, pixels).astype(pixels.dtype), outside


@pytest.mark.parametrize("value", [0, 255, 65535])
def test_a_turned_border_of_one_value_is_found_whole(value):
    pixels, outside = with_turned_border(textured(), value)
    found = border_plateau(ArrayImage(pixels))
    assert found is not None
    assert found.value == value
    np.testing.assert_array_equal(found.covers(0, 0, *pixels.shape), outside)
    assert found.n_pixels == outside.sum()


@given(st.integers(0, 250), st.integers(0, 350), st.integers(1, 60), st.integers(1, 60))
def test_a_window_of_a_plateau_is_a_part_of_the_whole_plateau(row, col, rows, cols):
    pixels, outside = with_turned_border(textured(), 0)
    found = border_plateau(ArrayImage(pixels))
    rows, cols = min(rows, 300 - row), min(cols, 420 - col)
    np.testing.assert_array_equal(found.covers(row, col, rows, cols), outside[row : row + rows, col : col + cols])


def test_an_ordinary_image_has_no_plateau_and_few_pixels_are_read():
    image = ArrayImage(textured((2000, 2400)))
    assert border_plateau(image) is None
    assert image.n_read < 0.001 * image.pixels.size


@pytest.mark.parametrize("inside", [True, False])
def test_plateaus_that_are_small_or_not_at_the_border_are_grey_values(inside):
    pixels = textured((1000, 1000))
    if inside:
        pixels[400:600, 300:700] = 4095  # a saturated roof
    else:
        side = int(np.sqrt(0.5 * MIN_PLATEAU_SHARE * pixels.size))
        pixels[:side, :side] = 0  # a dark corner
    assert border_plateau(ArrayImage(pixels)) is None


def test_an_image_that_is_saturated_everywhere_has_no_border():
    """A third of it has the greatest value, at the border too."""
    pixels = gaussian_filter(np.random.default_rng(4).normal(size=(400, 500)), 6.0)
    pixels = np.minimum(pixels / pixels.std() * 300 + 2000, 2100).astype(np.uint16)
    assert 0.2 < (pixels == 2100).mean() < 0.5
    assert border_plateau(ArrayImage(pixels)) is None


def test_a_plateau_continues_behind_declared_nodata():
    pixels, outside = with_turned_border(textured(), 0)
    valid = np.ones(pixels.shape, bool)
    valid[:, :3] = False
    found = border_plateau(ArrayImage(pixels, valid))
    assert found is not None
    np.testing.assert_array_equal(found.covers(0, 0, *pixels.shape) & valid, outside & valid)


def test_an_image_of_one_value_is_a_plateau_as_a_whole():
    found = border_plateau(ArrayImage(np.full((50, 60), 7, np.uint16)))
    assert isinstance(found, BorderPlateau)
    assert found.n_pixels == 50 * 60


def written(path, pixels, **profile):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            path, "w", driver="GTiff", height=pixels.shape[0], width=pixels.shape[1], count=1, dtype=pixels.dtype,
            **profile,
        ) as file:  # fmt: skip
            file.write(pixels, 1)
    return path


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64", "uint64"])
def test_numbers_larger_than_grey_values_are_left_out_and_counted(tmp_path, dtype):
    pixels = textured().astype(dtype)
    pixels[10, 20:25] = 1e18
    image = open_image(written(tmp_path / "a.tif", pixels))
    with pytest.warns(ZlocusWarning, match=r"a\.tif: 5 of its pixels hold values up to 1e\+18.*left out"):
        check_grey_values(image)
    window = image.read(0, 0, *pixels.shape)
    expected = np.ones(pixels.shape, bool)
    expected[10, 20:25] = False
    np.testing.assert_array_equal(window.valid, expected)
    assert window.pixels[~expected].max() == 0.0


def test_a_declared_nodata_value_may_be_larger_than_any_grey_value(tmp_path):
    pixels = textured().astype(np.float32)
    pixels[:40] = -3.4e38
    image = open_image(written(tmp_path / "a.tif", pixels, nodata=float(pixels[0, 0])))
    check_grey_values(image)
    assert not image.read(0, 0, *pixels.shape).valid[:40].any()


def test_an_image_of_too_large_values_is_refused(tmp_path):
    image = open_image(written(tmp_path / "a.tif", textured().astype(np.float32) * np.float32(1e18)))
    with pytest.raises(InputError, match=r"a\.tif holds values up to 2e\+21, which cannot be grey values\. Scale them"):
        check_grey_values(image)


def test_a_border_of_one_value_is_named_and_not_valid(tmp_path):
    pixels, outside = with_turned_border(textured(), 0)
    image = open_image(written(tmp_path / "a.tif", pixels))
    with pytest.warns(ZlocusWarning, match=r"a\.tif: \d+\.\d % of its pixels are a border of the constant value 0"):
        found = with_plateau(image)
    np.testing.assert_array_equal(found.read(0, 0, *pixels.shape).valid, ~outside)


def changed(images, folder, change):
    """The images of a scene, each with other pixels: `change` gets (r, c) and gives (r, c)."""
    folder.mkdir()
    paths = []
    for path in images.inputs:
        with rasterio.open(path) as source:
            pixels, profile, rpcs = source.read(1), source.profile, source.rpcs
        pixels = change(pixels)
        profile = {key: value for key, value in profile.items() if key not in ("nodata", "predictor", "transform")}
        paths.append(folder / path.name)
        with rasterio.open(paths[-1], "w", **profile | {"dtype": pixels.dtype.name}, rpcs=rpcs) as file:
            file.write(pixels, 1)
    return tuple(paths)


@pytest.mark.parametrize("value", [3e38, 1e18, -1e30])
def test_a_pixel_with_a_too_large_value_does_not_stop_a_run(images, tmp_path, value):
    def spoil(pixels):
        pixels = pixels.astype(np.float32)
        pixels[70, 75] = value
        return pixels

    with pytest.warns(ZlocusWarning, match="1 of its pixels hold values up to"):
        out = run(changed(images("sine"), tmp_path / "in", spoil), tmp_path / "out", report=False, products=()).out
    error, seen = errors_of(out, "sine")
    assert np.isfinite(error[seen]).mean() > 0.95
    assert np.nanmax(np.abs(error[seen])) < GROSS_M


def test_a_border_of_zeros_that_no_tag_declares_gives_no_false_heights(images, tmp_path):
    def frame(pixels):
        return with_turned_border(pixels, 0, degrees=6.0, width=8)[0]

    with pytest.warns(ZlocusWarning, match="border of the constant value 0"):
        out = run(changed(images("sine"), tmp_path / "in", frame), tmp_path / "out", report=False, products=()).out
    error, _ = errors_of(out, "sine")
    height, _ = read(out / "dsm.tif")
    assert np.isfinite(height).sum() > 5000
    assert (np.abs(error[np.isfinite(error)]) > GROSS_M).mean() < 0.001
    assert HEIGHTS[0] < np.nanmin(height) < np.nanmax(height) < HEIGHTS[1]
