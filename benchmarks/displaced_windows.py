"""How far an ortho-image lies from what it has to show, window by window."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from workplace import CannotRun
from zlocus.orientation.edge_correlation import peak_of

# Windows that are compared: side, step, and how far the two may lie apart, px; share of a window that has to be shown,
# and the correlation from which on the windows show the same.
WINDOW_PX, STEP_PX, SEARCH_PX, MIN_VALID, MIN_CORRELATION = 48, 24, 4, 0.98, 0.7


def displacements(ortho: Path, truth: Path) -> NDArray[np.float64]:
    """How far windows of an ortho-image lie from those of the truth, (n, 2) px, all bands together.

    Raises
    ------
    CannotRun
        No window of the two agrees.
    """
    with rasterio.open(ortho) as file, rasterio.open(truth) as true:
        pixel_m = true.transform.a
        row, col = (round(at) for at in ((file.transform.f - true.transform.f) / -pixel_m,
                                         (file.transform.c - true.transform.c) / pixel_m))  # fmt: skip
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + file.height, true.height), min(col + file.width, true.width)
        inside = slice(top - row, bottom - row), slice(left - col, right - col)
        found = []
        for band in range(1, file.count + 1):
            shown, valid = file.read(band)[inside].astype(np.float32), file.read_masks(band)[inside] > 0
            known = true.read(band)[top:bottom, left:right].astype(np.float32)
            found += _displaced_windows(known, shown, valid)
    if not found:
        raise CannotRun(f"{ortho} shows nothing of {truth}")
    return np.array(found)


def _displaced_windows(
    known: NDArray[np.float32], shown: NDArray[np.float32], valid: NDArray[np.bool_]
) -> list[tuple[float, float]]:
    found = []
    rows, cols = known.shape
    for row in range(0, rows - WINDOW_PX + 1, STEP_PX):
        for col in range(0, cols - WINDOW_PX + 1, STEP_PX):
            part = slice(row, row + WINDOW_PX), slice(col, col + WINDOW_PX)
            if valid[part].mean() < MIN_VALID:
                continue
            template = known[part][SEARCH_PX:-SEARCH_PX, SEARCH_PX:-SEARCH_PX]
            surface = cv2.matchTemplate(shown[part], template, cv2.TM_CCOEFF_NORMED)
            peak = peak_of(surface.astype(float))
            if peak is not None and surface.max() >= MIN_CORRELATION:
                found.append((peak.col, peak.row))
    return found
