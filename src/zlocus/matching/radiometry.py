"""Grey values of all images on one scale, so that views taken with other exposures, or of other ground, compare."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import View, held_window
from zlocus.core.footprints import ground_box

FloatArray = NDArray[np.float64]
SAMPLE_ROWS = 12
# Mean grey over a square of this side stands for a ground point, so that a pixel of shift matters little.
SIDE_PX = 9
MOST_POINTS, FEWEST_POINTS = 400, 30
# Squares that start in the same part of an image, of this side, are read at once: opening a file takes a millisecond.
PART_PX = 512
ROUNDS, MEDIAN_ROUNDS, OUTLIER = 20, 3, 3.0
MAD_TO_SIGMA = 1.4826
# Of a trend: sigma of the prior on its terms, in contrasts; the share of what differs between views that it must
# explain. Of satellites, rendered and real ones, it explains 0.15 or less, of images of a mapping camera 0.69.
TREND_SIGMA, TREND_ROUNDS, LEAST_EXPLAINED = 0.3, 5, 0.25
# And so large it is at least, in contrasts: smaller ones do not matter.
LEAST_TREND = 0.04
# Grey values are never more precise than this, in contrasts: the prior keeps some weight.
LEAST_NOISE = 1e-3
N_TERMS = 5
PRECISION = 1e-7  # of what is solved by rounds, relative


@dataclass(frozen=True)
class GreyTrend:
    """What lenses and the sun add to the grey values of an image from one side to the other: a quadratic.

    shape : rows and columns of the image; terms : grey values, of u, v, u^2, u v, v^2, with u and v the column and row
    from the image's centre over half its larger side.
    """

    shape: tuple[int, int]
    terms: tuple[float, ...]

    def window(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """Grey values (rows, cols) of a window of the image that starts at (row, col)."""
        u, v = unit_position(self.shape, np.arange(col, col + cols), np.arange(row, row + rows))
        a, b, c, d, e = self.terms
        return np.asarray((a + c * u) * u + (b + e * v)[:, None] * v[:, None] + d * v[:, None] * u, np.float32)


@dataclass(frozen=True)
class GreyScale:
    """Grey value of an image that is 0, and grey values that are 1, once its trend is taken off, if it has one."""

    mean: float
    contrast: float
    trend: GreyTrend | None = None


@dataclass(frozen=True)
class Greys:
    """Grey values of ground points that two views see or more: one row per view and point, in the order of views.

    view, point : (m,); grey : (m,); ground : (n, 3) m, the points.
    """

    view: NDArray[np.intp]
    point: NDArray[np.intp]
    grey: FloatArray
    ground: FloatArray

    def only(self, rows: NDArray[np.bool_]) -> Greys:
        """Some of the rows."""
        return replace(self, view=self.view[rows], point=self.point[rows], grey=self.grey[rows])

    def common(self, values: FloatArray, weight: FloatArray | None = None) -> FloatArray:
        """For each row the mean of values (m,) over the views that see its point."""
        weight = np.ones(len(values)) if weight is None else weight
        total, n = (np.bincount(self.point, w, len(self.ground)) for w in (values * weight, weight))
        return np.asarray((total / np.maximum(n, 1.0))[self.point])

    def in_scale(self, scales: FloatArray) -> FloatArray:
        """Grey values (m,) as their views' scales, mean and contrast (i, 2), have them."""
        return np.asarray((self.grey - scales[self.view, 0]) / scales[self.view, 1])


def grey_scales(views: tuple[View, ...], ground: FloatArray) -> tuple[GreyScale, ...]:
    """Grey scales of all views, such that they agree on the ground they share.

    ground : (n, 3) m, points on the surface. Whole images will not do for moments: an oblique view of a slope shows
    more of it. A view that shares too few points keeps the moments of the whole image. Images of a wide field have
    trends too, where those explain much of what differs between them.
    """
    scales = np.array([image_grey(view) for view in views])
    found = greys_of(views, ground)
    matched = np.bincount(found.view, minlength=len(views)) >= FEWEST_POINTS
    scales = matched_scales(found, matched, scales)
    linked = found.only(matched[found.view])
    trends = trends_between(replace(linked, grey=linked.in_scale(scales)), trend_terms_of(views, linked), len(views))
    if trends is None:
        return tuple(GreyScale(float(mean), float(contrast)) for mean, contrast in scales)
    trends *= scales[:, 1:]
    level = np.einsum("mk,mk->m", trend_terms_of(views, found), trends[found.view])
    scales = matched_scales(replace(found, grey=found.grey - level), matched, scales)
    return tuple(
        GreyScale(float(mean), float(contrast), GreyTrend(view.image.shape, tuple(float(term) for term in row)))
        for view, (mean, contrast), row in zip(views, scales, trends, strict=True)
    )


def greys_of(views: tuple[View, ...], ground: FloatArray) -> Greys:
    """Grey values of `MOST_POINTS` of the ground points (n, 3) m, spread over all of them; of more where a view sees
    few of them, as of hundreds of images each does."""
    some = spread(ground, MOST_POINTS)
    n_seen = sum(len(squares_inside(view, some[near])[0]) for view, near in zip(views, _near(views, some), strict=True))
    ground = spread(ground, MOST_POINTS * max(MOST_POINTS * len(views) // max(n_seen, 1), 1))
    points, greys = [], []
    for view, near in zip(views, _near(views, ground), strict=True):
        grey = grey_at(view, ground[near])
        points.append(near[np.isfinite(grey)])
        greys.append(grey[np.isfinite(grey)])
    view_of, point_of = np.repeat(np.arange(len(views)), [len(p) for p in points]), np.concatenate(points)
    found = Greys(view_of, point_of, np.concatenate(greys), ground)
    return found.only(np.bincount(point_of, minlength=len(ground))[point_of] >= 2)


def spread(ground: FloatArray, n: int) -> FloatArray:
    """As many of the points (k, 3), spread over all of them."""
    return ground if len(ground) <= n else ground[np.linspace(0, len(ground) - 1, n).astype(int)]


def _near(views: tuple[View, ...], ground: FloatArray) -> Iterator[NDArray[np.intp]]:
    """For each view the points (n, 3) in the box around its footprint, of which it is asked for no others."""
    z_range = (float(ground[:, 2].min()), float(ground[:, 2].max())) if len(ground) else (0.0, 0.0)
    for view in views:
        low, high = ground_box(view, z_range)
        yield np.flatnonzero(((ground[:, :2] >= low) & (ground[:, :2] <= high)).all(axis=1))


def rows_of_views(view: NDArray[np.intp], n_views: int) -> list[slice]:
    """Rows of each view, of rows in the order of views."""
    edges = np.searchsorted(view, np.arange(n_views + 1))
    return [slice(int(first), int(end)) for first, end in pairwise(edges)]


def trend_terms_of(views: tuple[View, ...], found: Greys) -> FloatArray:
    """Terms (m, 5) of all rows, see `trend_terms`."""
    terms = np.empty((len(found.grey), N_TERMS))
    for view, rows in zip(views, rows_of_views(found.view, len(views)), strict=True):
        terms[rows] = trend_terms(view, found.ground[found.point[rows]])
    return terms


def matched_scales(found: Greys, matched: NDArray[np.bool_], scales: FloatArray) -> FloatArray:
    """Mean and deviation of every view, (i, 2), from those `scales` start at.

    Each view's are matched in turn to those of the mean of all views over the points that it sees, without points that
    differ (a shadow that moved, a point behind a building). matched : (i,) views that are.
    """
    scales = scales.copy()
    rows = rows_of_views(found.view, len(scales))
    for round_ in range(ROUNDS if matched.any() else 0):
        scaled = found.in_scale(scales)
        common = found.common(scaled)
        first = scales[matched, 1]
        for i in np.flatnonzero(matched).tolist():
            centre, spread = moments(scaled[rows[i]], common[rows[i]], round_ < MEDIAN_ROUNDS)
            if spread.all():
                gain = spread[0] / spread[1]
                scales[i, 0] += scales[i, 1] * (centre[0] - gain * centre[1])
                scales[i, 1] *= gain
        # The mean of all views has less contrast than each: only what differs between views counts.
        scales[matched, 1] *= np.exp(np.log(first / scales[matched, 1]).mean())
    return scales


def unit_position(shape: tuple[int, int], col: NDArray[Any], row: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Columns and rows from the centre of an image, over half its larger side."""
    rows, cols = shape
    half = max(rows, cols) / 2
    return (col - (cols - 1) / 2) / half, (row - (rows - 1) / 2) / half


def trend_terms(view: View, ground: FloatArray) -> FloatArray:
    """What the terms of a `GreyTrend` multiply at ground points (n, 3), (n, 5); NaN where the view cannot map them."""
    u, v = unit_position(view.image.shape, *view.sensor.image_from_ground(ground).T)
    return np.column_stack([u, v, u * u, u * v, v * v])


def trends_between(found: Greys, terms: FloatArray, n_views: int) -> FloatArray | None:
    """Trends (i, 5) that make views agree on shared points; None where they explain too little of what differs.

    found : grey values on one scale; terms : (m, 5), see `trend_terms`. Least squares, trend and constant of every
    view, of what is left against the mean of those that see the point, without points that differ; a weak prior keeps
    small what the points do not show, such as a trend that all views have in common.
    """
    if len(found.grey) < FEWEST_POINTS:
        return None
    terms = np.column_stack([terms, np.ones(len(terms))])
    weight, noise, trends = np.ones(len(terms)), 1.0, np.zeros((n_views, terms.shape[1]))
    for _ in range(TREND_ROUNDS):
        trends = _fitted(found, terms, weight, max(noise, LEAST_NOISE**2), trends)
        differs = found.grey - found.common(found.grey, weight)
        fitted = np.einsum("mk,mk->m", terms, trends[found.view])
        left, used = differs - (fitted - found.common(fitted, weight)), weight > 0
        if not used.any():
            return None
        noise, before = float(np.mean(left[used] ** 2)), float(np.mean(differs[used] ** 2))
        spread = MAD_TO_SIGMA * float(np.median(np.abs(left[used])))
        weight = (np.abs(left) <= OUTLIER * spread).astype(float)
        weight *= np.bincount(found.point, weight, len(found.ground))[found.point] >= 2
    explained = before - noise
    return trends[:, :N_TERMS] if explained >= max(LEAST_EXPLAINED * before, LEAST_TREND**2) else None


def _fitted(found: Greys, terms: FloatArray, weight: FloatArray, noise: float, first: FloatArray) -> FloatArray:
    """Trends and constants (i, 6) of least squares with a prior. terms : (m, 6); weight : (m,); noise : variance of
    grey values; first : what to start from. Solved by conjugate gradients, so that no matrix of all views is needed."""
    from scipy.sparse.linalg import LinearOperator, cg

    shape, n_views, prior = first.shape, len(first), noise / TREND_SIGMA**2
    weighted = terms * weight[:, None]

    def summed(values: FloatArray) -> FloatArray:
        """Sums (i, k) over the rows (m, k) of each view."""
        return np.stack([np.bincount(found.view, column, n_views) for column in values.T], axis=1)

    def normal(trends: FloatArray) -> FloatArray:
        """The normal matrix times trends (6 i,)."""
        fitted = np.einsum("mk,mk->m", terms, trends.reshape(shape)[found.view])
        return np.asarray(summed(weighted * (fitted - found.common(fitted, weight))[:, None]).ravel() + prior * trends)

    own = summed((weighted[:, :, None] * terms[:, None, :]).reshape(len(terms), -1)).reshape(*shape, shape[1])
    inverse = np.linalg.inv(own + prior * np.eye(shape[1]))
    size = n_views * shape[1]
    right = summed(weighted * (found.grey - found.common(found.grey, weight))[:, None]).ravel()
    trends, _ = cg(
        LinearOperator((size, size), matvec=normal, dtype=float), right, first.ravel(), rtol=PRECISION,
        M=LinearOperator(
            (size, size), matvec=lambda v: np.einsum("ikl,il->ik", inverse, v.reshape(shape)).ravel(), dtype=float
        ),
    )  # fmt: skip
    return np.asarray(trends.reshape(shape))


def moments(values: FloatArray, common: FloatArray, by_medians: bool) -> tuple[FloatArray, FloatArray]:
    """Centre and spread of both, each (2,): medians at first, which tell what differs where exposures do too, then mean
    and deviation without what differs."""
    both = np.stack([values, common])
    if by_medians:
        centre = np.median(both, axis=1)
        return centre, np.asarray(np.median(np.abs(both - centre[:, None]), axis=1))
    away = np.abs(values - common)
    kept = both[:, away <= OUTLIER * MAD_TO_SIGMA * np.median(away) + 1e-9]
    return kept.mean(axis=1), kept.std(axis=1)


def image_grey(view: View) -> tuple[float, float]:
    """Mean and standard deviation of an image, from rows spread over it: the same whatever part is matched. The
    deviation is 1 where they hold nothing that differs."""
    top, left, rows, cols = held_window(view.image)
    values = []
    for row in np.unique(np.linspace(0, rows - 1, SAMPLE_ROWS).astype(int)):
        read = view.image.read(top + int(row), left, 1, cols)
        values.append(read.pixels[read.valid])
    grey = np.concatenate(values)
    mean, deviation = (float(grey.mean()), float(grey.std())) if grey.size else (0.0, 0.0)
    return mean, deviation if deviation > 0 else 1.0


def grey_at(view: View, ground: FloatArray) -> FloatArray:
    """Mean grey of the image around ground points (n, 3) m; NaN where the square leaves the image or its valid
    pixels."""
    out = np.full(len(ground), np.nan)
    inside, row, col = squares_inside(view, ground)
    _, part = np.unique(np.column_stack([row, col]) // PART_PX, axis=0, return_inverse=True)
    for number in range(part.max(initial=-1) + 1):
        here = np.flatnonzero(part.ravel() == number)
        top, left = row[here].min(), col[here].min()
        size = (row[here].max() - top + SIDE_PX, col[here].max() - left + SIDE_PX)
        read = view.image.read(int(top), int(left), int(size[0]), int(size[1]))
        for k in here:
            square = (slice(row[k] - top, row[k] - top + SIDE_PX), slice(col[k] - left, col[k] - left + SIDE_PX))
            if read.valid[square].all():
                out[inside[k]] = read.pixels[square].mean()
    return out


def squares_inside(view: View, ground: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]:
    """Which of the ground points (n, 3) m have their square inside the image, and its first row and column."""
    rows, cols = view.image.shape
    xy = view.sensor.image_from_ground(ground)
    known = np.asarray(np.isfinite(xy).all(axis=1))
    col, row = np.rint(np.where(known[:, None], xy, -SIDE_PX)).astype(np.int64).T - SIDE_PX // 2
    inside = np.flatnonzero(known & (row >= 0) & (row <= rows - SIDE_PX) & (col >= 0) & (col <= cols - SIDE_PX))
    return inside, row[inside], col[inside]
