"""Surfaces from images by multi-view vertical line locus matching."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

__all__ = [
    "LocusStack", "__version__", "locus_stack", "match", "ncc_cost", "open_scene", "open_surface", "orient",
    "semiglobal", "true_ortho",
]  # fmt: skip

if TYPE_CHECKING:
    from zlocus.api import (
        LocusStack,
        locus_stack,
        match,
        ncc_cost,
        open_scene,
        open_surface,
        orient,
        semiglobal,
        true_ortho,
    )


def __getattr__(name: str) -> Any:
    """The functions of `zlocus.api`, imported when the first is asked for: the command line is quick without them."""
    if name not in __all__:
        raise AttributeError(f"module 'zlocus' has no attribute {name!r}")
    from zlocus import api

    return getattr(api, name)
