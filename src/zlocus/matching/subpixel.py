"""Sub-step heights: the correlation at fractions of a step around a smooth surface, which the windows follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import RefineOptions
from zlocus.matching.height_lattice import NARROW_BASE_STEP_CELLS
from zlocus.matching.kernels.shared_records import ViewArrays, VisibleHeights
from zlocus.matching.kernels.smooth import slopes, smooth_surface
from zlocus.matching.kernels.subpixel import (
    CUBIC,
    LINEAR,
    ProfileSampling,
    profile_peaks,
    tile_profile,
    vertex_distances,
)
from zlocus.matching.occlusion import n_seeing
from zlocus.matching.tile_views import TileViews

FloatGrid = NDArray[np.float32]
# Heights of the samples around the surface, in steps: far apart in the first round, then three close to the peak.
FIRST_OFFSETS = np.linspace(-1.0, 1.0, 3, dtype=np.float32)
LATER_OFFSETS = np.linspace(-0.5, 0.5, 3, dtype=np.float32)
# Factor of the variance of a peak by `peak_variance`, which does not include what disturbs several images alike.
NOISE_FACTOR = 2.5
# Largest relief within a window; heights that differ more come from another peak.
MAX_RELIEF_STEPS = np.float32(0.5)
# Side of the window in which the spread of heights about the smooth surface is computed.
SPREAD_CELLS = 15
# Distances of the cells of a smoothing pass, and over which slopes are computed.
SMOOTHING_SPACINGS_CELLS, SLOPE_DISTANCE_CELLS = (1, 2, 4), 8
# Sides of the correlation window for narrow and wide bases.
NARROW_BASE_WINDOW_CELLS, WIDE_BASE_WINDOW_CELLS = 9, 7
# Largest distance of the peaks of two groups of image pairs that is told apart; curvature below which there is no peak.
MAX_GROUP_DISTANCE_STEPS, MIN_CURVATURE = np.float32(3.0), np.float32(1e-6)
# Limits in `peak_variance`: curvature of a peak per step squared, and 1 - NCC.
MIN_PEAK_CURVATURE, MIN_DECORRELATION = np.float32(1e-3), np.float32(1e-3)


@dataclass(frozen=True)
class RefinedHeights:
    """Sub-step heights and the shape of the correlation around them, all (r, c).

    height : float32 height indices; ncc : float32, mean NCC there; is_refined : bool, False where the semi-global
    height was kept; smooth : float32 height indices, the surface that the last windows followed; curvature : float32,
    of the correlation peak per step squared, 0 where there is none; group_distance : float32 steps, distance between
    the peaks of two groups of image pairs, NaN where a group has none; variance : float32 steps squared, see
    `peak_variance`; is_fixed : bool, cells whose heights were not to be changed.
    """

    height: FloatGrid
    ncc: FloatGrid
    is_refined: NDArray[np.bool_]
    smooth: FloatGrid
    curvature: FloatGrid
    group_distance: FloatGrid
    variance: FloatGrid
    is_fixed: NDArray[np.bool_]


class ProfilePeaks(NamedTuple):
    """Peaks of correlation profiles, all (r, c).

    position : float32, height above the surface in steps; value : float32, NCC there; is_inside : bool, whether the
    peak lies between the first and the last sample.
    """

    position: FloatGrid
    value: FloatGrid
    is_inside: NDArray[np.bool_]


class MeasuredDistances(NamedTuple):
    """distance : (r, c) float32 steps, from a smooth surface; variance : (r, c) float32 steps squared, of its noise."""

    distance: FloatGrid
    variance: FloatGrid


def smoothed(surface: FloatGrid, jump_steps: float) -> FloatGrid:
    """Smooth surface (r, c): the median, then means along the slope that do not reach across jumps."""
    out = np.asarray(cv2.medianBlur(np.ascontiguousarray(surface), 5), np.float32)
    by_row, by_col = np.empty_like(out), np.empty_like(out)
    for spacing in SMOOTHING_SPACINGS_CELLS:
        slopes(out, SLOPE_DISTANCE_CELLS, by_row, by_col)
        smooth = np.empty_like(out)
        smooth_surface(out, by_row, by_col, spacing, np.float32(jump_steps), smooth)
        out = smooth
    return out


def refine(
    tile_views: TileViews,
    coefficients: NDArray[np.float32],
    coarse: FloatGrid,
    visible: VisibleHeights,
    step_cells: float,
    options: RefineOptions,
    is_fixed: NDArray[np.bool_] | None = None,
) -> RefinedHeights:
    """Refine the height indices `coarse` (r, c) float32 to fractions of a step.

    Each round smooths the surface, computes the mean NCC at a few fractions of a step around it, and takes the maximum
    of the parabola through the samples. The surface is smoothed because windows that follow a noisy surface would show
    a different place in each image. Linear interpolation of the images is enough for all rounds but the last. A refined
    height that is more than `max_correction_steps` from the semi-global height is rejected. In the last round the noise
    of the result is reduced: first by what wide windows find beside narrow ones (see `combined_windows`), then towards
    the smooth surface (see `lee_filtered`).

    coefficients : (p,) cubic B-spline coefficients, arranged as the pixels of `tile_views`; visible : see `occlusion`;
    step_cells : height step divided by the side of a cell; is_fixed : (r, c), cells whose correlation is computed like
    that of the others, but whose heights stay.
    """
    is_fixed = np.zeros(coarse.shape, np.bool_) if is_fixed is None else is_fixed
    half = (options.window or default_window(step_cells)) // 2
    height, is_refined = coarse.astype(np.float32), np.zeros(coarse.shape, bool)
    surface, ncc, curvature = height, np.zeros(coarse.shape, np.float32), np.zeros(coarse.shape, np.float32)
    group_distance, variance = np.full(coarse.shape, np.nan, np.float32), np.ones(coarse.shape, np.float32)
    for number in range(options.rounds):
        surface, is_last = smoothed(height, options.jump_steps), number == options.rounds - 1
        sampling = _sampling(half, number == 0, is_last)
        arrays = tile_views.arrays._replace(pixels=coefficients) if is_last else tile_views.arrays
        profiles = profiles_around(arrays, surface, sampling, 2 if is_last else 1, visible)
        profile = profiles[-1].sum(axis=0)
        peaks = parabola_peaks(profile, sampling.offsets)
        distance, ncc = peaks.position, peaks.value
        is_refined = peaks.is_inside & (np.abs(distance + surface - coarse) < options.max_correction_steps)
        if is_last:
            spacing = sampling.offsets[1] - sampling.offsets[0]
            curvature = curvature_at_centre(profile, spacing)
            group_distance = group_distances(profiles[-1], spacing)
            n_images = n_seeing(visible, surface)
            variance = peak_variance(ncc, curvature, n_images, (2 * half + 1) ** 2)
            wide = MeasuredDistances(distance, variance)
            reduced = _with_narrow_window(wide, profiles[:-1].sum(axis=1), sampling, n_images, is_refined)
            distance = lee_filtered(reduced.distance, is_refined, reduced.variance)
        height = np.where(is_refined & ~is_fixed, distance + surface, height)
    return RefinedHeights(height, ncc, is_refined, surface, curvature, group_distance, variance, is_fixed)


def _sampling(half: int, is_first: bool, is_last: bool) -> ProfileSampling:
    """How a round samples the correlation. half : half width of the window; the last round has a narrower one too."""
    return ProfileSampling(
        degree=CUBIC if is_last else LINEAR,
        offsets=FIRST_OFFSETS if is_first else LATER_OFFSETS,
        windows=np.unique([(half + 1) // 2, half]) if is_last else np.array([half]),
        noise_variance=np.float32(0.0),
    )


def profiles_around(
    view_arrays: ViewArrays, surface: FloatGrid, sampling: ProfileSampling, n_groups: int, visible: VisibleHeights
) -> NDArray[np.float32]:
    """Correlation around a surface (r, c): (w, g, j, r, c) by window, group of image pairs and offset.

    The sum over the groups is the mean NCC over all pairs.
    """
    profiles = np.empty((len(sampling.windows), n_groups, len(sampling.offsets), *surface.shape), np.float32)
    tile_profile(view_arrays, np.pad(surface, int(sampling.windows[-1]), mode="edge"), sampling, visible, profiles)
    return profiles


def _with_narrow_window(
    wide: MeasuredDistances,
    profiles: NDArray[np.float32],
    sampling: ProfileSampling,
    n_images: NDArray[np.integer],
    is_refined: NDArray[np.bool_],
) -> MeasuredDistances:
    """Distances of wide windows combined with those of the narrower window, where the sampling has one.

    profiles : (w - 1, j, r, c), of the narrower window and all pairs; n_images, is_refined : (r, c).
    """
    result, spacing = wide, sampling.offsets[1] - sampling.offsets[0]
    for window, profile in zip(sampling.windows[:-1], profiles, strict=True):
        peaks = parabola_peaks(profile, sampling.offsets)
        curvature = curvature_at_centre(profile, spacing)
        variance = peak_variance(peaks.value, curvature, n_images, (2 * int(window) + 1) ** 2)
        result = combined_windows(wide, MeasuredDistances(peaks.position, variance), is_refined & peaks.is_inside)
    return result


def peak_variance(ncc: FloatGrid, curvature: FloatGrid, n_images: NDArray[np.integer], window_cells: int) -> FloatGrid:
    """Variance of the position of a correlation peak, (r, c) steps squared.

    See `zlocus.matching.match_curve.predicted_sigma`. window_cells : number of cells of the window.
    """
    noise = 2 * np.maximum(1 - ncc, MIN_DECORRELATION)
    images = np.maximum(n_images, 1).astype(np.float32)
    return np.asarray(noise / (np.maximum(curvature, MIN_PEAK_CURVATURE) * window_cells * images), np.float32)


def combined_windows(wide: MeasuredDistances, narrow: MeasuredDistances, known: NDArray[np.bool_]) -> MeasuredDistances:
    """Distances of wide windows with the relief that narrow windows find beside them.

    The difference of the two is multiplied by the share of its spread that is not noise. known : (r, c), cells where
    both are valid. Narrow windows lie within wide ones and share their noise, so the variance of the difference is the
    difference of the variances. Source: as for `lee_filtered`.
    """
    difference = narrow.distance - wide.distance
    relief = np.where(known & (np.abs(difference) < MAX_RELIEF_STEPS), difference, np.float32(0.0))
    added = np.maximum(narrow.variance - wide.variance, np.float32(0.0))
    share_known = np.maximum(_mean_around(known.astype(np.float32)), np.float32(1e-3))
    noise = _mean_around(np.where(known, added, np.float32(0.0))) / share_known
    spread = _mean_around(relief * relief) / share_known
    share = np.clip(1 - np.float32(NOISE_FACTOR) * noise / np.maximum(spread, np.float32(1e-9)), 0, 1)
    variance = wide.variance + np.where(known, share * share * added, np.float32(0.0))
    return MeasuredDistances(
        np.asarray(wide.distance + share * relief, np.float32), np.asarray(variance, np.float32)
    )  # fmt: skip


def lee_filtered(distance: FloatGrid, known: NDArray[np.bool_], variance: FloatGrid) -> FloatGrid:
    """Distances (r, c) from a smooth surface with less noise: the mean around the cell, plus the difference from it
    multiplied by the share of the spread that is not noise.

    known : (r, c), cells whose distances count; variance : (r, c), of their noise. Source: Lee (1980), "Digital image
    enhancement and noise filtering by use of local statistics", equation 9.
    """
    share = np.maximum(_mean_around(known.astype(np.float32)), np.float32(1e-3))
    counted = np.where(known, distance, np.float32(0.0))
    mean = _mean_around(counted) / share
    spread = _mean_around(counted * counted) / share - mean * mean
    signal = 1 - np.float32(NOISE_FACTOR) * variance / np.maximum(spread, np.float32(1e-9))
    return np.asarray(mean + (distance - mean) * np.clip(signal, 0, 1), np.float32)


def _mean_around(values: FloatGrid) -> FloatGrid:
    """Means over `SPREAD_CELLS` around every cell."""
    return np.asarray(cv2.blur(values, (SPREAD_CELLS, SPREAD_CELLS), borderType=cv2.BORDER_REFLECT), np.float32)


def default_window(step_cells: float) -> int:
    """Side of the correlation window where the option is unset, in cells.

    With a narrow base a height step is many cells high, and the relief within a window is a small part of a step: noise
    prevails, and a large window averages it. With a wide base relief prevails, and a large window smooths it away.
    """
    return NARROW_BASE_WINDOW_CELLS if step_cells > NARROW_BASE_STEP_CELLS else WIDE_BASE_WINDOW_CELLS


def parabola_peaks(profile: NDArray[np.float32], offsets: FloatGrid) -> ProfilePeaks:
    """Maxima of equally spaced samples (j, r, c), by the parabola through the three around the largest one; j >= 3."""
    shape = profile.shape[1:]
    position, value, is_inside = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_)
    columns = np.ascontiguousarray(profile).reshape(len(profile), -1)
    profile_peaks(columns, offsets, position.ravel(), value.ravel(), is_inside.ravel())
    return ProfilePeaks(position, value, is_inside)


def curvature_at_centre(profile: NDArray[np.float32], spacing: np.float32) -> FloatGrid:
    """Curvature (r, c) per step squared of three samples (3, r, c), `spacing` steps apart; 0 where there is no peak."""
    curvature = (2 * profile[1] - profile[0] - profile[2]) / spacing**2
    return np.asarray(np.maximum(curvature, 0), np.float32)


def group_distances(profiles: NDArray[np.float32], spacing: np.float32) -> FloatGrid:
    """Distance between the peaks of two groups of image pairs, (r, c) steps; NaN where a group has no peak.

    The peaks are vertices of parabolas through three samples (2, 3, r, c), `spacing` steps apart. Distances are at most
    MAX_GROUP_DISTANCE_STEPS.
    """
    difference, columns = np.empty(profiles.shape[2:], np.float32), np.ascontiguousarray(profiles).reshape(2, 3, -1)
    vertex_distances(columns, spacing, MIN_CURVATURE, MAX_GROUP_DISTANCE_STEPS, difference.ravel())
    return difference
