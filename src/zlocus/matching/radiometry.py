"""Grey values of all images on one scale, so that views taken with other exposures, or of other ground, compare."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.scene import View

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


def grey_scales(views: tuple[View, ...], ground: FloatArray) -> tuple[GreyScale, ...]:
    """Grey scales of all views, such that they agree on the ground they share.

    ground : (n, 3) m, points on the surface. Whole images will not do for moments: an oblique view of a slope shows
    more of it. A view that shares too few points keeps the moments of the whole image. Images of a wide field have
    trends too, where those explain much of what differs between them.
    """
    whole = np.array([image_grey(view) for view in views])
    if len(ground) > MOST_POINTS:
        ground = ground[np.linspace(0, len(ground) - 1, MOST_POINTS).astype(int)]
    grey = np.array([grey_at(view, ground) for view in views]).reshape(len(views), -1)
    known = np.isfinite(grey)
    known &= known.sum(axis=0) >= 2
    matched = np.flatnonzero(known.sum(axis=1) >= FEWEST_POINTS)
    scales = matched_scales(grey, known, matched, whole)
    terms = np.stack([trend_terms(view, ground) for view in views])
    shared = known & np.isin(np.arange(len(views)), matched)[:, None]
    trends = trends_between((grey - scales[:, :1]) / scales[:, 1:], terms, shared)
    if trends is None:
        return tuple(GreyScale(float(mean), float(contrast)) for mean, contrast in scales)
    trends *= scales[:, 1:]
    level = np.einsum("ink,ik->in", np.where(known[..., None], terms, 0.0), trends)
    scales = matched_scales(grey - level, known, matched, scales)
    return tuple(
        GreyScale(float(mean), float(contrast), GreyTrend(view.image.shape, tuple(float(term) for term in row)))
        for view, (mean, contrast), row in zip(views, scales, trends, strict=True)
    )


def matched_scales(
    grey: FloatArray, known: NDArray[np.bool_], matched: NDArray[np.intp], scales: FloatArray
) -> FloatArray:
    """Mean and deviation of every view, (i, 2), from those `scales` start at.

    Each view's are matched in turn to those of the mean of all views over the points that it sees, without points that
    differ (a shadow that moved, a point behind a building). grey, known : (i, n); matched : views that are.
    """
    scales = scales.copy()
    for round_ in range(ROUNDS if len(matched) else 0):
        scaled = (grey - scales[:, :1]) / scales[:, 1:]
        common = np.where(known, scaled, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        first = scales[matched, 1]
        for i in matched:
            centre, spread = moments(scaled[i][known[i]], common[known[i]], round_ < MEDIAN_ROUNDS)
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


def trends_between(scaled: FloatArray, terms: FloatArray, known: NDArray[np.bool_]) -> FloatArray | None:
    """Trends (i, 5) that make views agree on shared points; None where they explain too little of what differs.

    scaled : (i, n) grey values on one scale; terms : (i, n, 5); known : (i, n). Least squares, trend and constant of
    every view, of what is left against the mean of those that see the point, without points that differ; a weak prior
    keeps small what the points do not show, such as a trend that all views have in common.
    """
    if known.sum() < FEWEST_POINTS:
        return None
    n_views, n_points, n_terms = terms.shape
    terms = np.where(known[..., None], np.concatenate([terms, np.ones((n_views, n_points, 1))], axis=2), 0.0)
    weight, noise, before = known.astype(float), 1.0, 0.0
    differs = _from_common(np.where(known, scaled, 0.0), weight)
    for _ in range(TREND_ROUNDS):
        weighted = terms * weight[..., None]
        normal = np.einsum("ink,inl->ikl", weighted, terms)
        shared = weighted.transpose(0, 2, 1).reshape(-1, n_points)
        matrix = -(shared / np.maximum(weight.sum(axis=0), 1.0)) @ shared.T
        for i in range(n_views):
            at = slice(i * (n_terms + 1), (i + 1) * (n_terms + 1))
            matrix[at, at] += normal[i]
        matrix += np.eye(len(matrix)) * noise / TREND_SIGMA**2
        found = np.linalg.solve(matrix, np.einsum("ink,in->ik", weighted, differs).ravel()).reshape(n_views, -1)
        left = differs - _from_common(np.einsum("ink,ik->in", terms, found), weight)
        used = weight > 0
        noise = float(np.mean(left[used] ** 2))
        before = float(np.mean(differs[used] ** 2))
        spread = MAD_TO_SIGMA * float(np.median(np.abs(left[used])))
        weight = (known & (np.abs(left) <= OUTLIER * spread)).astype(float)
        weight *= weight.sum(axis=0) >= 2
        differs = _from_common(np.where(known, scaled, 0.0), weight)
    return found[:, :n_terms] if before - noise >= max(LEAST_EXPLAINED * before, LEAST_TREND**2) else None


def _from_common(values: FloatArray, weight: FloatArray) -> FloatArray:
    """Values (i, n) less the mean of all views at each point."""
    return np.asarray(values - (values * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1.0))


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
    rows, cols = view.image.shape
    values = []
    for row in np.unique(np.linspace(0, rows - 1, SAMPLE_ROWS).astype(int)):
        read = view.image.read(int(row), 0, 1, cols)
        values.append(read.pixels[read.valid])
    grey = np.concatenate(values)
    mean, deviation = (float(grey.mean()), float(grey.std())) if grey.size else (0.0, 0.0)
    return mean, deviation if deviation > 0 else 1.0


def grey_at(view: View, ground: FloatArray) -> FloatArray:
    """Mean grey of the image around ground points (n, 3) m; NaN where the square leaves the image or its valid
    pixels."""
    rows, cols = view.image.shape
    out = np.full(len(ground), np.nan)
    xy = view.sensor.image_from_ground(ground)
    known = np.asarray(np.isfinite(xy).all(axis=1))
    col, row = np.rint(np.where(known[:, None], xy, -SIDE_PX)).astype(np.int64).T - SIDE_PX // 2
    inside = np.flatnonzero(known & (row >= 0) & (row <= rows - SIDE_PX) & (col >= 0) & (col <= cols - SIDE_PX))
    _, part = np.unique(np.column_stack([row, col])[inside] // PART_PX, axis=0, return_inverse=True)
    for number in range(part.max(initial=-1) + 1):
        points = inside[part.ravel() == number]
        top, left = row[points].min(), col[points].min()
        size = (row[points].max() - top + SIDE_PX, col[points].max() - left + SIDE_PX)
        read = view.image.read(int(top), int(left), int(size[0]), int(size[1]))
        for k in points:
            square = (slice(row[k] - top, row[k] - top + SIDE_PX), slice(col[k] - left, col[k] - left + SIDE_PX))
            if read.valid[square].all():
                out[k] = read.pixels[square].mean()
    return out
