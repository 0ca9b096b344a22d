"""Grey values of all images on one scale, so that views taken with other exposures, or of other ground, compare."""

from __future__ import annotations

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


def grey_scales(views: tuple[View, ...], ground: FloatArray) -> tuple[tuple[float, float], ...]:
    """Grey value that is 0 and grey values that are 1 of every view, such that views agree on the ground they share.

    ground : (n, 3) m, points on the surface. Whole images will not do for moments: an oblique view of a slope shows
    more of it. Each view's mean and deviation are matched in turn to those of the mean of all views over the points
    that it sees, without points that differ (a shadow that moved, a point behind a building). A view that shares too
    few keeps the moments of the whole image.
    """
    scales = np.array([image_grey(view) for view in views])
    if len(ground) > MOST_POINTS:
        ground = ground[np.linspace(0, len(ground) - 1, MOST_POINTS).astype(int)]
    grey = np.array([grey_at(view, ground) for view in views]).reshape(len(views), -1)
    known = np.isfinite(grey)
    known &= known.sum(axis=0) >= 2
    matched = np.flatnonzero(known.sum(axis=1) >= FEWEST_POINTS)
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
    return tuple((float(mean), float(deviation)) for mean, deviation in scales)


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
