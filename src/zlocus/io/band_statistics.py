"""Statistics of a raster's bands, exact, from blocks that come one by one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass
class BandStatistics:
    """Least and largest value, mean and standard deviation (of the population, as GDAL has it) of a band's valid cells.

    Blocks are merged by their means and sums of squared deviations, which loses no digits where the mean is large
    beside the spread. Source: Chan, Golub and LeVeque (1983), The American Statistician 37(3), eq. 2.1.
    """

    n: int = 0
    n_valid: int = 0
    least: float = math.inf
    largest: float = -math.inf
    mean: float = 0.0
    squares: float = 0.0

    def add(self, cells: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Count a block. cells, valid : of one shape."""
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

    def add_nothing(self, n: int) -> None:
        """Count n cells without data."""
        self.n += n

    def tags(self) -> dict[str, str]:
        """As GDAL writes them into a band's metadata; none where no cell is valid."""
        if not self.n_valid:
            return {}
        numbers = {
            "MINIMUM": self.least, "MAXIMUM": self.largest, "MEAN": self.mean,
            "STDDEV": math.sqrt(self.squares / self.n_valid),
        }  # fmt: skip
        tags = {f"STATISTICS_{name}": f"{value:.14g}" for name, value in numbers.items()}
        return tags | {"STATISTICS_VALID_PERCENT": f"{100 * self.n_valid / self.n:.4g}"}

    def _merge(self, n: int, least: float, largest: float, mean: float, squares: float) -> None:
        total, apart = self.n_valid + n, mean - self.mean
        self.squares += squares + apart**2 * self.n_valid * n / total
        self.mean += apart * n / total
        self.n_valid, self.least, self.largest = total, min(self.least, least), max(self.largest, largest)


def is_data(cells: NDArray[Any], nodata: float | None) -> NDArray[np.bool_]:
    """Which cells hold a number that means something."""
    known = np.isfinite(cells) if cells.dtype.kind == "f" else np.ones(cells.shape, bool)
    return known if nodata is None or math.isnan(nodata) else known & (cells != nodata)
