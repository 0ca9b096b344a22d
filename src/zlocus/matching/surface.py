"""What a tile yields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.matching.quality import Quality


@dataclass(frozen=True)
class Surface:
    """Height, its precision, reasons, images used and ortho-image of a block of cells, all (r, c), colours (r, c, 3).

    height : float32, ellipsoidal m at the cell's centre, NaN where empty; sigma : float32 m, its standard deviation,
    NaN where empty or interpolated; quality : uint16, see `Quality`; views :
    uint8, images used, 0 where empty; ortho : float32, grey values or colours of the image, NaN where there is none.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    quality: NDArray[np.uint16]
    views: NDArray[np.uint8]
    ortho: NDArray[np.float32]

    def part(self, window: CellWindow, whole: CellWindow) -> Surface:
        """The cells of `window`, from a surface that covers `whole`; cells beyond it are UNSEEN."""
        out = Surface.nothing(window, self.ortho.shape[2:])
        shared = window.within(whole)
        to, since = shared.slices_in(window), shared.slices_in(whole)
        for mine, theirs in zip(out.arrays, self.arrays, strict=True):
            mine[to] = theirs[since]
        return out

    def without(self, outside: NDArray[np.bool_]) -> Surface:
        """The surface with some cells emptied because they were not asked for. outside : (r, c) bool."""
        return self._emptied(outside, np.where(outside, np.uint16(Quality.OUTSIDE), self.quality))

    def precise(self, most_sigma_m: float | None) -> Surface:
        """The surface without the heights whose standard deviation is larger; None keeps all."""
        if most_sigma_m is None:
            return self
        too_much = self.sigma > most_sigma_m
        quality = self.quality | np.where(too_much, np.uint16(Quality.IMPRECISE), np.uint16(0))
        return self._emptied(too_much, quality)

    def _emptied(self, cells: NDArray[np.bool_], quality: NDArray[np.uint16]) -> Surface:
        """The surface without what stands in some cells (r, c), with other reasons."""
        nothing = np.float32(np.nan)
        height, sigma = (np.where(cells, nothing, v) for v in (self.height, self.sigma))
        ortho = np.where(cells if self.ortho.ndim == 2 else cells[..., None], nothing, self.ortho)
        return Surface(height, sigma, quality, np.where(cells, np.uint8(0), self.views), ortho)

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """All of them, in the order above."""
        return self.height, self.sigma, self.quality, self.views, self.ortho

    @classmethod
    def nothing(
        cls, window: CellWindow, bands: tuple[int, ...] = (), full: Callable[..., NDArray[Any]] = np.full
    ) -> Surface:
        """Cells that no two views cover. bands : () or (3,), of the ortho-image; full : makes the arrays."""
        shape = (window.rows, window.cols)
        return cls(
            full(shape, np.nan, np.float32),
            full(shape, np.nan, np.float32),
            full(shape, Quality.UNSEEN, np.uint16),
            full(shape, 0, np.uint8),
            full(shape + bands, np.nan, np.float32),
        )
