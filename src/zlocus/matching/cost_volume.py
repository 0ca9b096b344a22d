"""The cost volume of a tile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import CostOptions, large_window_side
from zlocus.core.options.option_fields import value_of
from zlocus.matching.evidence import NO_EVIDENCE, TaughtHeights, learned_evidence
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import CostParameters, SlopeArrays, tile_costs
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews

# Share of the weight of grey differences in blocks that only two of three or more images cover: the grey values of one
# pair agree by chance at many heights.
GREY_SHARE_OF_ONE_PAIR = 0.3


def cost_volume(
    slope_views: TileViews,
    slope_surface: SlopeSurface,
    lattice: HeightLattice,
    visible: VisibleHeights,
    options: CostOptions,
    one_pair_share: float = GREY_SHARE_OF_ONE_PAIR,
    taught_heights: TaughtHeights | None = None,
) -> NDArray[np.uint8]:
    """Matching cost of every cell and height, (v,) uint8, in the order of `HeightLattice.layout`.

    slope_views : projections of slope indices, see `SlopeSurface.along`; visible : in slope indices; one_pair_share :
    see `cost_parameters`; taught_heights : heights from which the evidence of the images is learned.

    With such heights the cost of a height is the evidence against it, see `zlocus.matching.evidence`. Without them
    it is 64 (1 - NCC) + 64 w d.

    NCC is the mean over all pairs of views and over the window sizes. For two views and two window sizes it is the SNCC
    of the paper, equation 2. For more views there is no reference image, so that the noise of no single view is in
    every term. Blocks that more than `max_images_for_large_window` views cover take the smaller window only. d is the
    mean, over the same pairs, of the grey difference of the two pixels, in units of `max_grey_difference` and at most
    1. It is added because NCC finds nothing on roofs of one grey value and blurs edges by the width of its window
    (AD-Census adds grey differences for the same reason: Mei et al. 2011, equation 3). w is `grey_weight`, and
    less in blocks that only two of three or more views cover.
    """
    windows = np.unique([options.small_window // 2, large_window_side(options) // 2])
    volume, parameters = np.empty(lattice.size, np.uint8), cost_parameters(options, one_pair_share)
    slope, evidence = SlopeArrays(slope_surface.padded(int(windows.max())), slope_surface.nodes), NO_EVIDENCE
    if taught_heights is not None:
        evidence = learned_evidence(slope_views, slope, lattice, windows, visible, parameters, taught_heights)
    tile_costs(
        slope_views.arrays, slope, lattice.layout, windows, visible, parameters, evidence, volume
    )  # fmt: skip
    return volume


def cost_parameters(options: CostOptions, one_pair_share: float) -> CostParameters:
    """The options of the cost as the kernels take them.

    one_pair_share : share of the weight of grey differences in blocks that only two images cover.
    """
    return CostParameters(
        window_variance=np.float32(options.noise_deviation**2),
        grey_weight=np.float32(options.grey_weight),
        grey_weight_of_one_pair=np.float32(options.grey_weight * one_pair_share),
        max_grey_difference=np.float32(options.max_grey_difference),
        occluded_pairs_excluded=np.float32(value_of(options, "occluded_pairs_excluded")),
        max_images_for_large_window=options.max_images_for_large_window,
    )
