"""Surfaces from images by multi-view vertical line locus matching."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Any

    from zlocus.api import (
        evaluate,
        find_ties,
        locus_stack,
        match,
        ncc_cost,
        open_scene,
        open_surface,
        orient,
        read_config,
        semiglobal,
        true_ortho,
    )
    from zlocus.api import (
        open as open,
    )
    from zlocus.core.errors import (
        ConfigError,
        CoverageError,
        GeometryError,
        InputError,
        OutputError,
        StoppedError,
        TileError,
        ZlocusError,
        ZlocusNote,
        ZlocusWarning,
    )
    from zlocus.core.notebook_progress import NotebookProgress
    from zlocus.core.options import (
        BundleAdjustmentOptions,
        CheckOptions,
        CostOptions,
        OrientationOptions,
        PlaneOptions,
        ProductOptions,
        PyramidOptions,
        RefineOptions,
        RunConfig,
        SelectionOptions,
        SemiGlobalOptions,
        WaterOptions,
    )
    from zlocus.core.progress import BarProgress, LineProgress, SilentProgress
    from zlocus.core.scene import Scene
    from zlocus.evaluation.evaluate import Evaluation
    from zlocus.matching.array_stages import LocusStack
    from zlocus.matching.quality import Quality, is_empty
    from zlocus.matching.semiglobal import SemiGlobalHeights
    from zlocus.orientation.orientation import Orientation
    from zlocus.orientation.ties import Ties

__version__ = "0.1.0"

# `open` is left out, so that `from zlocus import *` leaves Python's own `open` alone.
__all__ = [
    "BarProgress", "BundleAdjustmentOptions", "CheckOptions", "ConfigError", "CostOptions", "CoverageError",
    "Evaluation", "GeometryError", "InputError", "LineProgress", "LocusStack", "NotebookProgress", "Orientation",
    "OrientationOptions", "OutputError", "PlaneOptions", "ProductOptions", "PyramidOptions", "Quality",
    "RefineOptions", "RunConfig", "Scene", "SelectionOptions", "SemiGlobalHeights", "SemiGlobalOptions",
    "SilentProgress", "StoppedError", "Ties", "TileError", "WaterOptions", "ZlocusError", "ZlocusNote",
    "ZlocusWarning", "__version__", "evaluate", "find_ties", "is_empty", "locus_stack", "match", "ncc_cost",
    "open_scene", "open_surface", "orient", "read_config", "semiglobal", "true_ortho",
]  # fmt: skip
# Modules from which names are taken when they are asked for; all other names are those of `zlocus.api`.
_MODULES = {
    "zlocus.core.errors": (
        "ConfigError", "CoverageError", "GeometryError", "InputError", "OutputError", "StoppedError", "TileError",
        "ZlocusError", "ZlocusNote", "ZlocusWarning",
    ),
    "zlocus.core.notebook_progress": ("NotebookProgress",),
    "zlocus.core.options": ("RunConfig", *(name for name in __all__ if name.endswith("Options"))),
    "zlocus.core.progress": ("BarProgress", "LineProgress", "SilentProgress"),
    "zlocus.core.scene": ("Scene",),
    "zlocus.evaluation.evaluate": ("Evaluation",),
    "zlocus.matching.array_stages": ("LocusStack",),
    "zlocus.matching.quality": ("Quality", "is_empty"),
    "zlocus.matching.semiglobal": ("SemiGlobalHeights",),
    "zlocus.orientation.orientation": ("Orientation",),
    "zlocus.orientation.ties": ("Ties",),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """A name of `__dir__`, imported when it is first asked for: the command line is quick without most of them."""
    if name not in __all__ and name != "open":
        raise AttributeError(f"module 'zlocus' has no attribute {name!r}")
    found = getattr(import_module(_MODULE_OF.get(name, "zlocus.api")), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """All names, also those that have not been imported yet."""
    own = {"TYPE_CHECKING", "annotations", "import_module", "_MODULES", "_MODULE_OF"}
    return sorted({*__all__, "open", *globals()} - own)
