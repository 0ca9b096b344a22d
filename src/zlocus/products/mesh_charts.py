"""The texture of a surface of quadrilaterals: charts, cut from the images that show them and packed side by side.

A chart is a connected part of the surface that one image shows best; its texture is that part of the image itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from zlocus.core.sensor_model import FloatArray
from zlocus.products.mesh_texture import GREY, MAX_TEXTURE_ROWS, MIN_GAIN, TextureImage, has_value
from zlocus.products.ortho_images import stored
from zlocus.sensors.ground_sampling import sampled

# How often quadrilaterals take over the image of most of their neighbours, and the least share of pixels at which they
# do, compared with the image that shows them on most.
ROUNDS, MIN_SHARE = 4, 0.5
# Texels of an image around a chart, so that interpolation at its edge takes from the image itself.
BORDER = 1
# Texels along the side of what no image shows.
GREY_TEXELS = 4


@dataclass(frozen=True)
class SurfaceViews:
    """Where images show a surface.

    pixels : (i, n, 2) px of its vertices in each image; shown : (i, k) pixels on which an image shows each
    quadrilateral, 0 where it does not see it.
    """

    pixels: FloatArray
    shown: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        pixels: FloatArray,
        is_seen: NDArray[np.bool_],
        quads: NDArray[np.int64],
        images: Sequence[TextureImage],
    ) -> SurfaceViews:
        """The views of a surface. is_seen : (i, k) whether nothing stands before a quadrilateral."""
        shown = np.zeros(is_seen.shape, np.float32)
        for number, image in enumerate(images):
            xy = pixels[number][quads]
            with np.errstate(invalid="ignore"):
                inside = ((xy >= 0.0) & (xy <= np.array(image.bands.shape[::-1]) - 1.0)).all(axis=(1, 2))
            following = np.roll(xy, -1, axis=1)
            # Outlines are counter-clockwise from outside, and rows of images grow downwards.
            area = -0.5 * (xy[..., 0] * following[..., 1] - following[..., 0] * xy[..., 1]).sum(axis=1)
            may_show = np.flatnonzero(inside & is_seen[number] & (area > 0.0))
            may_show = may_show[has_value(image, xy[may_show].mean(axis=1))]
            shown[number, may_show] = area[may_show]
        return cls(pixels, shown)


def best_images(surface_views: SurfaceViews, quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """The image (k,) that each quadrilateral is textured from, -1 where none shows it.

    That is the one that shows most of the surface, unless another one shows the quadrilateral on clearly more pixels.
    Then quadrilaterals take over the image of most of their neighbours, where it shows them well.
    """
    shown = surface_views.shown
    best, area = np.full(shown.shape[1], -1), np.zeros(shown.shape[1], np.float32)
    for number in np.argsort(-shown.sum(axis=1), kind="stable"):
        wanted = shown[number] > MIN_GAIN * area
        best[wanted], area[wanted] = number, shown[number, wanted]
    may_show = (shown > 0) & (shown >= MIN_SHARE * shown.max(axis=0, initial=0.0))
    neighbours = _neighbours(quads)
    faces = np.arange(len(best))
    for _ in range(ROUNDS):
        mine = best >= 0
        chosen = csr_matrix((np.ones(int(mine.sum()), np.float32), (faces[mine], best[mine])), (len(best), len(shown)))
        votes = (neighbours @ chosen).toarray().T * may_show
        votes[best[mine], faces[mine]] += 0.5  # of equal numbers the present image wins
        best = np.where(votes.max(axis=0, initial=0.0) > 0.5, votes.argmax(axis=0), best)
    return best


def _neighbours(quads: NDArray[np.int64]) -> csr_matrix:
    """Which quadrilaterals (k, k) share an edge."""
    ends = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    _, edge = np.unique(ends, axis=0, return_inverse=True)
    face = np.repeat(np.arange(len(quads)), 4)
    of_edge = csr_matrix((np.ones(len(face), np.float32), (face, edge.ravel())))
    shared = csr_matrix(of_edge @ of_edge.T)
    shared.setdiag(0.0)
    return shared


@dataclass(frozen=True)
class ChartedSurface:
    """A surface cut into charts.

    vertex : (m,) number of the surface's vertex of each corner; uv : (m, 2) texture coordinates, from 0 to 1; quads :
    (k, 4) corners; texture : (r, c, 3) uint8; n_unseen : quadrilaterals that no image shows, which are grey.
    """

    vertex: NDArray[np.int64]
    uv: FloatArray
    quads: NDArray[np.int64]
    texture: NDArray[np.uint8]
    n_unseen: int


@dataclass(frozen=True)
class _Charts:
    """Charts of a surface.

    image : (c,) of each chart, -1 of what none shows; low, high : (c, 2) px, first and last column and row.
    """

    image: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]


def charted(
    images: Sequence[TextureImage], surface_views: SurfaceViews, quads: NDArray[np.int64], factors: Sequence[int]
) -> ChartedSurface:
    """Cut a surface into charts, and their texture from the images.

    factors : pixels of each image along the side of a texel.

    Raises
    ------
    InputError
        An image can no longer be read.
    """
    best = best_images(surface_views, quads)
    chart_of_quad, n_charts = _chart_numbers(quads, best)
    corner, number = np.unique(
        np.stack([np.repeat(chart_of_quad, 4), quads.ravel()], axis=-1), axis=0, return_inverse=True
    )
    of_chart, vertex = corner.T
    image = np.full(n_charts, -1)
    image[chart_of_quad] = best
    places = np.zeros((len(corner), 2))
    seen = image[of_chart] >= 0
    places[seen] = surface_views.pixels[image[of_chart[seen]], vertex[seen]]
    low, high = np.full((n_charts, 2), np.inf), np.full((n_charts, 2), -np.inf)
    np.minimum.at(low, of_chart, places)
    np.maximum.at(high, of_chart, places)
    charts = _Charts(image, np.floor(low).astype(np.int64), np.ceil(high).astype(np.int64))
    scale = np.ones(n_charts, np.int64)
    scale[image >= 0] = np.asarray(factors, np.int64)[image[image >= 0]]
    while True:
        size = np.where(
            (image >= 0)[:, None], -(-(charts.high - charts.low + 1) // scale[:, None]) + 2 * BORDER, GREY_TEXELS
        )
        first, shape = _packed(size)
        if max(shape) <= MAX_TEXTURE_ROWS:
            break
        scale *= 2
    texture = _texture(images, charts, scale, size, first, shape)
    uv = first[of_chart] + BORDER + (places - charts.low[of_chart] + 0.5) / scale[of_chart, None]
    uv[~seen] = first[of_chart[~seen]] + GREY_TEXELS / 2
    return ChartedSurface(vertex, uv / shape[::-1], number.reshape(-1, 4), texture, int((best < 0).sum()))


def _chart_numbers(quads: NDArray[np.int64], best: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """The chart (k,) of each quadrilateral, and their number: those that share corners and have the same image."""
    n_images = int(best.max(initial=-1)) + 2
    corner, number = np.unique(quads * n_images + (best + 1)[:, None], return_inverse=True)
    number = number.reshape(-1, 4)
    ends = np.repeat(number[:, 0], 3), number[:, 1:].ravel()
    n = len(corner)
    _, part = connected_components(coo_matrix((np.ones(len(ends[0]), bool), ends), (n, n)), directed=False)
    _, chart = np.unique(part[number[:, 0]], return_inverse=True)
    chart = np.where(best < 0, -1, chart.ravel())
    _, chart = np.unique(chart, return_inverse=True)  # all that no image shows is one
    return chart.ravel(), int(chart.max(initial=-1)) + 1


def _packed(size: NDArray[np.int64]) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """First column and row (c, 2) of rectangles of so many columns and rows (c, 2) in rows side by side, the tallest
    first, and the rows and columns of all."""
    width = max(int(np.ceil(np.sqrt(1.1 * size.prod(axis=1).sum()))), int(size[:, 0].max()))
    first, col, row, tallest = np.empty_like(size), 0, 0, 0
    for k in np.argsort(-size[:, 1], kind="stable"):
        if col + size[k, 0] > width:
            col, row, tallest = 0, row + tallest, 0
        first[k] = col, row
        col, tallest = col + int(size[k, 0]), max(tallest, int(size[k, 1]))
    return first, (row + tallest, width)


def _texture(
    images: Sequence[TextureImage], charts: _Charts, scale: NDArray[np.int64], size: NDArray[np.int64],
    first: NDArray[np.int64], shape: tuple[int, int],
) -> NDArray[np.uint8]:  # fmt: skip
    """The texture of all charts. An image is read once, in the window that holds its charts."""
    values = np.full((*shape, 3), GREY, np.uint8)
    for number, image in enumerate(images):
        mine = np.flatnonzero(charts.image == number)
        if not len(mine):
            continue
        n = int(scale[mine[0]])
        start = charts.low[mine].min(axis=0) - BORDER * n
        cols, rows = -(-(charts.high[mine].max(axis=0) + 1 - start) // n) + 2 * BORDER + 1
        limits = np.array(image.bands.shape[::-1]) - 1
        # In steps of one pixel, because charts start at any of them.
        x, y = (
            np.clip(start[k] + np.arange(count * n), 0, limits[k]).astype(float) for k, count in ((0, cols), (1, rows))
        )
        places = np.stack(np.meshgrid(x, y), axis=-1)
        found = sampled(image.bands.read, image.bands.shape, image.bands.displaced(places))
        if found is None:
            continue
        low, high = image.limits
        scaled = (np.moveaxis(found.values, 0, -1) - low) * (255.0 / (high - low))
        scaled = np.where(found.valid[..., None], scaled, float(GREY))
        for k in mine:
            (left, top), (width, height) = charts.low[k] - BORDER * n - start, size[k]
            part = scaled[top : top + height * n, left : left + width * n]
            part = part.reshape(height, n, width, n, -1).mean(axis=(1, 3))
            into = values[first[k, 1] : first[k, 1] + height, first[k, 0] : first[k, 0] + width]
            into[:] = stored(part, np.dtype(np.uint8))
    return values
