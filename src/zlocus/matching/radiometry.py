"""Grey values of all images on one scale, so that views with different exposures, or of different ground, compare."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.footprints import ground_box
from zlocus.core.scene import View, held_window

FloatArray = NDArray[np.float64]
SAMPLE_ROWS = 12  # rows of an image from which its mean and deviation are computed
# The grey value of a ground point is the mean over a square of this side, so that a pixel of shift matters little.
SQUARE_PX = 9
# Ground points whose grey values are compared (more where each view sees few of them); and the fewest points that a
# view must share to be compared at all.
MAX_POINTS, MIN_POINTS = 400, 30
# Squares that start in the same part of an image, of this side, are read at once: opening a file takes a millisecond.
PART_PX = 512
# Rounds of matching the scales, the first of them by medians; points that differ by more than so many sigma are left
# out.
ROUNDS, MEDIAN_ROUNDS, MAX_SIGMAS = 20, 3, 3.0
MAD_TO_SIGMA = 1.4826
# Sigma of the prior on the terms of a trend, in contrasts; and the share of the differences between views that a trend
# must explain. For satellites, rendered and real ones, it explains 0.15 or less, for images of a mapping camera 0.69.
TREND_SIGMA, TREND_ROUNDS, MIN_EXPLAINED_SHARE = 0.3, 5, 0.25
# A trend is at least this large, in contrasts: smaller ones do not matter.
MIN_TREND = 0.04
# Grey values are never more precise than this, in contrasts, so that the prior keeps chosen weight.
MIN_NOISE = 1e-3
N_TERMS = 5
RELATIVE_TOLERANCE = 1e-7  # of the conjugate gradients
STEPS_PER_UNKNOWN = 10  # of the conjugate gradients, at most


@dataclass(frozen=True)
class GreyTrend:
    """Grey values that the lens and the sun add to an image, different from side to side: a quadratic polynomial.

    shape : rows and columns of the image; terms : grey values, coefficients of u, v, u^2, u v, v^2, where u and v are
    the column and row from the image's centre, divided by half its larger side.
    """

    shape: tuple[int, int]
    terms: tuple[float, ...]

    def window(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """Grey values (rows, cols) float32 in a window of the image that starts at (row, col)."""
        u, v = unit_position(self.shape, np.arange(col, col + cols), np.arange(row, row + rows))
        a, b, c, d, e = self.terms
        of_col, of_row = np.asarray((a + c * u) * u, np.float32), np.asarray((b + e * v) * v, np.float32)
        trend = np.asarray(d * v, np.float32)[:, None] * np.asarray(u, np.float32)
        trend += of_col
        trend += of_row[:, None]
        return trend


@dataclass(frozen=True)
class GreyScale:
    """How grey values of an image are scaled: (grey - trend - mean) / contrast. trend : None is 0 everywhere."""

    mean: float
    contrast: float
    trend: GreyTrend | None = None


@dataclass(frozen=True)
class Greys:
    """Grey values of ground points that at least two views show: one row per view and point, in the order of the views.

    view, point : (m,) numbers of the view and of the point; grey : (m,) grey values; ground : (n, 3) m, the points.
    """

    view: NDArray[np.intp]
    point: NDArray[np.intp]
    grey: FloatArray
    ground: FloatArray

    def only(self, rows: NDArray[np.bool_]) -> Greys:
        """Some of the rows. rows : (m,) bool."""
        return replace(self, view=self.view[rows], point=self.point[rows], grey=self.grey[rows])

    def common(self, values: FloatArray, weight: FloatArray | None = None) -> FloatArray:
        """For each row the weighted mean of values (m,) over all views of its point, (m,)."""
        weight = np.ones(len(values)) if weight is None else weight
        total, n = (np.bincount(self.point, w, len(self.ground)) for w in (values * weight, weight))
        return np.asarray((total / np.maximum(n, 1.0))[self.point])

    def in_scale(self, scales: FloatArray) -> FloatArray:
        """Grey values (m,) in the scales of their views. scales : (i, 2), mean and contrast."""
        return np.asarray((self.grey - scales[self.view, 0]) / scales[self.view, 1])


def grey_scales(views: tuple[View, ...], ground: FloatArray) -> tuple[GreyScale, ...]:
    """Grey scales of all views with which they agree on the ground that they share.

    ground : (n, 3) m, points on the surface. The mean and deviation of whole images would not agree: an oblique view of
    a slope, for example, shows more of it. A view that shares too few points keeps the mean and deviation of its whole
    image. Images of a wide field get a trend too, where trends explain much of the differences between the views.
    """
    scales = np.array([image_grey(view) for view in views])
    greys = greys_of(views, ground)
    matched = np.bincount(greys.view, minlength=len(views)) >= MIN_POINTS
    scales = matched_scales(greys, matched, scales)
    linked = greys.only(matched[greys.view])
    trends = trends_between(replace(linked, grey=linked.in_scale(scales)), trend_terms_of(views, linked), len(views))
    if trends is None:
        return tuple(GreyScale(float(mean), float(contrast)) for mean, contrast in scales)
    trends *= scales[:, 1:]
    level = np.einsum("mk,mk->m", trend_terms_of(views, greys), trends[greys.view])
    scales = matched_scales(replace(greys, grey=greys.grey - level), matched, scales)
    return tuple(
        GreyScale(float(mean), float(contrast), GreyTrend(view.image.shape, tuple(float(term) for term in row)))
        for view, (mean, contrast), row in zip(views, scales, trends, strict=True)
    )


def greys_of(views: tuple[View, ...], ground: FloatArray) -> Greys:
    """Grey values of `MAX_POINTS` of the ground points (n, 3) m, evenly chosen from all of them.

    More points are taken where each view sees few of them, as in scenes of hundreds of images.
    """
    chosen = spread(ground, MAX_POINTS)
    near_views = zip(views, _near(views, chosen), strict=True)
    n_shown = sum(len(squares_inside(view, chosen[near])[0]) for view, near in near_views)
    ground = spread(ground, MAX_POINTS * max(MAX_POINTS * len(views) // max(n_shown, 1), 1))
    points, values = [], []
    for view, near in zip(views, _near(views, ground), strict=True):
        grey = grey_at(view, ground[near])
        points.append(near[np.isfinite(grey)])
        values.append(grey[np.isfinite(grey)])
    view_of, point_of = np.repeat(np.arange(len(views)), [len(p) for p in points]), np.concatenate(points)
    greys = Greys(view_of, point_of, np.concatenate(values), ground)
    return greys.only(np.bincount(point_of, minlength=len(ground))[point_of] >= 2)


def spread(ground: FloatArray, n: int) -> FloatArray:
    """`n` of the points (k, 3), evenly chosen from all of them; all where there are fewer."""
    return ground if len(ground) <= n else ground[np.linspace(0, len(ground) - 1, n).astype(int)]


def _near(views: tuple[View, ...], ground: FloatArray) -> Iterator[NDArray[np.intp]]:
    """Numbers of the points (n, 3) in the box around the footprint of each view; it shows no others."""
    z_range = (float(ground[:, 2].min()), float(ground[:, 2].max())) if len(ground) else (0.0, 0.0)
    for view in views:
        low, high = ground_box(view, z_range)
        yield np.flatnonzero(((ground[:, :2] >= low) & (ground[:, :2] <= high)).all(axis=1))


def rows_of_views(view: NDArray[np.intp], n_views: int) -> list[slice]:
    """Rows of each view. view : (m,) view of each row, ascending."""
    edges = np.searchsorted(view, np.arange(n_views + 1))
    return [slice(int(first), int(end)) for first, end in pairwise(edges)]


def trend_terms_of(views: tuple[View, ...], greys: Greys) -> FloatArray:
    """Factors (m, 5) of the terms of a trend for all rows, see `trend_terms`."""
    terms = np.empty((len(greys.grey), N_TERMS))
    for view, rows in zip(views, rows_of_views(greys.view, len(views)), strict=True):
        terms[rows] = trend_terms(view, greys.ground[greys.point[rows]])
    return terms


def matched_scales(greys: Greys, matched: NDArray[np.bool_], scales: FloatArray) -> FloatArray:
    """Mean and contrast of every view, (i, 2), with which the views agree.

    The moments of each view are matched in turn to those of the mean of all views over the points that it sees, without
    points that differ (a shadow that moved, a point behind a building). matched : (i,) bool, views that are matched,
    the others keep theirs; scales : (i, 2) to start from.
    """
    scales = scales.copy()
    rows = rows_of_views(greys.view, len(scales))
    for round_ in range(ROUNDS if matched.any() else 0):
        scaled = greys.in_scale(scales)
        common = greys.common(scaled)
        first = scales[matched, 1]
        for i in np.flatnonzero(matched).tolist():
            centre, spread = moments(scaled[rows[i]], common[rows[i]], round_ < MEDIAN_ROUNDS)
            if spread.all():
                gain = spread[0] / spread[1]
                scales[i, 0] += scales[i, 1] * (centre[0] - gain * centre[1])
                scales[i, 1] *= gain
        # The mean of all views has less contrast than each of them: only differences between the views count.
        scales[matched, 1] *= np.exp(np.log(first / scales[matched, 1]).mean())
    return scales


def unit_position(shape: tuple[int, int], col: NDArray[Any], row: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Columns and rows from the centre of an image, divided by half its larger side. shape : rows and columns."""
    rows, cols = shape
    half = max(rows, cols) / 2
    return (col - (cols - 1) / 2) / half, (row - (rows - 1) / 2) / half


def trend_terms(view: View, ground: FloatArray) -> FloatArray:
    """Factors of the terms of a `GreyTrend` at ground points (n, 3), (n, 5); NaN where the view cannot map them."""
    u, v = unit_position(view.image.shape, *view.sensor.image_from_ground(ground).T)
    return np.column_stack([u, v, u * u, u * v, v * v])


def trends_between(greys: Greys, terms: FloatArray, n_views: int) -> FloatArray | None:
    """Trends (i, 5) with which the views agree on shared points; None where they explain too little of the differences.

    greys : grey values on one scale; terms : (m, 5), see `trend_terms`. Least squares, for the trend and a constant of
    every view, of the differences from the mean of the views of the point, without points that differ much. A weak
    prior keeps small what the points do not determine, such as a trend that all views have in common.
    """
    if len(greys.grey) < MIN_POINTS:
        return None
    terms = np.column_stack([terms, np.ones(len(terms))])
    weight, noise, trends = np.ones(len(terms)), 1.0, np.zeros((n_views, terms.shape[1]))
    for _ in range(TREND_ROUNDS):
        trends = _fitted(greys, terms, weight, max(noise, MIN_NOISE**2), trends)
        differs = greys.grey - greys.common(greys.grey, weight)
        fitted = np.einsum("mk,mk->m", terms, trends[greys.view])
        left, used = differs - (fitted - greys.common(fitted, weight)), weight > 0
        if not used.any():
            return None
        noise, before = float(np.mean(left[used] ** 2)), float(np.mean(differs[used] ** 2))
        spread = MAD_TO_SIGMA * float(np.median(np.abs(left[used])))
        weight = (np.abs(left) <= MAX_SIGMAS * spread).astype(float)
        weight *= np.bincount(greys.point, weight, len(greys.ground))[greys.point] >= 2
    explained = before - noise
    return trends[:, :N_TERMS] if explained >= max(MIN_EXPLAINED_SHARE * before, MIN_TREND**2) else None


def _fitted(greys: Greys, terms: FloatArray, weight: FloatArray, noise: float, first: FloatArray) -> FloatArray:
    """Trends and constants (i, 6) of least squares with a prior.

    terms : (m, 6); weight : (m,); noise : variance of grey values; first : (i, 6) to start from. Solved by conjugate
    gradients, so that no matrix of all views is needed.
    """
    shape, n_views, prior = first.shape, len(first), noise / TREND_SIGMA**2
    weighted = terms * weight[:, None]

    def summed(values: FloatArray) -> FloatArray:
        """Sums (i, k) over the rows (m, k) of each view."""
        return np.stack([np.bincount(greys.view, column, n_views) for column in values.T], axis=1)

    def normal(trends: FloatArray) -> FloatArray:
        """The normal matrix times trends (6 i,)."""
        fitted = np.einsum("mk,mk->m", terms, trends.reshape(shape)[greys.view])
        return np.asarray(summed(weighted * (fitted - greys.common(fitted, weight))[:, None]).ravel() + prior * trends)

    own = summed((weighted[:, :, None] * terms[:, None, :]).reshape(len(terms), -1)).reshape(*shape, shape[1])
    inverse = np.linalg.inv(own + prior * np.eye(shape[1]))
    right = summed(weighted * (greys.grey - greys.common(greys.grey, weight))[:, None]).ravel()
    trends = conjugate_gradients(
        normal, right, first.ravel(), lambda v: np.einsum("ikl,il->ik", inverse, v.reshape(shape)).ravel()
    )
    return np.asarray(trends.reshape(shape))


def conjugate_gradients(
    normal: Callable[[FloatArray], FloatArray],
    right: FloatArray,
    first: FloatArray,
    precondition: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Solution (n,) of normal equations, to within `RELATIVE_TOLERANCE` of the right side (n,).

    normal : the matrix times a vector; precondition : nearly its inverse times a vector; first : (n,), to start from.
    Source: Hestenes & Stiefel 1952, with a preconditioner, as in Barrett et al. 1994, figure 2.5. `scipy.sparse.linalg`
    has the same, and takes a tenth of a second to import.
    """
    found, tolerance = first.copy(), RELATIVE_TOLERANCE * np.linalg.norm(right)
    if not tolerance:
        return right
    left = right - normal(found) if found.any() else right.copy()
    direction, before = np.zeros_like(left), 1.0
    for _ in range(STEPS_PER_UNKNOWN * len(right)):
        if np.linalg.norm(left) < tolerance:
            break
        towards = precondition(left)
        now = float(left @ towards)
        direction = towards + now / before * direction
        turned = normal(direction)
        step = now / float(direction @ turned)
        found += step * direction
        left -= step * turned
        before = now
    return found


def moments(values: FloatArray, common: FloatArray, by_medians: bool) -> tuple[FloatArray, FloatArray]:
    """Centre and spread of both, each (2,).

    by_medians : medians, which find the points that differ although the exposures differ too; else mean and deviation
    without the points that differ.
    """
    both = np.stack([values, common])
    if by_medians:
        centre = np.median(both, axis=1)
        return centre, np.asarray(np.median(np.abs(both - centre[:, None]), axis=1))
    away = np.abs(values - common)
    kept = both[:, away <= MAX_SIGMAS * MAD_TO_SIGMA * np.median(away) + 1e-9]
    return kept.mean(axis=1), kept.std(axis=1)


def image_grey(view: View) -> tuple[float, float]:
    """Mean and standard deviation of an image, from rows spread over it, so that they are the same for every tile.

    The deviation is 1 where all pixels of these rows are equal or unusable.
    """
    top, left, rows, cols = held_window(view.image)
    values = []
    for row in np.unique(np.linspace(0, rows - 1, SAMPLE_ROWS).astype(int)):
        read = view.image.read(top + int(row), left, 1, cols)
        values.append(read.pixels[read.valid])
    grey = np.concatenate(values)
    mean, deviation = (float(grey.mean()), float(grey.std())) if grey.size else (0.0, 0.0)
    return mean, deviation if deviation > 0 else 1.0


def grey_at(view: View, ground: FloatArray) -> FloatArray:
    """Mean grey value in the square around ground points (n, 3) m, (n,); NaN where it is not full of valid pixels."""
    out = np.full(len(ground), np.nan)
    inside, row, col = squares_inside(view, ground)
    _, part = np.unique(np.column_stack([row, col]) // PART_PX, axis=0, return_inverse=True)
    for number in range(part.max(initial=-1) + 1):
        here = np.flatnonzero(part.ravel() == number)
        top, left = row[here].min(), col[here].min()
        size = (row[here].max() - top + SQUARE_PX, col[here].max() - left + SQUARE_PX)
        read = view.image.read(int(top), int(left), int(size[0]), int(size[1]))
        for k in here:
            square = (slice(row[k] - top, row[k] - top + SQUARE_PX), slice(col[k] - left, col[k] - left + SQUARE_PX))
            if read.valid[square].all():
                out[inside[k]] = read.pixels[square].mean()
    return out


def squares_inside(view: View, ground: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of the ground points (n, 3) m whose square lies inside the image, and its first row and column."""
    rows, cols = view.image.shape
    xy = view.sensor.image_from_ground(ground)
    known = np.asarray(np.isfinite(xy).all(axis=1))
    col, row = np.rint(np.where(known[:, None], xy, -SQUARE_PX)).astype(np.int64).T - SQUARE_PX // 2
    inside = np.flatnonzero(known & (row >= 0) & (row <= rows - SQUARE_PX) & (col >= 0) & (col <= cols - SQUARE_PX))
    return inside, row[inside], col[inside]
