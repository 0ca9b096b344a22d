"""The cost volume of a tile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import MeasureOptions
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import tile_costs
from zlocus.matching.slope_surface import BaseSurface
from zlocus.matching.tile_views import TileViews


def cost_volume(
    views: TileViews,
    base: BaseSurface,
    lattice: HeightLattice,
    seen: NDArray[np.int32],
    options: MeasureOptions,
    is_pair: bool = False,
) -> NDArray[np.uint8]:
    """64 (1 - NCC) + 64 w d of every cell and height, (v,) uint8, laid out as `HeightLattice.address` says.

    views : whose nodes follow `base`, see `BaseSurface.shear`. NCC is the mean over all pairs of views and over the
    window sizes, of which there is one where more than `few_views` cover a block (the paper's SNCC, equation 2, for two
    views; for more it has no reference image, so that no single view's noise is in every term). d is the mean over the
    same pairs of the two pixels' grey difference, in units of `grey_reach` and at most 1: NCC knows nothing of plain
    roofs, on which all views show one grey, and blurs edges by the width of its window (as AD-Census does: Mei et al.
    2011, equation 3). w is `grey_weight`, and `grey_weight_two` in blocks that two views take part in, unless there
    are no more (is_pair). seen : (3, i, r, c) int32, see `coverage`.
    """
    windows = np.unique([options.small_window // 2, options.large_window // 2])
    greys = options.grey_weight, options.grey_reach, options.hidden_excused
    weight_two = options.grey_weight if is_pair else options.grey_weight_two
    measure = np.array([options.noise**2, *greys, options.few_views, weight_two], np.float32)
    volume = np.empty(lattice.size, np.uint8)
    tile_costs(
        views.pixels, views.layout, views.nodes, views.heights, base.padded(int(windows.max())), base.nodes,
        lattice.ranges, lattice.address, windows, seen, lattice.block, measure, volume,
    )  # fmt: skip
    return volume
