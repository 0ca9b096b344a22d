"""Exact statistics of the bands of a raster, accumulated block by block."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass
class BandStatistics:
    """Minimum, maximum, mean and standard deviation (of the population, as GDAL computes it) of a band's valid cells.

    Blocks are merged by their means and sums of squared deviations, which loses no digits where the mean is much larger
    than the spread. n, n_valid : cells counted, and valid ones.
    Source: Chan, Golub and LeVeque (1983), The American Statistician 37(3), eq. 2.1.
    """

    n: int = 0
    n_valid: int = 0
    minimum: float = math.inf
    maximum: float = -math.inf
    mean: float = 0.0
    squares: float = 0.0

    def add(self, cells: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Count a block. cells, valid : arrays of the same shape."""
        values = cells[valid].astype(np.float64)
        self.n += cells.size
        if not values.size:
            return
        mean = float(values.mean())
        squares = float(((values - mean) ** 2).sum())
        self._merge(values.size, float(values.min()), float(values.max()), mean, squares)

    def add_zeros(self, n: int) -> None:
        """Count n valid cells that are 0."""
        self.n += n
        if n:
            self._merge(n, 0.0, 0.0, 0.0, 0.0)

    def add_invalid(self, n: int) -> None:
        """Count n cells without data."""
        self.n += n

    def tags(self) -> dict[str, str]:
        """The statistics as GDAL writes them into a band's metadata; empty where no cell is valid."""
        if not self.n_valid:
            return {}
        numbers = {
            "MINIMUM": self.minimum, "MAXIMUM": self.maximum, "MEAN": self.mean,
            "STDDEV": math.sqrt(self.squares / self.n_valid),
        }  # fmt: skip
        tags = {f"STATISTICS_{name}": f"{value:.14g}" for name, value in numbers.items()}
        return tags | {"STATISTICS_VALID_PERCENT": f"{100 * self.n_valid / self.n:.4g}"}

    def _merge(self, n: int, minimum: float, maximum: float, mean: float, squares: float) -> None:
        total, difference = self.n_valid + n, mean - self.mean
        self.squares += squares + difference**2 * self.n_valid * n / total
        self.mean += difference * n / total
        self.n_valid, self.minimum, self.maximum = total, min(self.minimum, minimum), max(self.maximum, maximum)


def is_data(cells: NDArray[Any], nodata: float | None) -> NDArray[np.bool_]:
    """Which cells are valid: finite, and not the nodata value. The shape of `cells`."""
    known = np.isfinite(cells) if cells.dtype.kind == "f" else np.ones(cells.shape, bool)
    return known if nodata is None or math.isnan(nodata) else known & (cells != nodata)
