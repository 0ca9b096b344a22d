"""The cost volume of a tile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import CostOptions, large_window_side
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import tile_costs
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews


def cost_volume(
    views: TileViews,
    base: SlopeSurface,
    lattice: HeightLattice,
    seen: NDArray[np.int32],
    options: CostOptions,
    is_pair: bool = False,
) -> NDArray[np.uint8]:
    """64 (1 - NCC) + 64 w d of every cell and height, (v,) uint8, laid out as `HeightLattice.address` says.

    views : whose nodes follow `base`, see `SlopeSurface.shear`. NCC is the mean over all pairs of views and over the
    window sizes, of which there is one where more than `max_images_for_large_window` cover a block (the paper's SNCC, equation 2, for two
    views; for more it has no reference image, so that no single view's noise is in every term). d is the mean over the
    same pairs of the two pixels' grey difference, in units of `max_grey_difference` and at most 1: NCC knows nothing of plain
    roofs, on which all views show one grey, and blurs edges by the width of its window (as AD-Census does: Mei et al.
    2011, equation 3). w is `grey_weight`, and `grey_weight_two_images` in blocks that two views take part in, unless there
    are no more (is_pair). seen : (3, i, r, c) int32, see `coverage`.
    """
    windows = np.unique([options.small_window // 2, large_window_side(options) // 2])
    greys = options.grey_weight, options.max_grey_difference, options.occluded_pairs_excluded
    weight_two = options.grey_weight if is_pair else options.grey_weight_two_images
    measure = np.array([options.noise_deviation**2, *greys, options.max_images_for_large_window, weight_two], np.float32)
    volume = np.empty(lattice.size, np.uint8)
    tile_costs(
        views.pixels, views.layout, views.nodes, views.heights, base.padded(int(windows.max())), base.nodes,
        lattice.ranges, lattice.address, windows, seen, lattice.block, measure, volume,
    )  # fmt: skip
    return volume
