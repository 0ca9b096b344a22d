"""The cost volume of a tile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.volume import tile_costs
from zlocus.matching.lattice import HeightLattice
from zlocus.matching.views import TileViews
from zlocus.options import MeasureOptions


def cost_volume(
    views: TileViews, lattice: HeightLattice, seen: NDArray[np.int32], options: MeasureOptions
) -> NDArray[np.uint8]:
    """64 (1 - NCC) of every cell and height, (v,) uint8, laid out as `HeightLattice.address` says.

    NCC is the mean over all pairs of views and over the window sizes (the paper's SNCC, equation 2, for two views;
    for more it has no reference image, so that no single view's noise is in every term). seen : (2, i, r, c) int32,
    see `coverage`.
    """
    windows = np.unique([options.small_window // 2, options.large_window // 2])
    volume = np.empty(lattice.size, np.uint8)
    tile_costs(
        views.pixels, views.layout, views.nodes, views.heights, lattice.ranges, lattice.address, windows, seen,
        lattice.block, np.float32(options.noise**2), volume,
    )  # fmt: skip
    return volume
