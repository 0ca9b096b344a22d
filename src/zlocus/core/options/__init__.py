"""Everything that can be tuned: one frozen class per stage, nested in `RunConfig`.

Each field carries its unit and one sentence in its metadata. `zlocus config` writes them as a commented file. Values
outside the allowed range are refused with the name of the field, the value and the range.
"""

from zlocus.core.options.cost_options import CostOptions, large_window_side
from zlocus.core.options.height_options import CheckOptions, PlaneOptions, RefineOptions
from zlocus.core.options.orientation_options import BundleAdjustmentOptions, OrientationOptions
from zlocus.core.options.product_options import ProductOptions
from zlocus.core.options.run_config import RunConfig
from zlocus.core.options.search_options import PyramidOptions
from zlocus.core.options.selection_options import SelectionOptions
from zlocus.core.options.semiglobal_options import SemiGlobalOptions
from zlocus.core.options.water_options import WaterOptions

__all__ = [
    "BundleAdjustmentOptions",
    "CheckOptions",
    "CostOptions",
    "OrientationOptions",
    "PlaneOptions",
    "ProductOptions",
    "PyramidOptions",
    "RefineOptions",
    "RunConfig",
    "SelectionOptions",
    "SemiGlobalOptions",
    "WaterOptions",
    "large_window_side",
]
