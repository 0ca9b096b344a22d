"""Surfaces from images by multi-view vertical line locus matching."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

__all__ = ["LocusStack", "__version__", "locus_stack", "match", "open_scene", "open_surface", "orient", "semiglobal"]

if TYPE_CHECKING:
    from zlocus.api import LocusStack, locus_stack, match, open_scene, open_surface, orient, semiglobal


def __getattr__(name: str) -> Any:
    """The functions of `zlocus.api`, imported when the first is asked for: the command line is quick without them."""
    if name not in __all__:
        raise AttributeError(f"module 'zlocus' has no attribute {name!r}")
    from zlocus import api

    return getattr(api, name)
