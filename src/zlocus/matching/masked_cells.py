"""Cells at which the mask of an image hides the ground: they are marked IMAGE_EXCLUDED, with or without a height."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.scene import View, has_mask, masked_pixels
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.level_records import READ_POINTS_PER_SIDE
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.matching.tile_views import grown
from zlocus.matching.view_pixels import window_showing

# Cells of which nothing is asked, or nothing was found out.
NOT_JUDGED = Quality.OUTSIDE | Quality.FAILED
# Rows of cells that are projected at a time.
ROWS_AT_A_TIME = 256


def with_masked_cells(surface: Surface, window: CellWindow, match_scene: MatchScene, half: int) -> Surface:
    """The surface with IMAGE_EXCLUDED at the cells at whose height a mask hides an image.

    A mask hides an image where one of its pixels lies in the window around the cell: there the image took no part.
    window : cells of the surface; half : half width of the largest window, px.
    """
    masked_views = [view for view in match_scene.views if has_mask(view.image)]
    is_judged = (surface.quality & np.uint16(NOT_JUDGED)) == 0
    if not masked_views or not is_judged.any():
        return surface
    xyz = _centres(window, match_scene)
    xyz[..., 2] = _heights_everywhere(surface.height, xyz[..., :2], match_scene)
    ground = match_scene.points_of(window, 0, READ_POINTS_PER_SIDE)
    hidden = np.zeros(is_judged.shape, np.bool_)
    for view in masked_views:
        hidden |= _hidden_in(view, xyz, ground, half)
    quality = np.where(hidden & is_judged, surface.quality | np.uint16(Quality.IMAGE_EXCLUDED), surface.quality)
    return replace(surface, quality=quality)


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


def _hidden_in(view: View, xyz: FloatArray, ground: FloatArray, half: int) -> NDArray[np.bool_]:
    """Cells (r, c) that a mask hides in a view. xyz : (r, c, 3) m; ground : (n, 2) m, see `window_showing`."""
    hidden = np.zeros(xyz.shape[:2], np.bool_)
    part = window_showing(view, ground, (float(xyz[..., 2].min()), float(xyz[..., 2].max())))
    masked = None if part is None else masked_pixels(view.image, *part)
    if part is None or masked is None or not masked.any():
        return hidden
    blocked = grown(masked, half)
    for first in range(0, len(xyz), ROWS_AT_A_TIME):
        rows = slice(first, first + ROWS_AT_A_TIME)
        xy = view.sensor.image_from_ground(xyz[rows].reshape(-1, 3))
        with np.errstate(invalid="ignore"):
            col, row = np.floor(xy + 0.5).T - np.array([[part.col], [part.row]])
            inside = (row >= 0) & (row < part.rows) & (col >= 0) & (col < part.cols)
        at = np.where(inside, row, 0).astype(np.int64), np.where(inside, col, 0).astype(np.int64)
        hidden[rows] = (inside & blocked[at]).reshape(-1, xyz.shape[1])
    return hidden
