"""What a finished surface holds, in numbers: how many cells have a height, why others have none, and its sigma."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.io.row_strips import BandReader, check_same_grid, strips_of
from zlocus.matching.quality import EMPTY, Quality, is_water

# Standard deviations are counted by the upper bits of their floating-point numbers: steps of 0.4 %, in any range.
DROPPED_BITS = 15
N_BINS = 1 << (31 - DROPPED_BITS)
QUANTILES = {"median_m": 0.5, "percentile_95_m": 0.95}
# Decimals of the figures, m.
DECIMALS = 4


@dataclass
class SurfaceStatistics:
    """Counts over the cells of a surface.

    n_cells : of the grid; n_asked : of them inside the area that was asked for; n_seen : of these seen by two images or
    more; n_heights : with a height; n_matched : with one that was matched, none of water, filled or given; n_filled :
    with one that was filled or given; n_water : of levelled water. n_seen and n_matched are without levelled water.
    n_empty : cells without a height by the first of their reasons; lowest_m, highest_m : heights, None without any.
    """

    n_cells: int = 0
    n_asked: int = 0
    n_seen: int = 0
    n_heights: int = 0
    n_matched: int = 0
    n_filled: int = 0
    n_water: int = 0
    n_empty: dict[str, int] = field(default_factory=dict)
    lowest_m: float | None = None
    highest_m: float | None = None
    _n_sigma: int = 0
    _sum: float = 0.0
    _sum_of_squares: float = 0.0
    _bins: NDArray[np.int64] = field(default_factory=lambda: np.zeros(N_BINS, np.int64), repr=False)

    def add(self, height: NDArray[np.float32], sigma: NDArray[np.float32], quality: NDArray[np.uint16]) -> None:
        """Add cells, all (r, c)."""
        has_height, water = np.isfinite(height), is_water(quality)
        asked = (quality & np.uint16(Quality.OUTSIDE)) == 0
        seen = asked & ((quality & np.uint16(Quality.UNSEEN)) == 0) & ~water
        filled = has_height & ((quality & np.uint16(Quality.FILLED)) != 0) & ~water
        self.n_cells += height.size
        self.n_asked += int(asked.sum())
        self.n_seen += int(seen.sum())
        self.n_heights += int(has_height.sum())
        self.n_matched += int((has_height & ~filled & ~water).sum())
        self.n_filled += int(filled.sum())
        self.n_water += int((has_height & water).sum())
        self._add_empty(quality[~has_height])
        if has_height.any():
            low, high = float(height[has_height].min()), float(height[has_height].max())
            self.lowest_m = low if self.lowest_m is None else min(low, self.lowest_m)
            self.highest_m = high if self.highest_m is None else max(high, self.highest_m)
        known = sigma[np.isfinite(sigma) & (sigma >= 0) & has_height]
        self._n_sigma += known.size
        self._sum += float(known.sum(dtype=np.float64))
        self._sum_of_squares += float(np.square(known, dtype=np.float64).sum())
        self._bins += np.bincount(known.astype(np.float32).view(np.uint32) >> DROPPED_BITS, minlength=N_BINS)[:N_BINS]

    def _add_empty(self, quality: NDArray[np.uint16]) -> None:
        for flag in (flag for flag in Quality if flag & EMPTY and flag.name):
            is_first = (quality & np.uint16(flag)) != 0
            if n := int(is_first.sum()):
                self.n_empty[str(flag.name)] = self.n_empty.get(str(flag.name), 0) + n
            quality = quality[~is_first]

    @property
    def coverage(self) -> float:
        """Share of the cells seen by two images or more, without levelled water, whose height was matched."""
        return self.n_matched / self.n_seen if self.n_seen else 0.0

    def as_dict(self) -> dict[str, Any]:
        """The entries of run.json: counts of cells, and the standard deviations of their heights, m."""
        return {
            "cells": {
                "grid": self.n_cells, "asked": self.n_asked, "seen": self.n_seen, "heights": self.n_heights,
                "matched": self.n_matched, "filled": self.n_filled, "water": self.n_water,
                "empty": dict(self.n_empty),
            },
            "sigma": {"cells": self._n_sigma, **self._figures()},
            "surface_range_m": [
                None if height is None else round(height, DECIMALS) for height in (self.lowest_m, self.highest_m)
            ],
        }  # fmt: skip

    def _figures(self) -> dict[str, float | None]:
        if not self._n_sigma:
            return dict.fromkeys(("mean_m", "rms_m", *QUANTILES))
        mean, rms = self._sum / self._n_sigma, float(np.sqrt(self._sum_of_squares / self._n_sigma))
        figures = {"mean_m": mean, "rms_m": rms} | {
            name: _middle_of(int(np.searchsorted(np.cumsum(self._bins), share * self._n_sigma)))
            for name, share in QUANTILES.items()
        }
        return {name: round(value, DECIMALS) for name, value in figures.items()}


def _middle_of(number: int) -> float:
    """The value in the middle of a bin of standard deviations."""
    bits = (np.uint32(number) << np.uint32(DROPPED_BITS)) | np.uint32(1 << (DROPPED_BITS - 1))
    return float(np.array([bits], np.uint32).view(np.float32)[0])


def surface_statistics(folder: Path) -> SurfaceStatistics:
    """The statistics of the surface in a folder, read by strips.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    """
    statistics = SurfaceStatistics()
    with (
        BandReader(folder / "dsm.tif") as dsm,
        BandReader(folder / "sigma.tif") as sigma,
        BandReader(folder / "quality.tif") as quality,
    ):
        check_same_grid([dsm, sigma, quality])
        for strip in strips_of(int(dsm.geobox.shape[0])):
            statistics.add(dsm.read(strip), sigma.read(strip), quality.read(strip))
    return statistics
