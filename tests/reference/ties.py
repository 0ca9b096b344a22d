"""Plain versions of the kernels that match features and patches, and of the search for neighbours."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from zlocus.core.footprints import ground_box

SAME_PLACE_PX, UNRELATED_DISTANCE, DESCRIPTOR_LENGTH_UNITS = 2.0, 0.9, 2**14


def distance_to_segment(low, high, point):
    """Distances of a point along (beyond the ends) and across of a segment, px."""
    chord = np.subtract(high, low)
    length = np.hypot(*chord)
    unit = chord / length if length > 0 else np.array([1.0, 0.0])
    x, y = np.subtract(point, low)
    along = x * unit[0] + y * unit[1]
    return max(-along, along - length, 0.0), abs(x * unit[1] - y * unit[0])


def nearest_descriptors(low, high, in_a, xy, in_b, max_px, ratio):
    """For each segment the feature near it of the nearest descriptor where it is clear, and for each feature the
    segment; -1 where there is none. Every pair is looked at."""
    distance = np.full((len(low), len(xy)), np.inf)
    for i in range(len(low)):
        for j in range(len(xy)):
            if np.isfinite(low[i]).all() and np.isfinite(high[i]).all():
                along, across = distance_to_segment(low[i], high[i], xy[j])
                if along <= max_px and across <= max_px:
                    distance[i, j] = np.linalg.norm(in_a[i].astype(float) - in_b[j]) / DESCRIPTOR_LENGTH_UNITS
    best_a, best_b = np.full(len(low), -1), np.full(len(xy), -1)
    for j in range(len(xy)):
        if np.isfinite(distance[:, j]).any():
            best_b[j] = distance[:, j].argmin()
    for i in range(len(low)):
        best = distance[i].argmin() if len(xy) else -1
        if best < 0 or not np.isfinite(distance[i, best]):
            continue
        elsewhere = np.abs(xy - xy[best]).max(axis=1) > SAME_PLACE_PX
        second_best = min(distance[i, elsewhere].min(initial=np.inf), UNRELATED_DISTANCE)
        if distance[i, best] < ratio * second_best:
            best_a[i] = best
    return best_a, best_b


def correlation(a, b):
    """NCC of two samples."""
    return np.corrcoef(a.ravel(), b.ravel())[0, 1]


def patch_shift(patch, square, warp, centre, reach, step=0.02):
    """Shift (column, row) px by which a patch lies off `centre` in a square, and the NCC there: best of whole pixels
    within `reach`, then of all within 1.5 px of it on ever finer grids, on a cubic spline."""
    half = patch.shape[0] // 2 - 1
    col, row = np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1))
    x = centre[0] + warp[0, 0] * col + warp[0, 1] * row
    y = centre[1] + warp[1, 0] * col + warp[1, 1] * row
    inner = patch[1:-1, 1:-1]

    def ncc(shift):
        return correlation(inner, map_coordinates(square, [y + shift[1], x + shift[0]], order=3, mode="mirror"))

    best = max(((c, r) for r in range(-reach, reach + 1) for c in range(-reach, reach + 1)), key=ncc)
    spacing = 0.5
    while spacing >= step:
        best = max(((best[0] + c * spacing, best[1] + r * spacing) for r in (-1, 0, 1) for c in (-1, 0, 1)), key=ncc)
        spacing /= 2
    return np.array([*best, ncc(best)])


def neighbours_of_all_pairs(views, z_range, margin_px):
    """Whether the boxes around the footprints of two different views touch, (i, i) bool; every pair is compared."""
    boxes = [ground_box(view, z_range, margin_px) for view in views]
    near = np.zeros((len(views), len(views)), bool)
    for a, (low_a, high_a) in enumerate(boxes):
        for b, (low_b, high_b) in enumerate(boxes):
            near[a, b] = a != b and (low_a <= high_b).all() and (low_b <= high_a).all()
    return near
