"""Seams of a mosaic of two images."""

from __future__ import annotations

import numpy as np

from zlocus.matching.seams import NOTHING, preferred_images, seamed_images

ROWS, COLS = 60, 80


def scene():
    """Two images that agree along a bent road only, and their scores."""
    grey = np.zeros((2, ROWS, COLS), np.float32)
    grey[1] = 1.0
    road = 42 + np.round(6 * np.sin(np.arange(ROWS) / 9)).astype(int)
    for row, col in enumerate(road):
        grey[1, row, col - 3 : col + 4] = 0.0
    score = np.stack([np.linspace(1, 0, COLS), np.linspace(0, 1, COLS)])[:, None].repeat(ROWS, axis=1)
    return grey, score, road


def test_a_seam_follows_the_road():
    grey, score, road = scene()
    may_show = np.ones(grey.shape, bool)
    labels = seamed_images(preferred_images(score, may_show), grey, may_show, 20.0, 0.5)
    assert (np.abs((labels == 0).sum(axis=1) - road) <= 3).all()


def test_seams_stay_in_their_band():
    grey, score, _ = scene()
    may_show = np.ones(grey.shape, bool)
    preferred = preferred_images(score, may_show)
    labels = seamed_images(preferred, grey, may_show, 4.0, 0.5)
    assert (labels[:, : COLS // 2 - 5] == 0).all()
    assert (labels[:, COLS // 2 + 5 :] == 1).all()


def test_no_image_is_shown_where_it_has_no_value():
    grey, score, _ = scene()
    may_show = np.ones(grey.shape, bool)
    may_show[0, 10:30, 5:70], may_show[:, 50:, :10] = False, False
    labels = seamed_images(preferred_images(score, may_show), grey, may_show, 20.0, 0.5)
    assert (labels[50:, :10] == NOTHING).all()
    shown = labels >= 0
    row, col = np.nonzero(shown)
    assert may_show[labels[shown], row, col].all()
    assert (shown == may_show.any(axis=0)).all()
