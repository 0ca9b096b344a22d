"""Resample raw images of rendered line scanners to a plane (level 1), as ground processing does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, minimum_filter

from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.cameras import RectifiedScanner

# Positions in the raw image are interpolated between columns at this spacing: a row of the plane is nearly one of its
# rows.
COLUMN_SPACING = 64
# A cubic spline hardly depends on pixels farther away than this, in each direction.
SPLINE_RADIUS_PX = 2


def rectified(numbers: NDArray[np.integer], camera: RectifiedScanner, shape: tuple[int, int]) -> NDArray[np.integer]:
    """The level 1 image (r, c) of a raw image, by cubic splines; 0 outside of it and near its zeros, elsewhere >= 1."""
    places = raw_rows_and_columns(camera, shape)
    grey = map_coordinates(numbers.astype(np.float32), places, order=3, mode="nearest")
    known = minimum_filter(numbers > 0, 2 * SPLINE_RADIUS_PX + 1, mode="constant", cval=False)
    shown = map_coordinates(known.astype(np.uint8), places, order=0, mode="constant", cval=0) > 0
    out = np.clip(np.rint(grey), 1, np.iinfo(numbers.dtype).max).astype(numbers.dtype)
    return np.asarray(np.where(shown, out, 0), numbers.dtype)


def raw_rows_and_columns(camera: RectifiedScanner, shape: tuple[int, int]) -> FloatArray:
    """Rows and columns (2, r, c) px in the raw image of all pixels of a level 1 image of `shape`."""
    knots = np.arange(-(-shape[1] // COLUMN_SPACING) + 1) * COLUMN_SPACING
    col, row = np.meshgrid(knots, np.arange(shape[0]))
    raw = camera.raw_from_image(np.column_stack([col.ravel(), row.ravel()])).reshape(*col.shape, 2)
    left, far = np.divmod(np.arange(shape[1]), COLUMN_SPACING)
    share = (far / COLUMN_SPACING)[:, None]
    between = (1.0 - share) * raw[:, left] + share * raw[:, left + 1]
    return np.ascontiguousarray(np.moveaxis(between[..., ::-1], -1, 0))
