"""The one decorator of every kernel: cache, thread and fast-math policy."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import config, njit

F = TypeVar("F", bound=Callable[..., Any])


def cache_folder(sources: Path) -> Path:
    """Where compiled kernels are kept: beside their sources, else in the user's cache, by the sources' content.

    Numba looks at the file of a kernel alone; a kernel holds the code of the kernels it calls, so a change in one file
    would leave stale copies in the others.
    """
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources.glob("*.py")))).hexdigest()[:16]
    beside = sources / "__pycache__"
    try:
        beside.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=beside):
            return beside / digest
    except OSError:
        return Path.home() / ".cache" / "zlocus" / digest


if not config.CACHE_DIR:  # type: ignore[attr-defined]
    config.CACHE_DIR = str(cache_folder(Path(__file__).parent))  # type: ignore[attr-defined]


def kernel(function: F) -> F:
    """Compiled on first use, cached on disk, releases the GIL, IEEE arithmetic."""
    return cast(F, njit(cache=True, nogil=True, error_model="numpy")(function))


def parallel_kernel(function: F) -> F:
    """As `kernel`, with `prange` on the outermost loop."""
    return cast(F, njit(cache=True, nogil=True, error_model="numpy", parallel=True)(function))
