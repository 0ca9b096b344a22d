"""The configuration of a whole run: one options class per stage."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.cost_options import CostOptions
from zlocus.core.options.height_options import CheckOptions, PlaneOptions, RefineOptions
from zlocus.core.options.option_fields import Checked, group
from zlocus.core.options.orientation_options import OrientationOptions
from zlocus.core.options.product_options import ProductOptions
from zlocus.core.options.search_options import PyramidOptions
from zlocus.core.options.selection_options import SelectionOptions
from zlocus.core.options.semiglobal_options import SemiGlobalOptions
from zlocus.core.options.water_options import WaterOptions


@dataclass(frozen=True)
class RunConfig(Checked):
    """A whole run."""

    orientation: OrientationOptions = group(OrientationOptions, "Tie points and pointing corrections.")
    pyramid: PyramidOptions = group(PyramidOptions, "Levels, tiles and ranges of heights.")
    cost: CostOptions = group(CostOptions, "Matching cost: how images are compared.")
    selection: SelectionOptions = group(SelectionOptions, "Which images a block is matched with.")
    semiglobal: SemiGlobalOptions = group(SemiGlobalOptions, "Semi-global constraint.")
    refine: RefineOptions = group(RefineOptions, "Sub-step refinement.")
    planes: PlaneOptions = group(PlaneOptions, "Planes through plain segments.")
    checks: CheckOptions = group(CheckOptions, "Empty and doubtful cells.")
    water: WaterOptions = group(WaterOptions, "Levels of water surfaces, and possible water.")
    products: ProductOptions = group(ProductOptions, "Maps made of the surface.")
