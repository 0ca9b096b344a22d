"""The one decorator of every kernel: cache, thread and fast-math policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compiled on first use, cached on disk, releases the GIL, IEEE arithmetic."""
    return cast("F", njit(cache=True, nogil=True, error_model="numpy")(function))


def parallel_kernel(function: F) -> F:
    """As `kernel`, with `prange` on the outermost loop."""
    return cast("F", njit(cache=True, nogil=True, error_model="numpy", parallel=True)(function))
