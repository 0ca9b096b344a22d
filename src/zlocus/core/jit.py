"""The one decorator of every kernel: cache, thread and fast-math policy."""

from __future__ import annotations

import atexit
import hashlib
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import config, njit

from zlocus.core.errors import ZlocusWarning
from zlocus.core.lazy_kernels import KernelFiles, LazyKernel

F = TypeVar("F", bound=Callable[..., Any])
# A disk with less room than this takes no new folder of compiled kernels; all kernels together take 12 MB.
MIN_FREE_BYTES = 50_000_000
# Empty file in the folder of kernels that were all compiled in advance.
COMPLETE = "complete"
# Files of the package whose content compiled kernels depend on: Numba looks at a kernel's own file alone, but a kernel
# contains the code of the kernels that it calls and the values of the constants that it uses.
KERNEL_FILES = (
    "core/jit.py", "core/lazy_kernels.py", "*/kernels/*.py", "products/shade_kernel.py", "sensors/*_kernel.py",
    "synthetic/*.py",
)  # fmt: skip


def cache_folder(package: Path) -> Path | None:
    """The first folder that compiled kernels can be kept in; None without any.

    package : folder of the package. The cache lies in NUMBA_CACHE_DIR where that is set, else in the package, else in
    the user's own cache.
    """
    name = _folder_name(package)
    return next((place / name for place in _places(package) if _takes_kernels(place, name)), None)


def kernels_digest(package: Path) -> str:
    """Checksum of the sources of all kernels of a package."""
    files = sorted({path for pattern in KERNEL_FILES for path in package.glob(pattern)})
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def _folder_name(package: Path) -> str:
    """Name of the cache folder: other sources of kernels give another one, and so does another Numba, because two
    environments may share a package, and one cannot read the machine code of the other."""
    return f"{kernels_digest(package)}-numba-{numba.__version__}"


def _places(package: Path) -> Iterator[Path]:
    """Folders in which kernels may be kept, the preferred one first."""
    if config.CACHE_DIR:  # type: ignore[attr-defined]
        yield Path(config.CACHE_DIR)  # type: ignore[attr-defined]
    yield package / "__pycache__"
    try:
        yield Path.home() / ".cache" / "zlocus"
    except RuntimeError:  # the system knows no home of this user
        return


def _takes_kernels(place: Path, name: str) -> bool:
    """Whether files can be written to a folder, and to the folders that an earlier run made in it."""
    try:
        place.mkdir(parents=True, exist_ok=True)
        kept = place / name
        for folder in (place, kept, *kept.glob("*/")):
            if folder.exists():
                # Only an attempt tells for sure: permission bits say nothing of read-only disks.
                with tempfile.TemporaryFile(dir=folder):
                    pass
        return kept.exists() or shutil.disk_usage(place).free >= MIN_FREE_BYTES
    except OSError:
        return False


class KernelCache:
    """Where this process keeps compiled kernels.

    folder : of the kernels; None where nothing can be written at all, so that every process compiles for itself.
    temporary : the temporary folder that holds them, where no lasting one can be written; it is removed when this
    process ends. Workers of the process use it too, by NUMBA_CACHE_DIR.
    """

    def __init__(self, package: Path) -> None:
        self.folder = cache_folder(package)
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
            self.folder = self.temporary / _folder_name(package)
            instead = f"They are kept in {self.temporary} until this process ends."
        places = " or ".join(str(place) for place in _places(package))
        warnings.warn(
            f"Compiled kernels cannot be kept in {places}. {instead} Set NUMBA_CACHE_DIR to a folder that can be "
            "written, so that the next run need not compile them again.",
            ZlocusWarning,
            stacklevel=2,
        )

    @property
    def is_complete(self) -> bool:
        """Whether all kernels of the package were compiled in advance and kept."""
        return self.folder is not None and (self.folder / COMPLETE).exists()

    def mark_complete(self) -> None:
        """Remember that all kernels were compiled in advance and kept; without a folder nothing is remembered."""
        if self.folder is not None:
            with suppress(OSError):
                (self.folder / COMPLETE).touch()

    def remove_temporary(self) -> None:
        """Remove the temporary folder, for a process that ends without its usual clean-up."""
        if self.temporary is not None:
            self._removed.cleanup()

    @contextmanager
    def in_use(self) -> Iterator[bool]:
        """Let Numba keep the functions that are decorated inside the block in this cache, and restore its own folder.

        Yields whether it can keep any.
        """
        before = config.CACHE_DIR  # type: ignore[attr-defined]
        config.CACHE_DIR = "" if self.folder is None else str(self.folder)  # type: ignore[attr-defined]
        try:
            yield self.folder is not None
        finally:
            config.CACHE_DIR = before  # type: ignore[attr-defined]


CACHE = KernelCache(Path(__file__).parents[1])


def kernel(function: F) -> F:
    """Decorate a kernel: compiled on first use, cached on disk, releases the GIL, IEEE arithmetic."""
    return cast(F, function if config.DISABLE_JIT else LazyKernel(function, _dispatcher))  # type: ignore[attr-defined]


def _dispatcher(function: Callable[..., Any]) -> Any:
    """What Numba makes of a kernel, with its cache on disk where one can be kept."""
    dispatcher: Any = njit(nogil=True, error_model="numpy")(function)
    with CACHE.in_use() as is_kept:
        if is_kept:
            dispatcher._cache = KernelFiles(function)
    return dispatcher
