"""Correlation windows of cells along their loci: what each view shows of a cell at every height of a match curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.matching.kernels.locus_windows import line_windows
from zlocus.matching.tile_views import TileViews

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class CurveSamples:
    """Cells of a level, and the heights at which their match curves are sampled.

    cells : (n, 2) int64, row and column; first : (n,) float64, lowest height of each, a level index; n_heights :
    heights of each, one step apart; relief : (n, k) float32, height of the ground in each cell of the window above its
    middle cell, steps, row by row.
    """

    cells: IntArray
    first: FloatArray
    n_heights: int
    relief: NDArray[np.float32]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of heights, and of cells of a window."""
        return self.n_heights, self.relief.shape[1]

    def windows(self, tile_views: TileViews, view: int, rows: IntArray | slice) -> NDArray[np.float32]:
        """Windows of one view around some of the cells, (m, h, k) float32.

        The product of two of them is their correlation: each has mean 0 and length 1. NaN where the view does not show
        the whole window. rows : which of the cells.
        """
        cells, first, relief = self.cells[rows], self.first[rows], self.relief[rows]
        out = np.empty((len(cells), self.n_heights, self.relief.shape[1]), np.float32)
        half = (round(self.relief.shape[1] ** 0.5) - 1) // 2
        line_windows(tile_views.arrays, tile_views.blocked, view, cells, first, half, relief, out)
        return out
