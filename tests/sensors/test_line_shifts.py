"""Images whose lines are put back where the camera model says they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from zlocus.core.scene import ColourSource, ImageWindow, has_mask
from zlocus.sensors.line_shifts import LANCZOS_PX, LineShifts, StraightenedImage, lanczos_weights
from zlocus.sensors.straighten_kernel import straighten

ROWS, COLS = 90, 70
# Errors of Lanczos' interpolation of a wave of 16 px, as a share of its amplitude.
MAX_ERROR, RMS_ERROR = 0.01, 3e-3
ROUNDING = 1e-5
SHIFTS = LineShifts(25.0, np.array([(0.3, -0.2), (-0.25, 0.15), (0.1, 0.35), (0.0, -0.3), (0.2, 0.1)]))


def wave(col, row):
    return np.cos(2 * np.pi * (col + 0.5 * row) / 16.0).astype(np.float32)


@dataclass(frozen=True)
class Pixels:
    """An image in memory; its colours are multiples of its grey values."""

    values: np.ndarray
    valid: np.ndarray
    dtype: str = "float32"
    has_colours: bool = True
    mask: np.ndarray | None = None

    @property
    def shape(self):
        return self.values.shape

    def masked(self, row, col, rows, cols):
        return None if self.mask is None else self.mask[row : row + rows, col : col + cols]

    def read(self, row, col, rows, cols):
        part = np.s_[row : row + rows, col : col + cols]
        return ImageWindow(np.where(self.valid[part], self.values[part], 0.0).astype(np.float32), self.valid[part])

    def colours(self, row, col, rows, cols):
        grey = self.read(row, col, rows, cols).pixels
        return np.stack([grey, 2.0 * grey, 3.0 * grey])


def displaced(shifts=SHIFTS, valid=None):
    """An image of a wave whose content lies by `shifts` from where the camera model says."""
    col, row = np.meshgrid(np.arange(COLS, dtype=float), np.arange(ROWS, dtype=float))
    # The content of model line q is found at line q + shift(q); the shifts change slowly.
    model_row = row - shifts.at(row.ravel())[:, 1].reshape(row.shape)
    model_row = row - shifts.at(model_row.ravel())[:, 1].reshape(row.shape)
    model_col = col - shifts.at(model_row.ravel())[:, 0].reshape(row.shape)
    return Pixels(wave(model_col, model_row), np.ones((ROWS, COLS), bool) if valid is None else valid)


def test_lines_are_put_back():
    image = StraightenedImage(displaced(), SHIFTS)
    found = image.read(0, 0, ROWS, COLS)
    col, row = np.meshgrid(np.arange(COLS, dtype=float), np.arange(ROWS, dtype=float))
    inner = np.s_[4:-4, 4:-4]
    error = np.abs(found.pixels - wave(col, row))[inner]
    before = np.abs(displaced().values - wave(col, row))[inner]
    assert before.max() > 0.1
    assert error.max() < MAX_ERROR
    assert np.sqrt(np.mean(error**2)) < RMS_ERROR
    assert found.valid.all()


@pytest.mark.parametrize("window", [(0, 0, 20, 30), (31, 7, 40, 50), (ROWS - 9, COLS - 5, 9, 5)])
def test_a_window_is_a_part_of_the_whole(window):
    image = StraightenedImage(displaced(), SHIFTS)
    row, col, rows, cols = window
    whole = image.read(0, 0, ROWS, COLS).pixels
    np.testing.assert_allclose(image.read(*window).pixels, whole[row : row + rows, col : col + cols], atol=ROUNDING)


def test_pixels_beside_invalid_ones_are_invalid():
    valid = np.ones((ROWS, COLS), bool)
    valid[40, 30] = False
    found = StraightenedImage(displaced(valid=valid), SHIFTS).read(0, 0, ROWS, COLS)
    row, col = np.nonzero(~found.valid)
    assert (row.min(), row.max()) == (40 - LANCZOS_PX, 40 + LANCZOS_PX)
    assert (col.min(), col.max()) == (30 - LANCZOS_PX, 30 + LANCZOS_PX)
    assert (found.pixels[~found.valid] == 0.0).all()


def test_colours_move_with_the_grey_values():
    image = StraightenedImage(displaced(), SHIFTS)
    assert isinstance(image, ColourSource)
    assert image.has_colours
    grey, colours = image.read(5, 6, 30, 40).pixels, image.colours(5, 6, 30, 40)
    for band, factor in enumerate((1.0, 2.0, 3.0)):
        np.testing.assert_allclose(colours[band], factor * grey, atol=ROUNDING)


def test_weights_sum_to_one_and_leave_whole_pixels():
    weights = lanczos_weights(np.array([0.0, 0.5, 0.999]))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=ROUNDING)
    np.testing.assert_allclose(weights[0], [0, 0, 1, 0, 0, 0], atol=ROUNDING)
    np.testing.assert_allclose(weights[1], weights[1, ::-1], atol=ROUNDING)


def test_the_kernel_does_what_its_slow_twin_does():
    rng = np.random.default_rng(3)
    pixels = rng.normal(size=(20, 30)).astype(np.float32)
    first_row, first_col = rng.integers(0, 3, 12) + np.arange(12), rng.integers(0, 4, 12)
    row_weights, col_weights = (rng.normal(size=(12, 6)).astype(np.float32) for _ in range(2))
    out, twin = np.empty((12, 20), np.float32), np.zeros((12, 20))
    straighten(pixels, first_row, row_weights, first_col, col_weights, out)
    for r in range(12):
        for c in range(20):
            part = pixels[first_row[r] : first_row[r] + 6, first_col[r] + c : first_col[r] + c + 6]
            twin[r, c] = row_weights[r] @ part @ col_weights[r]
    np.testing.assert_allclose(out, twin, atol=1e-4)


def test_a_mask_hides_what_its_pixels_would_be_interpolated_into():
    """As nodata does: what is not valid for a mask is what is masked."""
    mask = np.zeros((ROWS, COLS), bool)
    mask[30:40, 20:26] = mask[0, 0] = True
    masked_image = StraightenedImage(replace(displaced(valid=~mask), mask=mask), SHIFTS)
    for window in ((0, 0, ROWS, COLS), (25, 10, 30, 9)):
        np.testing.assert_array_equal(masked_image.masked(*window), ~masked_image.read(*window).valid)
    assert not has_mask(StraightenedImage(displaced(), SHIFTS))
