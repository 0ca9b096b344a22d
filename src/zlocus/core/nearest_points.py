"""Nearest neighbours in the plane, by an exact k-d tree."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray

KD_TREE = 4  # FLANN's exact k-d tree (KDTreeSingleIndex); its other trees are random


def nearest_points(
    points: FloatArray, count: int, of: FloatArray | None = None
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Distances and numbers of the points nearest to each of some places, (m, count) each, the nearest first.

    points : (n, 2), at least `count`; of : (m, 2) places, None: the points, so that each is its own nearest.
    """
    origin = points.mean(axis=0)
    in_float32 = (points - origin).astype(np.float32)
    places = in_float32 if of is None else (of - origin).astype(np.float32)
    index = cv2.flann.Index(in_float32, {"algorithm": KD_TREE, "leaf_max_size": 10})
    near, squared = index.knnSearch(places, count, params={"checks": -1, "eps": 0.0, "sorted": True})
    return np.sqrt(squared.astype(float)), near
