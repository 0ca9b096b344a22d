"""Sub-step heights: the measure itself, a few fractions of a step around a smooth surface that the windows follow."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.refine import profile_peaks, tile_profile
from zlocus.kernels.smooth import slopes, smooth_surface
from zlocus.matching.lattice import NARROW_BASE
from zlocus.matching.views import TileViews
from zlocus.options import RefineOptions

FloatGrid = NDArray[np.float32]
# Heights measured around the surface, in steps: wide in the first round, then three beside the peak.
FIRST_OFFSETS = np.linspace(-1.5, 1.5, 5, dtype=np.float32)
LATER_OFFSETS = np.linspace(-0.5, 0.5, 3, dtype=np.float32)
SPACINGS = (1, 2, 4)
SLOPE_REACH = 8
WIDE_WINDOW, NARROW_WINDOW = 9, 7
FARTHEST_APART, LEAST_BEND = np.float32(3.0), np.float32(1e-6)


@dataclass(frozen=True)
class RefinedHeights:
    """Sub-step heights and what the measure looks like around them, all (r, c).

    height : float32 height indices; ncc : float32, the measure there; is_refined : bool, False where the semi-global
    height was kept; smooth : float32 height indices, the surface that the last windows followed; bend : float32,
    curvature of the measure per step squared, 0 where it has no peak; apart : float32 steps, distance of the peaks of
    two groups of pairs of views, NaN where a group has none; window_cells : of the correlation window.
    """

    height: FloatGrid
    ncc: FloatGrid
    is_refined: NDArray[np.bool_]
    smooth: FloatGrid
    bend: FloatGrid
    apart: FloatGrid
    window_cells: int


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
    step_cells: float,
    options: RefineOptions,
    fixed: NDArray[np.bool_] | None = None,
) -> RefinedHeights:
    """Refine height indices `coarse` (r, c) float32.

    coefficients : the views with cubic B-spline coefficients for pixels. Each round smooths the surface, measures the
    mean NCC at a few fractions of a step around it and puts a parabola through the best three. Windows that follow a
    noisy surface would see a different place in each image, hence the smoothing; a refined height further than
    `reach_steps` from the semi-global one is not believed. step_cells : height of a step over the side of a cell;
    fixed : (r, c), cells that are measured like the others and keep their heights.
    """
    half = (options.window or default_window(step_cells)) // 2
    height, is_refined = coarse.astype(np.float32), np.zeros(coarse.shape, bool)
    surface, best, bend = height, np.zeros(coarse.shape, np.float32), np.zeros(coarse.shape, np.float32)
    apart = np.full(coarse.shape, np.nan, np.float32)
    for number in range(options.rounds):
        surface = smoothed(height, options.jump_steps)
        offsets = FIRST_OFFSETS if number == 0 else LATER_OFFSETS
        groups = 2 if number == options.rounds - 1 else 1
        profiles = np.empty((groups, len(offsets), *coarse.shape), np.float32)
        tile_profile(
            coefficients.pixels, coefficients.layout, coefficients.nodes, coefficients.heights,
            np.pad(surface, half, mode="edge"), offsets, coefficients.block, half, seen, np.float32(0.0), profiles,
        )  # fmt: skip
        profile = profiles[0] if groups == 1 else profiles.sum(axis=0)
        found, best, inside = parabola_peak(profile, offsets)
        if groups > 1:
            middle = slice(len(offsets) // 2 - 1, len(offsets) // 2 + 2)
            spacing = offsets[1] - offsets[0]
            bend, apart = bend_at_centre(profile[middle], spacing), peaks_apart(profiles[:, middle], spacing)
        found += surface
        is_refined = inside & (np.abs(found - coarse) < options.reach_steps)
        height = np.where(is_refined if fixed is None else is_refined & ~fixed, found, height)
    return RefinedHeights(height, best, is_refined, surface, bend, apart, (2 * half + 1) ** 2)


def default_window(step_cells: float) -> int:
    """Side of the window where none is asked for.

    With a narrow base a step is many cells high and relief within a window a small part of it: noise rules and a large
    window averages it. With a wide base relief rules, and a large window smooths it away.
    """
    return WIDE_WINDOW if step_cells > NARROW_BASE else NARROW_WINDOW


def parabola_peak(profile: NDArray[np.float32], offsets: FloatGrid) -> tuple[FloatGrid, FloatGrid, NDArray[np.bool_]]:
    """Position and value of the maximum of equally spaced samples (j, r, c), and whether it is not an end sample."""
    shape = profile.shape[1:]
    position, value, is_inside = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_)
    columns = np.ascontiguousarray(profile).reshape(len(profile), -1)
    profile_peaks(columns, offsets, position.ravel(), value.ravel(), is_inside.ravel())
    return position, value, is_inside


def bend_at_centre(profile: NDArray[np.float32], spacing: np.float32) -> FloatGrid:
    """Curvature per step squared of three samples (3, r, c) at a spacing in steps, 0 where they have no peak. (r, c)"""
    bend = (2 * profile[1] - profile[0] - profile[2]) / spacing**2
    return np.asarray(np.maximum(bend, 0), np.float32)


def peaks_apart(profiles: NDArray[np.float32], spacing: np.float32) -> FloatGrid:
    """Distance in steps, at most FARTHEST_APART, of the vertices of two groups' parabolas, through three samples (2, 3,
    r, c) at a spacing in steps; NaN where a group has no peak. (r, c)"""
    bend = 2 * profiles[:, 1] - profiles[:, 0] - profiles[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = np.where(bend > LEAST_BEND, (profiles[:, 2] - profiles[:, 0]) / (2 * bend), np.float32(np.nan))
    apart = np.abs(vertex[0] - vertex[1]) * spacing
    return np.asarray(np.minimum(apart, FARTHEST_APART), np.float32)
