"""Shift adjustment: one shift per image, solved robustly together with the ground points of the ties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import OrientationOptions
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.triangulate import GroundPoints, Observations, point_covariance, summed, triangulate

MAX_ITERATIONS = 15
TOLERANCE_PX = 1e-3
HUBER_SIGMAS = 1.5
OUTLIER_SIGMAS = 4.0
MIN_SIGMA_PX = 0.02
# Ties determine a direction of the shifts if its normalised information exceeds this value over the number of images
# squared. Two images whose epipolar curves differ by less than 3 degrees then do not determine the shift along them,
# while the slow bends of a long chain of n images, whose information falls as 5 / n**2, are kept.
MIN_SHIFT_INFORMATION = 0.01
# Shifts that look like a translation of the ground, and differ from the undetermined directions by more than this sine,
# need the information that is required of two images, however many there are: no chain of images adds any to them.
APART_SINE = 0.5
# Where it is decided which images keep their place: shifts below this size count as none, the number of rounds of the
# reweighted least squares, and the number of images that are left out in turn.
NO_SHIFT_PX, MAJORITY_ROUNDS, MAX_SUSPECTS = 1.0, 30, 12


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment: the shifts of the images, and the ties that were kept.

    shift_px : (i, 2) column and row to add to what each model projects; n_determined: how many of the 2 i components
    the ties show, the rest stay at zero; observations, ground_points: the ties kept and their ground points with the
    shifts; before_px : (m, 2) residuals of those ties with the models as delivered; numbers : (n,) which of the ties
    given are kept.
    """

    shift_px: FloatArray
    n_determined: int
    observations: Observations
    ground_points: GroundPoints
    before_px: FloatArray
    numbers: NDArray[np.int64]

    @property
    def after_px(self) -> FloatArray:
        """Residuals (m, 2) px of the kept ties, with the shifts applied."""
        return self.ground_points.residual


def adjust(
    sensors: Sequence[SensorModel], observations: Observations, xyz: FloatArray, options: OrientationOptions
) -> Adjustment:
    """Shifts of all images that make the rays of the ties meet, by least squares with Huber's loss.

    xyz : (n, 3) m, first ground points. Observations whose residual exceeds 4 sigma (and `inlier_px`) are dropped, then
    everything is solved again. With `model` "none" the shifts stay zero.
    """
    shift, n_determined = np.zeros((len(sensors), 2)), 0
    for _ in range(2):
        if options.model != "none":
            shift, n_determined = solve_shifts(sensors, observations, xyz, options.sigma_shift_px, shift)
        ground_points = triangulate(sensors, without_shifts(observations, shift), xyz)
        observations, xyz = without_outliers(observations, ground_points, options.inlier_px), ground_points.xyz
    numbers = np.unique(observations.point)
    observations, xyz = renumbered(observations, xyz)
    ground_points = triangulate(sensors, without_shifts(observations, shift), xyz)
    before = triangulate(sensors, observations, ground_points.xyz, by_ground=ground_points.by_ground)
    return Adjustment(shift, n_determined, observations, ground_points, before.residual, numbers)


def with_most_images_in_place(
    sensors: Sequence[SensorModel], adjustment: Adjustment, options: OrientationOptions
) -> Adjustment:
    """The adjustment after a common translation of the ground that leaves most images where they were.

    Ties do not determine that translation. While all errors are a few pixels, the smallest sum of squared shifts is a
    good choice. But one image that is far off would pull the ground, and with it all other images, a part of the way.
    So the sum of the logarithms of the shifts' lengths is minimised instead, which prefers few large shifts to many
    small ones. It is minimised by iteratively reweighted least squares, started without each of the images that moved
    most in turn.
    """
    n_views = len(adjustment.shift_px)
    tied = np.bincount(adjustment.observations.view, minlength=n_views) > 0
    basis = translations(
        adjustment.observations, adjustment.ground_points, np.ones(len(adjustment.observations)), n_views
    )
    candidates = [
        shifts_with_most_images_in_place(adjustment.shift_px, basis, tied, suspect)
        for suspect in _farthest_moved(adjustment.shift_px, tied)
    ]
    shift_px = min(candidates, key=lambda shift: _sum_of_logarithms(shift[tied]))
    ground_points = triangulate(
        sensors, without_shifts(adjustment.observations, shift_px), adjustment.ground_points.xyz
    )
    # A translation is not exactly a shift of every image, so the rest is solved for.
    shift_px, _ = solve_shifts(sensors, adjustment.observations, ground_points.xyz, options.sigma_shift_px, shift_px)
    ground_points = triangulate(sensors, without_shifts(adjustment.observations, shift_px), ground_points.xyz)
    before = triangulate(sensors, adjustment.observations, ground_points.xyz, by_ground=ground_points.by_ground)
    return Adjustment(
        shift_px, adjustment.n_determined, adjustment.observations, ground_points, before.residual, adjustment.numbers
    )


def shifts_with_most_images_in_place(
    shift_px: FloatArray, basis: FloatArray, tied: NDArray[np.bool_], suspect: int
) -> FloatArray:
    """Shifts (i, 2) px plus the translation that leaves most images where they were.

    shift_px : (i, 2), the shifts before; basis : (2 i, k), see `translations`; tied : (i,) bool, images that count;
    suspect : number of an image that does not count in the first round.
    """
    start, weight = shift_px.ravel(), np.where(np.arange(len(tied)) == suspect, 0.0, tied.astype(float))
    moved_shift = shift_px
    for _ in range(MAJORITY_ROUNDS):
        of_row = np.repeat(weight, 2)[:, None]
        step = np.linalg.lstsq(basis.T @ (of_row * basis), basis.T @ (of_row[:, 0] * start), rcond=1e-9)[0]
        moved_shift = (start - basis @ step).reshape(-1, 2)
        weight = tied / ((moved_shift**2).sum(axis=1) + NO_SHIFT_PX**2)
    return np.where(tied[:, None], moved_shift, 0.0)


def _farthest_moved(shift_px: FloatArray, tied: NDArray[np.bool_]) -> list[int]:
    """Numbers of the tied images that were moved farthest, at most `MAX_SUSPECTS`."""
    order = np.argsort(-np.hypot(*shift_px.T), kind="stable")
    return [int(number) for number in order if tied[number]][:MAX_SUSPECTS]


def _sum_of_logarithms(shift_px: FloatArray) -> float:
    return float(np.log((shift_px**2).sum(axis=1) + NO_SHIFT_PX**2).sum())


def solve_shifts(
    sensors: Sequence[SensorModel],
    observations: Observations,
    xyz: FloatArray,
    sigma_shift_px: float,
    shift: FloatArray,
) -> tuple[FloatArray, int]:
    """Robust shifts (i, 2) px, and the number of their directions that the ties determine.

    xyz : (n, 3) m, first ground points; shift : (i, 2) px, first shifts.

    Iteratively reweighted least squares: every round triangulates with the present shifts and weights, then eliminates
    the ground points from the normal equations (Schur complement) and solves for the shifts alone.
    """
    weight, by_ground, n_determined = np.ones(len(observations)), None, 0
    for _ in range(MAX_ITERATIONS):
        ground_points = triangulate(sensors, without_shifts(observations, shift), xyz, weight, by_ground)
        sigma = robust_sigma(ground_points.residual)
        weight = huber_weight(ground_points.residual, sigma)
        normal, pull = reduced_normal_equations(observations, ground_points, weight, len(sensors))
        information = normal / sigma**2 + np.eye(len(normal)) / sigma_shift_px**2
        of_views = np.bincount(observations.view, weight, len(sensors)).astype(float)
        basis = determined_directions(normal, of_views, translations(observations, ground_points, weight, len(sensors)))
        right = basis.T @ (pull / sigma**2 - shift.ravel() / sigma_shift_px**2)
        step = basis @ np.linalg.solve(basis.T @ information @ basis, right)
        shift, n_determined, xyz = shift + step.reshape(-1, 2), basis.shape[1], ground_points.xyz
        by_ground = ground_points.by_ground
        if np.abs(step).max(initial=0.0) < TOLERANCE_PX:
            break
    return shift, n_determined


def reduced_normal_equations(
    observations: Observations, ground_points: GroundPoints, weight: FloatArray, n_views: int
) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (2 i, 2 i) and right side (2 i,) of the shifts once the ground points are eliminated.

    With A the shifts' block, E the shifts-by-points block and C the points' block: A - E C^-1 E^T.
    """
    usable = np.isfinite(ground_points.residual).all(axis=1) & np.isfinite(ground_points.xyz[observations.point, 0])
    weight = np.where(usable, weight, 0.0)
    by_ground = np.where(usable[:, None, None], ground_points.by_ground, 0.0)
    residual = np.where(usable[:, None], ground_points.residual, 0.0)
    n_points = len(ground_points.xyz)
    covariance = np.nan_to_num(point_covariance(by_ground, weight, observations.point, n_points))
    mixed = by_ground * weight[:, None, None]
    own = np.repeat(np.bincount(observations.view, weight, n_views), 2)
    pull = summed(residual * weight[:, None], observations.view, n_views)
    pull_of_points = summed(np.einsum("mji,mj->mi", mixed, residual), observations.point, n_points)
    solved = np.einsum("nij,nj->ni", covariance, pull_of_points)
    explained = summed(np.einsum("mji,mi->mj", mixed, solved[observations.point]), observations.view, n_views)
    return np.diag(own) - between_views(observations, mixed, covariance, n_views), (pull - explained).ravel()


def between_views(observations: Observations, mixed: FloatArray, covariance: FloatArray, n_views: int) -> FloatArray:
    """The product E C^-1 E^T (2 i, 2 i), which links views through the points that they share.

    mixed : (m, 2, 3), the blocks of E; covariance : (n, 3, 3), the blocks of C^-1. Every observation of a point meets
    every other, so the work grows with the number of points.
    """
    order = np.argsort(observations.point, kind="stable")
    point, view, mixed = observations.point[order], observations.view[order], mixed[order]
    most = int(np.bincount(point, minlength=1).max())
    total = np.zeros((2, 2, n_views * n_views))
    for lag in range(most):
        one = np.flatnonzero(point[: len(point) - lag] == point[lag:])
        other = one + lag
        blocks = np.einsum("kai,kij,kbj->abk", mixed[one], covariance[point[one]], mixed[other], optimize=True)
        where = view[one] * n_views + view[other]
        turned = view[other] * n_views + view[one]
        for a, b in np.ndindex(2, 2):
            total[a, b] += np.bincount(where, blocks[a, b], n_views * n_views)
            if lag:
                total[b, a] += np.bincount(turned, blocks[a, b], n_views * n_views)
    return total.reshape(2, 2, n_views, n_views).transpose(2, 0, 3, 1).reshape(2 * n_views, 2 * n_views)


def translations(
    observations: Observations, ground_points: GroundPoints, weight: FloatArray, n_views: int
) -> FloatArray:
    """Orthonormal basis (2 i, k) of the shifts that a common translation of the ground looks like, k at most 3."""
    usable = np.asarray(np.isfinite(ground_points.by_ground).all(axis=(1, 2)))
    by_ground = np.where(usable[:, None, None], ground_points.by_ground * weight[:, None, None], 0.0)
    total = summed(by_ground.reshape(-1, 6), observations.view, n_views)
    mean = total / np.maximum(np.bincount(observations.view, weight * usable, n_views), 1e-12)[:, None]
    left, size, _ = np.linalg.svd(mean.reshape(2 * n_views, 3), full_matrices=False)
    n_determined = int((size > 1e-6 * max(float(size[0]), 1e-12)).sum())
    return np.asarray(left)[:, :n_determined]


def determined_directions(normal: FloatArray, weight_of_view: FloatArray, translated: FloatArray) -> FloatArray:
    """Orthonormal basis (2 i, k) of the shifts that ties can distinguish from a change of the ground.

    normal : (2 i, 2 i); weight_of_view : (i,); translated : see `translations`. Information is judged per observation,
    so that an image with few ties counts like one with many. Undetermined shifts stay exactly zero: those of a
    translation of the ground, for two images the shift along their epipolar curves, and those of images without ties.
    Where sensors of several kinds are mixed, a translation changes the scales of their images by different amounts,
    which determines a height to a decimetre or so. The cameras determine it better, so the translation stays zero.
    """
    scale = np.repeat(np.sqrt(weight_of_view), 2)
    linked = scale > 0.0
    inverse = np.where(linked, 1.0 / np.where(linked, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(normal * inverse[:, None] * inverse)
    n_views = max(int((weight_of_view > 0.0).sum()), 1)
    undetermined = vectors[:, values < MIN_SHIFT_INFORMATION / n_views**2]
    excluded = np.where(linked[:, None], undetermined * inverse[:, None], undetermined)
    left, _, _ = np.linalg.svd(excluded, full_matrices=True)
    known = left[:, : excluded.shape[1]]
    apart, sine, _ = np.linalg.svd(translated - known @ (known.T @ translated), full_matrices=False)
    scaled = apart * scale[:, None]
    information = np.einsum("ik,ij,jk->k", apart, normal, apart) / np.maximum((scaled**2).sum(axis=0), 1e-12)
    is_doubtful = (np.asarray(sine) > APART_SINE) & (information < MIN_SHIFT_INFORMATION / 2**2)
    if is_doubtful.any():
        excluded = np.column_stack([known, apart[:, is_doubtful]])
        left, _, _ = np.linalg.svd(excluded, full_matrices=True)
    return np.where(linked[:, None], left[:, excluded.shape[1] :], 0.0)


def without_shifts(observations: Observations, shift: FloatArray) -> Observations:
    """Observations with the shifts (i, 2) px of their images subtracted, as the uncorrected models project them."""
    return Observations(observations.view, observations.point, observations.xy - shift[observations.view])


def robust_sigma(residual: FloatArray) -> float:
    """Noise of one coordinate (px) from residuals (m, 2): the median length of Gaussian residuals is 1.18 sigma."""
    length = np.hypot(*residual.T)
    length = length[np.isfinite(length)]
    return max(float(np.median(length)) / 1.1774 if len(length) else 0.0, MIN_SIGMA_PX)


def huber_weight(residual: FloatArray, sigma: float) -> FloatArray:
    """Weights (m,) of Huber's loss for residuals (m, 2) px; 0 where a residual is not finite."""
    length = np.hypot(*residual.T)
    weight = HUBER_SIGMAS * sigma / np.maximum(length, HUBER_SIGMAS * sigma)
    return np.where(np.isfinite(length), weight, 0.0)


def without_outliers(observations: Observations, ground_points: GroundPoints, inlier_px: float) -> Observations:
    """Observations with small residuals, of ties that keep two images or more.

    The limit is 4 sigma, or `inlier_px` where that is larger.
    """
    length = np.hypot(*ground_points.residual.T)
    limit = max(OUTLIER_SIGMAS * robust_sigma(ground_points.residual), inlier_px)
    keep = length <= limit
    keep &= np.bincount(observations.point[keep], minlength=len(ground_points.xyz))[observations.point] >= 2
    return observations.kept(keep)


def renumbered(observations: Observations, xyz: FloatArray) -> tuple[Observations, FloatArray]:
    """Observations and ground points (n, 3) of the points that are observed, numbered without gaps."""
    used, point = np.unique(observations.point, return_inverse=True)
    return Observations(observations.view, point, observations.xy), xyz[used]
