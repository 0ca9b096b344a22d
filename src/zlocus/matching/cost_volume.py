"""The cost volume of a tile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import CostOptions, large_window_side
from zlocus.core.options.option_fields import value_of
from zlocus.matching.evidence import NO_EVIDENCE, TaughtHeights, learned_evidence
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import CostParameters, SlopeArrays, tile_costs
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.level_records import TileInputs
from zlocus.matching.occlusion import PAIR
from zlocus.matching.prior_costs import COST_OF_CANDIDATES
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews

# Share of the weight of grey differences in blocks that only two of three or more images cover: the grey values of one
# pair agree by chance at many heights.
GREY_SHARE_OF_ONE_PAIR = 0.3
# In image space this share of the pairs of the reference image counts, the best ones: what one side of the reference
# does not show, because something nearer occludes it, the other side does (Kang, Szeliski, Chai 2001, section 4.1).
BEST_SHARE_OF_REFERENCE = 0.5


@dataclass(frozen=True)
class CountedPairs:
    """How the pairs of images count where costs are those of correlation.

    grey_share_of_one_pair : of the weight of grey differences, in blocks that only two images cover, see
    `cost_parameters`; best_share_of_reference : of three images or more those pairs count in which the reference image
    takes part, and of them this share, the best ones. None: the mean of all pairs counts.
    """

    grey_share_of_one_pair: float = GREY_SHARE_OF_ONE_PAIR
    best_share_of_reference: float | None = None

    @classmethod
    def of(cls, tile: TileInputs) -> CountedPairs:
        """In image space the best pairs of the reference image; grey differences count in full there, and where the
        scene has no more than two images."""
        is_image_space = tile.method == "gc3-sgm"
        is_usual = len(tile.match_scene.views) == PAIR or is_image_space
        return cls(1.0 if is_usual else GREY_SHARE_OF_ONE_PAIR, BEST_SHARE_OF_REFERENCE if is_image_space else None)


def cost_volume(
    slope_views: TileViews,
    slope_surface: SlopeSurface,
    lattice: HeightLattice,
    visible: VisibleHeights,
    options: CostOptions,
    counted_pairs: CountedPairs | None = None,
    taught_heights: TaughtHeights | None = None,
    known_costs: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Matching cost of every cell and height, (v,) uint8, in the order of `HeightLattice.layout`.

    slope_views : projections of slope indices, see `SlopeSurface.along`; visible : in slope indices; counted_pairs :
    None for those of a scene of many images on the ground; taught_heights : heights from which the evidence of the
    images is learned; known_costs : (v,) uint8, those of `costs_of_coarser`, to which the others are added.

    Where a height has the largest of the known costs in all cells of a block, the images are not compared: in a block
    with a tower and a street most heights lie between the two. This halves the time of the comparison in a town.

    With such heights the cost of a height is the evidence against it, see `zlocus.matching.evidence`. Without them
    it is 64 (1 - NCC) + 64 w d.

    NCC is the mean over all pairs of views and over the window sizes. For two views and two window sizes it is the SNCC
    of the paper, equation 2. For more views there is no reference image, so that the noise of no single view is in
    every term. Blocks that more than `max_images_for_large_window` views cover take the smaller window only. d is the
    mean, over the same pairs, of the grey difference of the two pixels, in units of `max_grey_difference` and at most
    1. It is added because NCC finds nothing on roofs of one grey value and blurs edges by the width of its window
    (AD-Census adds grey differences for the same reason: Mei et al. 2011, equation 3). w is `grey_weight`, and
    less in blocks that only two of three or more views cover. In image space both are means over the best pairs of the
    reference image, see `CountedPairs`.
    """
    windows = half_widths(options)
    volume = np.zeros(lattice.size, np.uint8) if known_costs is None else known_costs
    parameters = cost_parameters(options, counted_pairs or CountedPairs())
    slope, evidence = SlopeArrays(slope_surface.padded(int(windows.max())), slope_surface.nodes), NO_EVIDENCE
    if taught_heights is not None:
        evidence = learned_evidence(slope_views, slope, lattice, windows, visible, parameters, taught_heights)
    if known_costs is not None:
        evidence = evidence._replace(far_cost=np.uint8(COST_OF_CANDIDATES.max_cost))
    tile_costs(
        slope_views.arrays, slope, lattice.layout, windows, visible, parameters, evidence, volume
    )  # fmt: skip
    return volume


def half_widths(options: CostOptions) -> NDArray[np.int64]:
    """Half widths of the correlation windows, cells, ascending."""
    return np.unique([options.small_window // 2, large_window_side(options) // 2])


def cost_parameters(options: CostOptions, counted_pairs: CountedPairs) -> CostParameters:
    """The options of the cost as the kernels take them."""
    best_share = counted_pairs.best_share_of_reference
    return CostParameters(
        window_variance=np.float32(options.noise_deviation**2),
        grey_weight=np.float32(options.grey_weight),
        grey_weight_of_one_pair=np.float32(options.grey_weight * counted_pairs.grey_share_of_one_pair),
        max_grey_difference=np.float32(options.max_grey_difference),
        occluded_pairs_excluded=np.float32(value_of(options, "occluded_pairs_excluded")),
        max_images_for_large_window=options.max_images_for_large_window,
        best_share_of_reference=np.float32(0.0 if best_share is None else best_share),
    )
