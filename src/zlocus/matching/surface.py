"""The surface of a block of cells: heights with their precision, flags, and ortho-image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import CheckOptions
from zlocus.matching.quality import Quality

# Heights with a larger standard deviation, in sides of a cell, are left out under the semi-global constraint where no
# limit is given: two thirds of them are wrong (docs/development/experiments/uncertain_heights.md).
MAX_SIGMA_CELLS = 40.0


def max_sigma_m(checks: CheckOptions, method: str, cell_m: float) -> float | None:
    """Largest standard deviation of a height, m, for cells with sides of `cell_m`; None without any limit.

    Where none is given there is a limit under the semi-global constraint only. Heights of single cells are those of the
    papers, and what is matched in image space is judged later.
    """
    if checks.max_sigma_m is not None or method != "mvll-sgm":
        return checks.max_sigma_m
    return MAX_SIGMA_CELLS * cell_m


@dataclass(frozen=True)
class Surface:
    """Heights of a block of cells, with their precision, flags, numbers of images and ortho-image.

    height : (r, c) float32, ellipsoidal m at the centre of the cell (hypotheses in image space), NaN where there is
    none; sigma : (r, c) float32, standard deviation of the height in the same unit, NaN where there is no height or an
    interpolated one; quality : (r, c) uint16, see `Quality`; views : (r, c) uint8, number of images used, 0 where there
    is no height; ortho : (r, c) float32 grey values, or (r, c, 3) colours, NaN where there are none.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    quality: NDArray[np.uint16]
    views: NDArray[np.uint8]
    ortho: NDArray[np.float32]

    def part(self, window: CellWindow, surface_window: CellWindow) -> Surface:
        """The cells of `window`, from a surface on the cells `surface_window`; cells beyond it are UNSEEN."""
        out = Surface.nothing(window, self.ortho.shape[2:])
        shared = window.within(surface_window)
        to, since = shared.slices_in(window), shared.slices_in(surface_window)
        for target, source in zip(out.arrays, self.arrays, strict=True):
            target[to] = source[since]
        return out

    def without(self, outside: NDArray[np.bool_]) -> Surface:
        """The surface without the cells outside the requested area. outside : (r, c) bool."""
        return self._emptied(outside, np.where(outside, np.uint16(Quality.OUTSIDE), self.quality))

    def precise(self, max_sigma_m: float | None) -> Surface:
        """The surface without the heights whose standard deviation is larger than a limit, m; None: no limit."""
        if max_sigma_m is None:
            return self
        too_much = self.sigma > max_sigma_m
        quality = self.quality | np.where(too_much, np.uint16(Quality.IMPRECISE), np.uint16(0))
        return self._emptied(too_much, quality)

    def _emptied(self, cells: NDArray[np.bool_], quality: NDArray[np.uint16]) -> Surface:
        """The surface with some cells (r, c) made empty, and with the given flags."""
        nothing = np.float32(np.nan)
        height, sigma = (np.where(cells, nothing, v) for v in (self.height, self.sigma))
        ortho = np.where(cells if self.ortho.ndim == 2 else cells[..., None], nothing, self.ortho)
        return Surface(height, sigma, quality, np.where(cells, np.uint8(0), self.views), ortho)

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """All arrays, in the order of the fields."""
        return self.height, self.sigma, self.quality, self.views, self.ortho

    @classmethod
    def nothing(
        cls, window: CellWindow, bands: tuple[int, ...] = (), full: Callable[..., NDArray[Any]] = np.full
    ) -> Surface:
        """A surface without heights, all of whose cells are UNSEEN.

        bands : () or (3,), of the ortho-image; full : makes the arrays.
        """
        shape = (window.rows, window.cols)
        return cls(
            full(shape, np.nan, np.float32),
            full(shape, np.nan, np.float32),
            full(shape, Quality.UNSEEN, np.uint16),
            full(shape, 0, np.uint8),
            full(shape + bands, np.nan, np.float32),
        )
