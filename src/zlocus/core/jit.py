"""The one decorator of every kernel: cache, thread and fast-math policy."""

from __future__ import annotations

import atexit
import hashlib
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import config, njit

from zlocus.core.errors import ZlocusWarning

F = TypeVar("F", bound=Callable[..., Any])
# A disk with less room than this takes no new folder of kernels: all of them have 12 MB.
ROOM_BYTES = 50_000_000


def cache_folder(sources: Path) -> Path | None:
    """First folder that compiled kernels can be kept in, named by the content of their sources; None where there is no
    such folder.

    It lies in NUMBA_CACHE_DIR where that is set, else beside the sources, else in the user's own cache. The content of
    all sources counts, because Numba looks at the file of a kernel alone: a kernel holds the code of the kernels that
    it calls, and a change in one file would leave stale copies in the others.
    """
    digest = digest_of(sources)
    return next((place / digest for place in _places(sources) if _takes_kernels(place, digest)), None)


def digest_of(sources: Path) -> str:
    """Name of the folder for the kernels of these sources: another content, another name."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources.glob("*.py")))).hexdigest()[:16]


def _places(sources: Path) -> Iterator[Path]:
    """Folders to keep kernels in, the preferred one first."""
    if config.CACHE_DIR:  # type: ignore[attr-defined]
        yield Path(config.CACHE_DIR)  # type: ignore[attr-defined]
    yield sources / "__pycache__"
    try:
        yield Path.home() / ".cache" / "zlocus"
    except RuntimeError:  # a user of whom the system knows no home
        return


def _takes_kernels(place: Path, digest: str) -> bool:
    """Whether files can be written to a folder, and to what an earlier run made in it."""
    try:
        place.mkdir(parents=True, exist_ok=True)
        kept = place / digest
        for folder in (place, kept, *kept.glob("*/")):
            if folder.exists():
                # Only an attempt tells for sure: permission bits say nothing of read-only disks.
                with tempfile.TemporaryFile(dir=folder):
                    pass
        return kept.exists() or shutil.disk_usage(place).free >= ROOM_BYTES
    except OSError:
        return False


class KernelCache:
    """Where this process keeps compiled kernels.

    folder : of the kernels; None where nothing can be written at all, and every process compiles for itself.
    temporary : what it lies in, where that goes with this process; workers of the process should use it too, by
    NUMBA_CACHE_DIR.
    """

    def __init__(self, sources: Path) -> None:
        self.folder = cache_folder(sources)
        self.temporary: Path | None = None
        if self.folder is not None:
            return
        try:
            self._removed = tempfile.TemporaryDirectory(prefix="zlocus-kernels-", ignore_cleanup_errors=True)
        except OSError:
            instead = "Nor is there a folder for temporary files, so every process of a run compiles them for itself."
        else:
            atexit.register(self._removed.cleanup)
            self.temporary = Path(self._removed.name)
            self.folder = self.temporary / digest_of(sources)
            instead = f"They are kept in {self.temporary} until this process ends."
        places = " or ".join(str(place) for place in _places(sources))
        warnings.warn(
            f"Compiled kernels cannot be kept in {places}. {instead} Set NUMBA_CACHE_DIR to a folder that can be "
            "written, so that the next run need not compile them again.",
            ZlocusWarning,
            stacklevel=2,
        )

    def remove_temporary(self) -> None:
        """Remove what goes with the process, of one that ends without its usual clean-up."""
        if self.temporary is not None:
            self._removed.cleanup()

    @contextmanager
    def in_use(self) -> Iterator[bool]:
        """Let Numba keep the functions that are decorated meanwhile here, and no others of this process; yields whether
        it can keep any."""
        before = config.CACHE_DIR  # type: ignore[attr-defined]
        config.CACHE_DIR = "" if self.folder is None else str(self.folder)  # type: ignore[attr-defined]
        try:
            yield self.folder is not None
        finally:
            config.CACHE_DIR = before  # type: ignore[attr-defined]


CACHE = KernelCache(Path(__file__).parent)


def kernel(function: F) -> F:
    """Compiled on first use, cached on disk, releases the GIL, IEEE arithmetic."""
    with CACHE.in_use() as is_kept:
        return cast(F, njit(cache=is_kept, nogil=True, error_model="numpy")(function))


def parallel_kernel(function: F) -> F:
    """As `kernel`, with `prange` on the outermost loop."""
    with CACHE.in_use() as is_kept:
        return cast(F, njit(cache=is_kept, nogil=True, error_model="numpy", parallel=True)(function))
