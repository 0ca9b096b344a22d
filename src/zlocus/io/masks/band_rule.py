"""Which values of a band of a raster mask a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class BandRule:
    """Which values of a band mask a pixel.

    band : 1-based index; values : those that mask; bits : a value masks where it has one of these bits set. Without
    either, every value other than 0 masks, except `nodata` and NaN.
    """

    band: int
    values: tuple[int, ...] | None = None
    bits: int | None = None
    nodata: float | None = None

    def masks(self, stored: NDArray[Any]) -> NDArray[np.bool_]:
        """Which values (r, c) mask."""
        if self.values is not None:
            return np.isin(stored, np.asarray(self.values))
        if self.bits is not None:
            return np.asarray((stored.astype(np.int64) & self.bits) != 0)
        masked = stored != 0
        if self.nodata is not None:
            masked &= stored != self.nodata
        return np.asarray(masked & (stored == stored))  # NaN differs from itself
