"""Cells at which the mask of an image hides the ground: they are marked IMAGE_EXCLUDED, with or without a height."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.scene import View, has_mask, masked_pixels
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.level_records import READ_POINTS_PER_SIDE
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.occlusion import EDGE_PX, PAIR
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.matching.tile_views import GROWN_PX, grown
from zlocus.matching.view_pixels import PixelWindow, window_showing

# Cells of which nothing is asked, or nothing was found out.
NOT_JUDGED = Quality.OUTSIDE | Quality.FAILED
# Rows of cells that are projected at a time.
ROWS_AT_A_TIME = 256


def with_masked_cells(surface: Surface, window: CellWindow, match_scene: MatchScene, half: int) -> Surface:
    """The surface with IMAGE_EXCLUDED at the cells at whose height a mask hides an image.

    Those without a height that it leaves fewer than two images are UNSEEN too. A mask hides an image where one of its
    pixels lies in the window around the cell: there the image took no part. window : cells of the surface; half : half
    width of the largest window, px.
    """
    is_judged = (surface.quality & np.uint16(NOT_JUDGED)) == 0
    if not is_judged.any() or not any(has_mask(view.image) for view in match_scene.views):
        return surface
    xyz = _centres(window, match_scene)
    xyz[..., 2] = _heights_everywhere(surface.height, xyz[..., :2], match_scene)
    found = (_hidden_pixels(view, xyz, window, match_scene, half) for view in match_scene.views)
    hiding = [hidden_pixels for hidden_pixels in found if hidden_pixels is not None]
    hidden = np.zeros(is_judged.shape, np.bool_)
    for first in range(0, window.rows, ROWS_AT_A_TIME):
        rows = slice(first, first + ROWS_AT_A_TIME)
        for hidden_pixels in hiding:
            hidden[rows] |= hidden_pixels.cover(xyz[rows].reshape(-1, 3)).reshape(-1, window.cols)
    hidden &= is_judged
    quality = np.where(hidden, surface.quality | np.uint16(Quality.IMAGE_EXCLUDED), surface.quality)
    is_lost = hidden & np.isnan(surface.height) & ((quality & np.uint16(Quality.UNSEEN)) == 0)
    if is_lost.any():
        is_lost[is_lost] = _n_left(match_scene.views, hiding, xyz[is_lost]) < PAIR
        # It was compared at other heights, at which the mask does not hide it.
        unseen = (quality & ~np.uint16(Quality.OCCLUDED)) | np.uint16(Quality.UNSEEN)
        quality = np.where(is_lost, unseen, quality)
    return replace(surface, quality=quality)


def images_hidden_at(match_scene: MatchScene, xyz: FloatArray, half: int) -> list[str]:
    """Names of the views that a mask hides at a ground point (3,) m. half : see `with_masked_cells`."""
    names, reach = [], half + GROWN_PX
    for view in match_scene.views:
        x, y = view.sensor.image_from_ground(xyz[None])[0]
        rows, cols = view.image.shape
        if not (has_mask(view.image) and -0.5 <= x < cols - 0.5 and -0.5 <= y < rows - 0.5):
            continue
        row, col = math.floor(y + 0.5), math.floor(x + 0.5)
        top, left, bottom, right = max(row - reach, 0), max(col - reach, 0), row + reach + 1, col + reach + 1
        masked = masked_pixels(view.image, top, left, min(bottom, rows) - top, min(right, cols) - left)
        if masked is not None and masked.any():
            names.append(view.name)
    return names


def _centres(window: CellWindow, match_scene: MatchScene) -> FloatArray:
    """Centres (r, c, 3) m of cells; the heights are 0."""
    t = match_scene.transform(window, 0)
    x, y = t.c + t.a * (np.arange(window.cols) + 0.5), t.f + t.e * (np.arange(window.rows) + 0.5)
    xyz = np.zeros((window.rows, window.cols, 3))
    xyz[..., 0], xyz[..., 1] = x, y[:, None]
    return xyz


def _heights_everywhere(height: NDArray[np.float32], xy: FloatArray, match_scene: MatchScene) -> FloatArray:
    """Heights (r, c) m, in empty cells that of the nearest cell; without any, of the nearest tie point. xy : (r, c, 2)
    m."""
    known = np.isfinite(height)
    if known.all():
        return height.astype(np.float64)
    if known.any():
        _, nearest = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_label = np.zeros(int(nearest.max()) + 1)
        of_label[nearest[known]] = height[known]
        return np.where(known, height, of_label[nearest]).astype(np.float64)
    ties = match_scene.ties[np.isfinite(match_scene.ties).all(axis=1)]
    if not len(ties):
        return np.full(height.shape, match_scene.ground_height)
    # Imported here, because it takes long and few runs need it.
    from scipy.spatial import cKDTree

    _, number = cKDTree(ties[:, :2]).query(xy.reshape(-1, 2))
    return np.asarray(ties[number, 2].reshape(height.shape))


@dataclass(frozen=True)
class HiddenPixels:
    """Pixels around which a mask hides an image. pixel_window : of the image; blocked : (r, c) bool, its pixels."""

    view: View
    pixel_window: PixelWindow
    blocked: NDArray[np.bool_]

    def cover(self, xyz: FloatArray) -> NDArray[np.bool_]:
        """Whether the pixel nearest to each ground point is hidden, (n,) bool. xyz : (n, 3) m."""
        row0, col0, rows, cols = self.pixel_window
        with np.errstate(invalid="ignore"):
            col, row = np.floor(self.view.sensor.image_from_ground(xyz) + 0.5).T - np.array([[col0], [row0]])
            inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        at = np.where(inside, row, 0).astype(np.int64), np.where(inside, col, 0).astype(np.int64)
        return np.asarray(inside & self.blocked[at])


def _hidden_pixels(
    view: View, xyz: FloatArray, window: CellWindow, match_scene: MatchScene, half: int
) -> HiddenPixels | None:
    """The hidden pixels of a view among those that show the cells; None where there are none. xyz : (r, c, 3) m."""
    if not has_mask(view.image):
        return None
    ground = match_scene.points_of(window, 0, READ_POINTS_PER_SIDE)
    pixel_window = window_showing(view, ground, (float(xyz[..., 2].min()), float(xyz[..., 2].max())))
    masked = None if pixel_window is None else masked_pixels(view.image, *pixel_window)
    if pixel_window is None or masked is None or not masked.any():
        return None
    return HiddenPixels(view, pixel_window, grown(masked, half))


def _n_left(views: Sequence[View], all_hidden_pixels: Sequence[HiddenPixels], xyz: FloatArray) -> NDArray[np.int64]:
    """Number of images, (n,), that show each ground point and are not hidden there. xyz : (n, 3) m."""
    n_left = np.zeros(len(xyz), np.int64)
    hidden_of_view = {id(hidden_pixels.view): hidden_pixels for hidden_pixels in all_hidden_pixels}
    for view in views:
        rows, cols = view.image.shape
        col, row = view.sensor.image_from_ground(xyz).T
        last_row, last_col = rows - 1 - EDGE_PX, cols - 1 - EDGE_PX
        with np.errstate(invalid="ignore"):
            shows = (row >= EDGE_PX) & (row <= last_row) & (col >= EDGE_PX) & (col <= last_col)
        if id(view) in hidden_of_view:
            shows &= ~hidden_of_view[id(view)].cover(xyz)
        n_left += shows
    return n_left
