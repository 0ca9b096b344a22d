"""Level 1 images of rendered line scanners: the raw image resampled to a plane, as ground processing does it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, minimum_filter

from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.cameras import RectifiedScanner

# Columns between which positions in the raw image are interpolated: a row of the plane is all but a row of it.
COLUMN_SPACING = 64
# Pixels that a cubic spline looks at, each way, beyond which it hardly remembers.
SPLINE_REACH = 2


def rectified(numbers: NDArray[np.integer], camera: RectifiedScanner, shape: tuple[int, int]) -> NDArray[np.integer]:
    """The level 1 image (r, c) of a raw one, by cubic splines; 0 where that ends or is 0 near by, else at least 1."""
    places = raw_rows_and_columns(camera, shape)
    grey = map_coordinates(numbers.astype(np.float32), places, order=3, mode="nearest")
    known = minimum_filter(numbers > 0, 2 * SPLINE_REACH + 1, mode="constant", cval=False)
    shown = map_coordinates(known.astype(np.uint8), places, order=0, mode="constant", cval=0) > 0
    out = np.clip(np.rint(grey), 1, np.iinfo(numbers.dtype).max).astype(numbers.dtype)
    return np.asarray(np.where(shown, out, 0), numbers.dtype)


def raw_rows_and_columns(camera: RectifiedScanner, shape: tuple[int, int]) -> FloatArray:
    """Where the pixels of a level 1 image of `shape` lie in the raw one: (2, r, c), rows and columns, px."""
    knots = np.arange(-(-shape[1] // COLUMN_SPACING) + 1) * COLUMN_SPACING
    col, row = np.meshgrid(knots, np.arange(shape[0]))
    raw = camera.raw_from_image(np.column_stack([col.ravel(), row.ravel()])).reshape(*col.shape, 2)
    left, far = np.divmod(np.arange(shape[1]), COLUMN_SPACING)
    share = (far / COLUMN_SPACING)[:, None]
    between = (1.0 - share) * raw[:, left] + share * raw[:, left + 1]
    return np.ascontiguousarray(np.moveaxis(between[..., ::-1], -1, 0))
