"""Values between pixels: exact on planes, means where pixels are many, and nothing beside invalid pixels."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.sensors.ground_sampling import BandWindow, reduced, sampled

ROWS, COLS = 90, 120
# OpenCV's cubic kernel bends a plane by so much, and interpolates at multiples of a 32nd of a pixel.
OFF_PX = 0.06


def reader(values, valid=None):
    valid = np.ones(values.shape[1:], bool) if valid is None else valid

    def read(row, col, rows, cols):
        part = slice(row, row + rows), slice(col, col + cols)
        return BandWindow(values[:, *part], valid[part])

    return read


def planes():
    row, col = np.indices((ROWS, COLS)).astype(np.float32)
    return np.stack([2 * col + 100, 300 - 3 * row])


def places(first, step, n=20):
    x, y = np.meshgrid(first[0] + step * np.arange(n), first[1] + step * np.arange(n))
    return np.dstack([x, y])


@pytest.mark.parametrize("pixels_per_cell", [1.0, 3.3])
def test_planes_stay_planes(pixels_per_cell):
    xy = places((12.3, 20.7), pixels_per_cell)
    found = sampled(reader(planes()), (ROWS, COLS), xy, pixels_per_cell)
    assert found.valid.all()
    assert found.values[0] == pytest.approx(2 * xy[..., 0] + 100, abs=2 * OFF_PX * pixels_per_cell)
    assert found.values[1] == pytest.approx(300 - 3 * xy[..., 1], abs=3 * OFF_PX * pixels_per_cell)


def test_fine_detail_is_averaged():
    values = np.zeros((1, ROWS, COLS), np.float32)
    values[:, ::2] = 100.0
    found = sampled(reader(values), (ROWS, COLS), places((20.0, 20.0), 2.0), 2.0)
    assert found.values[0] == pytest.approx(50.0)


def test_beside_invalid_pixels_nothing_is_valid_and_values_do_not_leak():
    values, valid = planes(), np.ones((ROWS, COLS), bool)
    valid[:, 40:60] = False
    values[:, ~valid] = 1e6
    xy = places((30.25, 20.0), 1.0, 40)
    found = sampled(reader(values, valid), (ROWS, COLS), xy)
    x = xy[0, :, 0]
    assert (found.valid[0] == ((x <= 39) | (x >= 60))).all()
    assert np.abs(found.values[0][found.valid] - (2 * xy[..., 0] + 100)[found.valid]).max() < 3.0


def test_places_outside_of_the_image():
    assert sampled(reader(planes()), (ROWS, COLS), places((COLS + 5.0, 0.0), 1.0)) is None
    found = sampled(reader(planes()), (ROWS, COLS), places((COLS - 10.0, 5.0), 1.0))
    assert (found.valid[0] == (np.arange(20) < 10)).all()
    nothing = np.full((3, 3, 2), np.nan)
    assert sampled(reader(planes()), (ROWS, COLS), nothing) is None


def test_means_of_pixels_at_the_end():
    window = BandWindow(planes()[:, :5, :7], np.ones((5, 7), bool))
    found = reduced(window, 3)
    assert found.values.shape == (2, 2, 3)
    assert found.values[0, 1, 2] == pytest.approx(2 * 6 + 100)
    assert found.valid.all()
