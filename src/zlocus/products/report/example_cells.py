"""Example cells whose match curves the report shows: typical ones, doubtful ones, and ones without a height."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.quality import Quality
from zlocus.products.report.sampling import Survey

TYPICAL, DOUBTFUL, FAILED = "typical", "doubtful", "failed"
QUARTILES = {25: "the lower quartile", 50: "the median", 75: "the upper quartile"}
# Warnings about the match itself, and reasons for a missing height where match curves can exist.
WARNINGS = (Quality.WEAK, Quality.AMBIGUOUS, Quality.DISPUTED)
FAILURES = (Quality.NO_MATCH, Quality.RANGE_END, Quality.OCCLUDED, Quality.INCONSISTENT, Quality.IMPRECISE)
MAX_WARNINGS, MAX_FAILURES = 2, 3
MAX_PATCHES = 4
RULE = (
    "Typical cells have no warning and a standard deviation at a quartile of all such cells. A doubtful or failed cell "
    "lies in the middle of the largest patch of cells with one of the most common reasons; where fewer than two images "
    "show that patch, it lies in the next largest."
)


@dataclass(frozen=True)
class ChosenCell:
    """A cell of the grid and why it was chosen.

    kind : `TYPICAL`, `DOUBTFUL` or `FAILED`; why : in words; others : cells of which the first that can be shown takes
    its place where it cannot be shown itself.
    """

    row: int
    col: int
    kind: str
    why: str
    others: tuple[tuple[int, int], ...] = ()


def chosen_cells(survey: Survey) -> list[ChosenCell]:
    """At most eight cells, chosen by `RULE`; equal rasters give equal cells."""
    return _typical(survey) + _of_reasons(survey, DOUBTFUL, WARNINGS, MAX_WARNINGS) + _of_reasons(
        survey, FAILED, FAILURES, MAX_FAILURES
    )  # fmt: skip


def _typical(survey: Survey) -> list[ChosenCell]:
    at = np.flatnonzero((survey.quality == 0) & np.isfinite(survey.height) & np.isfinite(survey.sigma))
    if not at.size:
        return []
    sigma = survey.sigma.ravel()[at]
    chosen = []
    for percent, words in QUARTILES.items():
        nearest = at[np.argmin(np.abs(sigma - np.percentile(sigma, percent)))]
        i, j = np.unravel_index(nearest, survey.sigma.shape)
        chosen.append(ChosenCell(*survey.grid_cell(int(i), int(j)), TYPICAL, f"standard deviation at {words}"))
    return list({(cell.row, cell.col): cell for cell in reversed(chosen)}.values())[::-1]


def _of_reasons(survey: Survey, kind: str, flags: tuple[Quality, ...], most: int) -> list[ChosenCell]:
    """One cell for each of the most common reasons, at most `most` of them."""
    has_height = np.isfinite(survey.height)
    chosen = []
    for flag in flags:
        patch = ((survey.quality & np.uint16(flag)) != 0) & (has_height if kind == DOUBTFUL else ~has_height)
        if patch.any():
            first, *others = (survey.grid_cell(*middle) for middle in _middles(patch))
            chosen.append((int(patch.sum()), ChosenCell(*first, kind, str(flag.name), tuple(others))))
    chosen.sort(key=lambda each: -each[0])
    return [cell for _, cell in chosen[:most]]


def _middles(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Innermost cells (row, column) of the thickest patches of a mask, the thickest first.

    Cells beyond the edge of the grid count as outside the mask.
    """
    padded = np.pad(mask, 1).astype(np.uint8)
    inside = np.asarray(cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))[1:-1, 1:-1].copy()
    patches = np.asarray(cv2.connectedComponents(padded, connectivity=4)[1])[1:-1, 1:-1]
    middles: list[tuple[int, int]] = []
    while len(middles) < MAX_PATCHES and inside.any():
        i, j = np.unravel_index(int(np.argmax(inside)), mask.shape)
        middles.append((int(i), int(j)))
        inside[patches == patches[i, j]] = 0.0
    return middles
