"""Charts of a surface: each shows its own part of an image, side by side with the others."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from zlocus.products import mesh_charts
from zlocus.products.mesh_charts import SurfaceViews, best_images, charted
from zlocus.products.mesh_texture import GREY
from zlocus.sensors.ground_sampling import BandWindow

N = 12
# JPEG is not written here: what is left is the rounding of values.
ROUNDED = 1.0


def grid():
    """Vertices (n, 2) and quadrilaterals of N x N squares, counter-clockwise for an image whose rows grow downwards."""
    y, x = np.mgrid[0 : N + 1, 0 : N + 1]
    number = np.arange((N + 1) ** 2).reshape(N + 1, N + 1)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.column_stack([x.ravel(), y.ravel()]).astype(float), quads


@dataclass(frozen=True)
class RampBands:
    """An image whose values are a ramp of columns and rows."""

    number: int
    shape: tuple[int, int] = (90, 120)
    first_valid_col: int = 0

    def value(self, xy):
        return 20.0 + 60.0 * self.number + 0.4 * xy[..., 0] + 0.3 * xy[..., 1]

    def read(self, row, col, rows, cols):
        y, x = np.mgrid[row : row + rows, col : col + cols].astype(float)
        values = self.value(np.stack([x, y], axis=-1)).astype(np.float32)
        return BandWindow(values[None], x >= self.first_valid_col)

    def displaced(self, xy):
        return xy


def images(n=2):
    return [SimpleNamespace(bands=RampBands(k), limits=(0.0, 255.0)) for k in range(n)]


def looked_up(chart, points):
    """Value of the texture at each corner, between its texels."""
    rows, cols = chart.texture.shape[:2]
    x, y = (chart.uv * [cols, rows] - 0.5).T
    col, row = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = x - col, y - row
    grey = chart.texture[..., 0].astype(float)
    return (
        (1 - a) * (1 - b) * grey[row, col]
        + a * (1 - b) * grey[row, col + 1]
        + (1 - a) * b * grey[row + 1, col]
        + a * b * grey[row + 1, col + 1]
    )


@pytest.fixture
def two_sided():
    """The left half is seen by one image, the right one by the other; a corner by none."""
    vertices, quads = grid()
    pixels = np.stack([10.3 + 2.0 * vertices, 31.7 + 1.5 * vertices])
    middle = vertices[quads].mean(axis=1)
    is_seen = np.stack([middle[:, 0] < N / 2, middle[:, 0] > N / 2]) & ~((middle > N - 3).all(axis=1))
    return pixels, quads, SurfaceViews.of(pixels, is_seen, quads, images())


@pytest.mark.parametrize("factor", [1, 2])
def test_the_texture_is_that_of_the_image(two_sided, factor):
    pixels, quads, surface_views = two_sided
    chart = charted(images(), surface_views, quads, [factor, factor])
    assert chart.n_unseen == 9
    assert chart.vertex[chart.quads].tolist() == quads.tolist()
    best = best_images(surface_views, quads)
    found = looked_up(chart, pixels)
    for number in (0, 1):
        corners = chart.quads[best == number].ravel()
        np.testing.assert_allclose(
            found[corners], RampBands(number).value(pixels[number][chart.vertex[corners]]), atol=ROUNDED
        )
    assert (found[chart.quads[best < 0]] == GREY).all()


def test_a_large_texture_gets_coarser(two_sided, monkeypatch):
    pixels, quads, surface_views = two_sided
    monkeypatch.setattr(mesh_charts, "MAX_TEXTURE_ROWS", 24)
    chart = charted(images(), surface_views, quads, [1, 1])
    assert max(chart.texture.shape) <= 24
    corners = chart.quads[best_images(surface_views, quads) == 0].ravel()
    truth = RampBands(0).value(pixels[0][chart.vertex[corners]])
    np.testing.assert_allclose(looked_up(chart, pixels)[corners], truth, atol=ROUNDED)


def test_neighbours_show_one_image_unless_another_one_is_much_larger():
    _, quads = grid()
    shown = np.ones((2, len(quads)), np.float32)
    shown[1] = 1.3
    shown[0, 5] = 2.2  # alone: its neighbours' image shows it well
    shown[0, :3], shown[1, :3] = 2.2, 0.5
    shown[1, 100] = 0.0
    best = best_images(SurfaceViews(np.zeros((2, 1, 2)), shown), quads)
    assert best[5] == 1
    assert best[:2].tolist() == [0, 0]
    assert best[100] == 0
    assert (best[20:90] == 1).all()


def test_faces_from_behind_and_beyond_the_border_are_not_shown():
    vertices, quads = grid()
    pixels = np.stack([vertices * [-1.0, 1.0] + np.array([50.0, 10.0]), vertices + np.array([113.5, 10.0])])
    shown = SurfaceViews.of(pixels, np.ones((2, len(quads)), bool), quads, images()).shown
    assert (shown[0] == 0).all()
    assert shown[1].reshape(N, N).any(axis=0).tolist() == [True] * 5 + [False] * (N - 5)


def test_pixels_without_a_value_show_nothing():
    """A part below a mask is shown by the other image, and by none where that has no value either."""
    vertices, quads = grid()
    pixels = np.stack([10.0 + 2.0 * vertices, 10.0 + 1.5 * vertices])
    masked = [
        SimpleNamespace(bands=RampBands(k, first_valid_col=first), limits=(0.0, 255.0))
        for k, first in ((0, 22), (1, 13))
    ]
    surface_views = SurfaceViews.of(pixels, np.ones((2, len(quads)), bool), quads, masked)
    chart = charted(masked, surface_views, quads, [1, 1])
    by_column = best_images(surface_views, quads).reshape(N, N)[0]
    assert by_column.tolist() == [-1, -1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0]
    assert chart.texture.min() >= 20
