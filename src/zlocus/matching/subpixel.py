"""Sub-step heights: the measure itself, a few fractions of a step around a smooth surface that the windows follow."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import RefineOptions
from zlocus.matching.height_lattice import NARROW_BASE_STEP_CELLS
from zlocus.matching.kernels.smooth import slopes, smooth_surface
from zlocus.matching.kernels.subpixel import CUBIC, LINEAR, profile_peaks, tile_profile, vertices_apart
from zlocus.matching.occlusion import n_seeing
from zlocus.matching.tile_views import TileViews

FloatGrid = NDArray[np.float32]
# Heights measured around the surface, in steps: wide in the first round, then three beside the peak.
FIRST_OFFSETS = np.linspace(-1.0, 1.0, 3, dtype=np.float32)
LATER_OFFSETS = np.linspace(-0.5, 0.5, 3, dtype=np.float32)
# Of a peak's variance by `peak_variance`, which knows nothing of what disturbs several images alike.
NOISE_FACTOR = 2.5
LARGEST_RELIEF = np.float32(0.5)  # steps within a window
SPREAD_CELLS = 15  # around a cell, over which heights spread about the smooth surface
SPACINGS = (1, 2, 4)
SLOPE_REACH = 8
WIDE_WINDOW, NARROW_WINDOW = 9, 7
FARTHEST_APART, LEAST_BEND = np.float32(3.0), np.float32(1e-6)
LEAST_PEAK, LEAST_NOISE = np.float32(1e-3), np.float32(1e-3)  # bend per step squared; 1 - NCC


@dataclass(frozen=True)
class RefinedHeights:
    """Sub-step heights and what the measure looks like around them, all (r, c).

    height : float32 height indices; ncc : float32, the measure there; is_refined : bool, False where the semi-global
    height was kept; smooth : float32 height indices, the surface that the last windows followed; bend : float32,
    curvature of the measure per step squared, 0 where it has no peak; apart : float32 steps, distance of the peaks of
    two groups of pairs of views, NaN where a group has none; variance : float32 steps squared, see `peak_variance`;
    is_fixed : bool, cells that kept their heights because they were told to.
    """

    height: FloatGrid
    ncc: FloatGrid
    is_refined: NDArray[np.bool_]
    smooth: FloatGrid
    bend: FloatGrid
    apart: FloatGrid
    variance: FloatGrid
    is_fixed: NDArray[np.bool_]


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
    views: TileViews,
    coefficients: NDArray[np.float32],
    coarse: FloatGrid,
    seen: NDArray[np.int32],
    step_cells: float,
    options: RefineOptions,
    fixed: NDArray[np.bool_] | None = None,
) -> RefinedHeights:
    """Refine height indices `coarse` (r, c) float32.

    coefficients : of cubic B-splines, as `views` has pixels. Each round smooths the surface, measures the mean NCC at a
    few fractions of a step around it and puts a parabola through the best three: linear values of the images will do
    for all rounds but the last. Windows that follow a noisy surface would see a different place in each image, hence
    the smoothing; a refined height further than `max_correction_steps` from the semi-global one is not believed. What the last
    round finds counts by how much of it is noise: what narrow windows find beside wide ones (see `refined_ties`), then
    what either finds beside the smooth surface (see `weighed`). step_cells : height of a step over the side of a
    cell; fixed : (r, c), cells that are measured like the others and keep their heights.
    """
    fixed = np.zeros(coarse.shape, np.bool_) if fixed is None else fixed
    half = (options.window or default_window(step_cells)) // 2
    height, is_refined = coarse.astype(np.float32), np.zeros(coarse.shape, bool)
    surface, best, bend = height, np.zeros(coarse.shape, np.float32), np.zeros(coarse.shape, np.float32)
    apart, variance = np.full(coarse.shape, np.nan, np.float32), np.ones(coarse.shape, np.float32)
    for number in range(options.rounds):
        surface, is_last = smoothed(height, options.jump_steps), number == options.rounds - 1
        offsets = FIRST_OFFSETS if number == 0 else LATER_OFFSETS
        windows = np.unique([(half + 1) // 2, half]) if is_last else np.array([half])
        profiles = np.empty((len(windows), 2 if is_last else 1, len(offsets), *coarse.shape), np.float32)
        values, degree = (coefficients, CUBIC) if is_last else (views.pixels, LINEAR)
        tile_profile(
            values, degree, views.layout, views.nodes, views.heights, np.pad(surface, half, mode="edge"), offsets,
            views.block, windows, seen, np.float32(0.0), profiles,
        )  # fmt: skip
        profile, spacing = profiles[-1].sum(axis=0), offsets[1] - offsets[0]
        found, best, inside = parabola_peak(profile, offsets)
        is_refined = inside & (np.abs(found + surface - coarse) < options.max_correction_steps)
        if is_last:
            bend, apart = bend_at_centre(profile, spacing), peaks_apart(profiles[-1], spacing)
            seeing = n_seeing(seen, surface)
            variance = peak_variance(best, bend, seeing, (2 * half + 1) ** 2)
            noise = variance
            for window, narrow in zip(windows[:-1], profiles[:-1].sum(axis=1), strict=True):
                sharp, ncc, known = parabola_peak(narrow, offsets)
                of_sharp = peak_variance(ncc, bend_at_centre(narrow, spacing), seeing, (2 * int(window) + 1) ** 2)
                found, noise = refined_ties(found, variance, sharp, of_sharp, is_refined & known)
            found = weighed(found, is_refined, noise)
        height = np.where(is_refined & ~fixed, found + surface, height)
    return RefinedHeights(height, best, is_refined, surface, bend, apart, variance, fixed)


def peak_variance(ncc: FloatGrid, bend: FloatGrid, n_images: NDArray[np.integer], window_cells: int) -> FloatGrid:
    """Variance of the place of the measure's peak, steps squared: see `zlocus.matching.match_curve.predicted_sigma`."""
    noise = 2 * np.maximum(1 - ncc, LEAST_NOISE)
    images = np.maximum(n_images, 1).astype(np.float32)
    return np.asarray(noise / (np.maximum(bend, LEAST_PEAK) * window_cells * images), np.float32)


def refined_ties(
    wide: FloatGrid, variance: FloatGrid, narrow: FloatGrid, of_narrow: FloatGrid, known: NDArray[np.bool_]
) -> tuple[FloatGrid, FloatGrid]:
    """Distances (r, c) from a smooth surface as wide windows find them, with as much of what narrow ones find beside
    them as is relief: the share of the spread of their differences that is not noise. And the variance of both.

    variance, of_narrow : (r, c), of the noise of either; known : (r, c), where both are to be believed. Narrow windows
    lie in wide ones, whose noise they share: the variance of their difference is the difference of theirs. Source: as
    `weighed`.
    """
    beside = np.where(known & (np.abs(narrow - wide) < LARGEST_RELIEF), narrow - wide, np.float32(0.0))
    more = np.maximum(of_narrow - variance, np.float32(0.0))
    share_known = np.maximum(_around(known.astype(np.float32)), np.float32(1e-3))
    noise = _around(np.where(known, more, np.float32(0.0))) / share_known
    spread = _around(beside * beside) / share_known
    share = np.clip(1 - np.float32(NOISE_FACTOR) * noise / np.maximum(spread, np.float32(1e-9)), 0, 1)
    together = variance + np.where(known, share * share * more, np.float32(0.0))
    return np.asarray(wide + share * beside, np.float32), np.asarray(together, np.float32)


def weighed(away: FloatGrid, known: NDArray[np.bool_], variance: FloatGrid) -> FloatGrid:
    """Distances (r, c) from a smooth surface: their mean around the cell, and what they differ from it multiplied by
    the share of their spread that is not noise.

    known : (r, c), distances that count; variance : (r, c), of their noise. Source: Lee (1980), "Digital image
    enhancement and noise filtering by use of local statistics", equation 9.
    """
    share = np.maximum(_around(known.astype(np.float32)), np.float32(1e-3))
    counted = np.where(known, away, np.float32(0.0))
    mean = _around(counted) / share
    spread = _around(counted * counted) / share - mean * mean
    signal = 1 - np.float32(NOISE_FACTOR) * variance / np.maximum(spread, np.float32(1e-9))
    return np.asarray(mean + (away - mean) * np.clip(signal, 0, 1), np.float32)


def _around(values: FloatGrid) -> FloatGrid:
    """Means over `SPREAD_CELLS`."""
    return np.asarray(cv2.blur(values, (SPREAD_CELLS, SPREAD_CELLS), borderType=cv2.BORDER_REFLECT), np.float32)


def default_window(step_cells: float) -> int:
    """Side of the window where none is asked for.

    With a narrow base a step is many cells high and relief within a window a small part of it: noise rules and a large
    window averages it. With a wide base relief rules, and a large window smooths it away.
    """
    return WIDE_WINDOW if step_cells > NARROW_BASE_STEP_CELLS else NARROW_WINDOW


def parabola_peak(profile: NDArray[np.float32], offsets: FloatGrid) -> tuple[FloatGrid, FloatGrid, NDArray[np.bool_]]:
    """Position and value of the maximum of equally spaced samples (j, r, c), and whether it lies between them."""
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
    apart, columns = np.empty(profiles.shape[2:], np.float32), np.ascontiguousarray(profiles).reshape(2, 3, -1)
    vertices_apart(columns, spacing, LEAST_BEND, FARTHEST_APART, apart.ravel())
    return apart
