"""Values of one north-up grid on another one in the same frame: what GDAL's warp does, without its locks on warnings,
so that threads may call it."""

from __future__ import annotations

from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from scipy import sparse

# A value is known where at least this share of what it is made of is.
MIN_KNOWN_SHARE = 0.5


def resampled(values: NDArray[np.float32], transform: rasterio.Affine, geobox: GeoBox) -> NDArray[np.float32]:
    """Values (r, c) of a grid at the cell centres of another, bilinear, (r, c) float32; NaN where there are none.

    values : (s, t) float32, NaN where there is none; transform : of their grid, which has the same axes. Larger cells
    get weighted means. Of values beside missing ones the known ones count, as far as they weigh half or more.
    """
    rows, cols = geobox.shape
    (t, u) = transform, geobox.transform
    down = _weights(u.e / t.e, (u.f - t.f) / t.e, rows, values.shape[0])
    across = _weights(u.a / t.a, (u.c - t.c) / t.a, cols, values.shape[1])
    known = np.isfinite(values)
    if not known.any():
        return np.full((rows, cols), np.nan, np.float32)
    total = _product(down, np.where(known, values, np.float32(0.0)), across)
    # Where the grid ends, what lies beyond it is missing too.
    share = _product(down, known.astype(np.float32), across)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(share >= MIN_KNOWN_SHARE - 1e-6, total / share, np.nan), np.float32)


def _product(down: Any, values: NDArray[np.float32], across: Any) -> NDArray[np.float32]:
    """Values weighted along both axes."""
    return np.asarray((across @ (down @ values).T).T, np.float32)


def _weights(scale: float, first: float, n: int, n_source: int) -> Any:
    """Sparse weights (n, s) of cells of the source for n cells, which are `scale` of theirs wide and begin at
    `first`."""
    place = first + scale * (np.arange(n) + 0.5) - 0.5
    width = max(abs(scale), 1.0)
    reach = int(np.ceil(width))
    near = np.floor(place)[:, None].astype(np.int64) + np.arange(1 - reach, reach + 1)
    weight = np.maximum(1.0 - np.abs(near - place[:, None]) / width, 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    row = np.broadcast_to(np.arange(n)[:, None], near.shape)
    inside = (near >= 0) & (near < n_source) & (weight > 0.0)
    entries = weight[inside].astype(np.float32), (row[inside], near[inside])
    return sparse.csr_array(entries, shape=(n, n_source))
