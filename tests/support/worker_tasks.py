"""What tests give to workers in other processes, which must be able to import it."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zlocus.core.errors import InputError


@dataclass(frozen=True)
class Planted:
    """Squares a number; some numbers fail: while fewer than `passes_after` attempts at them were made.

    folder : where attempts are counted, for workers that die. kill, exhaust, miss, break_ : numbers that kill their
    process, run out of memory, find no input, and are a fault.
    """

    folder: Path
    kill: tuple[int, ...] = ()
    exhaust: tuple[int, ...] = ()
    miss: tuple[int, ...] = ()
    break_: tuple[int, ...] = ()
    passes_after: int = 10**6

    def __call__(self, number: int) -> tuple[int, int]:
        """The square, and the process that found it."""
        counted = self.folder / str(number)
        with counted.open("a") as file:
            file.write("x")
        if counted.stat().st_size <= self.passes_after:
            self._fail(number)
        return number * number, os.getpid()

    def _fail(self, number: int) -> None:
        if number in self.kill:
            os.kill(os.getpid(), signal.SIGKILL)
        if number in self.exhaust:
            raise MemoryError
        if number in self.miss:
            raise InputError("a.tif is gone. Bring it back.")
        if number in self.break_:
            raise IndexError("index 7 is out of bounds")

    def attempts(self, number: int) -> int:
        """How often a number was tried."""
        counted = self.folder / str(number)
        return counted.stat().st_size if counted.exists() else 0


@dataclass(frozen=True)
class Hungry:
    """Takes more memory than its process may have, for one number."""

    number: int
    more_mb: int = 300

    def __call__(self, number: int) -> int:
        """The number."""
        import resource

        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + self.more_mb * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]))
        try:
            return int(np.ones((self.more_mb + 100 if number == self.number else 1) * 2**20, np.uint8)[0]) * number
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


@dataclass(frozen=True)
class Compiling:
    """Calls a kernel, and tells where its code was kept."""

    def __call__(self, number: int) -> tuple[str, list[str]]:
        """Folder of the kernels, and the files of code in it."""
        from zlocus.core.jit import CACHE
        from zlocus.products.shade_kernel import across

        assert across(float(number), 2.0, 1.0) == 1.0
        return str(CACHE.folder), sorted(path.name for path in CACHE.folder.rglob("*.nbc"))


@dataclass(frozen=True)
class Sleeping:
    """Takes its time."""

    seconds: float

    def __call__(self, number: int) -> int:
        """The number."""
        time.sleep(self.seconds)
        return number
