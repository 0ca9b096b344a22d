"""Cells whose match curves are worth a look: a few typical ones, a few doubtful ones, a few without a height."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.quality import Quality
from zlocus.products.report.sampling import Survey

TYPICAL, DOUBTFUL, FAILED = "typical", "doubtful", "failed"
QUARTILES = {25: "the lower quartile", 50: "the median", 75: "the upper quartile"}
# Warnings that say something of the match itself, and reasons for no height that have curves.
WARNINGS = (Quality.WEAK, Quality.AMBIGUOUS, Quality.DISPUTED)
FAILURES = (Quality.NO_MATCH, Quality.RANGE_END, Quality.OCCLUDED, Quality.INCONSISTENT, Quality.IMPRECISE)
MOST_WARNINGS, MOST_FAILURES = 2, 3
MOST_PATCHES = 4
RULE = (
    "Typical cells have no warning, and a standard deviation at a quartile of all such cells; a doubtful or failed "
    "cell lies in the middle of the largest patch of cells with one of the most common reasons, or of the next "
    "largest where fewer than two images show that one."
)


@dataclass(frozen=True)
class ChosenCell:
    """A cell of the grid and why it was chosen. kind : `TYPICAL`, `DOUBTFUL` or `FAILED`; why : in words; others :
    cells to be shown in its place where it cannot be, the first that can."""

    row: int
    col: int
    kind: str
    why: str
    others: tuple[tuple[int, int], ...] = ()


def chosen_cells(found: Survey) -> list[ChosenCell]:
    """At most eight cells, by `RULE`; the same for the same rasters."""
    return _typical(found) + _of_reasons(found, DOUBTFUL, WARNINGS, MOST_WARNINGS) + _of_reasons(
        found, FAILED, FAILURES, MOST_FAILURES
    )  # fmt: skip


def _typical(found: Survey) -> list[ChosenCell]:
    at = np.flatnonzero((found.quality == 0) & np.isfinite(found.height) & np.isfinite(found.sigma))
    if not at.size:
        return []
    sigma = found.sigma.ravel()[at]
    chosen = []
    for percent, words in QUARTILES.items():
        nearest = at[np.argmin(np.abs(sigma - np.percentile(sigma, percent)))]
        i, j = np.unravel_index(nearest, found.sigma.shape)
        chosen.append(ChosenCell(*found.grid_cell(int(i), int(j)), TYPICAL, f"standard deviation at {words}"))
    return list({(cell.row, cell.col): cell for cell in reversed(chosen)}.values())[::-1]


def _of_reasons(found: Survey, kind: str, flags: tuple[Quality, ...], most: int) -> list[ChosenCell]:
    """A cell of each of the most common reasons."""
    has_height = np.isfinite(found.height)
    chosen = []
    for flag in flags:
        patch = ((found.quality & np.uint16(flag)) != 0) & (has_height if kind == DOUBTFUL else ~has_height)
        if patch.any():
            first, *others = (found.grid_cell(*middle) for middle in _middles(patch))
            chosen.append((int(patch.sum()), ChosenCell(*first, kind, str(flag.name), tuple(others))))
    chosen.sort(key=lambda each: -each[0])
    return [cell for _, cell in chosen[:most]]


def _middles(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The cells (row, column) of the thickest patches that are farthest from all that is not in the mask; beyond the
    rim of the grid nothing is."""
    padded = np.pad(mask, 1).astype(np.uint8)
    inside = np.asarray(cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))[1:-1, 1:-1].copy()
    patches = np.asarray(cv2.connectedComponents(padded, connectivity=4)[1])[1:-1, 1:-1]
    middles: list[tuple[int, int]] = []
    while len(middles) < MOST_PATCHES and inside.any():
        i, j = np.unravel_index(int(np.argmax(inside)), mask.shape)
        middles.append((int(i), int(j)))
        inside[patches == patches[i, j]] = 0.0
    return middles
