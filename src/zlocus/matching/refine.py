"""Sub-step heights: the measure itself, a few fractions of a step around a smooth surface that the windows follow."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.refine import tile_profile
from zlocus.kernels.smooth import slopes, smooth_surface
from zlocus.matching.views import TileViews
from zlocus.options import RefineOptions

FloatGrid = NDArray[np.float32]
# Heights measured around the surface, in steps: wide in the first round, then three beside the peak.
FIRST_OFFSETS = np.linspace(-1.5, 1.5, 5, dtype=np.float32)
LATER_OFFSETS = np.linspace(-0.5, 0.5, 3, dtype=np.float32)
SPACINGS = (1, 2, 4)
SLOPE_REACH = 8
NARROW_BASE, WIDE_WINDOW, NARROW_WINDOW = 2.0, 9, 7


@dataclass(frozen=True)
class RefinedHeights:
    """height : (r, c) float32 height indices; ncc : (r, c) float32, the measure there; is_refined : (r, c) bool, False
    where the semi-global height was kept."""

    height: FloatGrid
    ncc: FloatGrid
    is_refined: NDArray[np.bool_]


def smoothed(surface: FloatGrid, jump_steps: float) -> FloatGrid:
    """Median, then means along the slope that do not reach across jumps."""
    out = np.asarray(cv2.medianBlur(np.ascontiguousarray(surface), 5), np.float32)
    by_row, by_col = np.empty_like(out), np.empty_like(out)
    for spacing in SPACINGS:
        slopes(out, SLOPE_REACH, by_row, by_col)
        smooth = np.empty_like(out)
        smooth_surface(out, by_row, by_col, spacing, np.float32(jump_steps), smooth)
        out = smooth
    return out


def refine(
    coefficients: TileViews,
    coarse: FloatGrid,
    seen: NDArray[np.int32],
    block: int,
    step_cells: float,
    options: RefineOptions,
) -> RefinedHeights:
    """Refine height indices `coarse` (r, c) float32.

    coefficients : the views with cubic B-spline coefficients for pixels. Each round smooths the surface, measures the
    mean NCC at a few fractions of a step around it and puts a parabola through the best three. Windows that follow a
    noisy surface would see a different place in each image, hence the smoothing; a refined height further than
    `reach_steps` from the semi-global one is not believed. step_cells : height of a step over the side of a cell.
    """
    half = (options.window or default_window(step_cells)) // 2
    height, is_refined = coarse.astype(np.float32), np.zeros(coarse.shape, bool)
    best = np.zeros(coarse.shape, np.float32)
    for number in range(options.rounds):
        surface = smoothed(height, options.jump_steps)
        offsets = FIRST_OFFSETS if number == 0 else LATER_OFFSETS
        profile = np.empty((len(offsets), *coarse.shape), np.float32)
        tile_profile(
            coefficients.pixels, coefficients.layout, coefficients.nodes, coefficients.heights,
            np.pad(surface, half, mode="edge"), offsets, block, half, seen, np.float32(0.0), profile,
        )  # fmt: skip
        found, best, inside = parabola_peak(profile, offsets)
        found += surface
        is_refined = inside & (np.abs(found - coarse) < options.reach_steps)
        height = np.where(is_refined, found, height)
    return RefinedHeights(height, best, is_refined)


def default_window(step_cells: float) -> int:
    """Side of the window where none is asked for.

    With a narrow base a step is many cells high and relief within a window a small part of it: noise rules and a large
    window averages it. With a wide base relief rules, and a large window smooths it away.
    """
    return WIDE_WINDOW if step_cells > NARROW_BASE else NARROW_WINDOW


def parabola_peak(profile: NDArray[np.float32], offsets: FloatGrid) -> tuple[FloatGrid, FloatGrid, NDArray[np.bool_]]:
    """Position and value of the maximum of equally spaced samples (j, r, c), and whether it is not an end sample."""
    at = profile.argmax(axis=0)
    inside = (at > 0) & (at < len(offsets) - 1)
    at = np.clip(at, 1, len(offsets) - 2)[None]
    left, here, right = (np.take_along_axis(profile, at + d, axis=0)[0] for d in (-1, 0, 1))
    bend = np.minimum(left - 2 * here + right, np.float32(-1e-6))
    shift = np.clip(np.float32(0.5) * (left - right) / bend, -1, 1)
    value = here - np.float32(0.25) * (left - right) * shift
    return offsets[at[0]] + shift * (offsets[1] - offsets[0]), value, inside
