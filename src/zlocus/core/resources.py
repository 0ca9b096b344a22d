"""Memory and cores that a run may use."""

from __future__ import annotations

import os
import resource
import sys
from contextlib import suppress
from pathlib import Path

# Share of the free memory that a run takes by default.
DEFAULT_MEMORY_SHARE = 0.6
# Memory that the first tile adds to a process beside its own: compiled kernels and GDAL's block cache. And the memory
# of a worker before its first tile, Python and libraries included.
TILE_CODE_BYTES, WORKER_BYTES = 80e6, 280e6
CGROUP = Path("/sys/fs/cgroup")
STATUS = Path("/proc/self/status")


def free_bytes() -> float:
    """Free memory of the machine, or of the container where that is less."""
    import psutil

    return float(min(psutil.virtual_memory().available, *_left_in_container()))


def held_bytes() -> float:
    """Memory that this process holds."""
    import psutil

    return float(psutil.Process().memory_info().rss)


def _left_in_container() -> list[float]:
    """Memory left by the limits of control groups (version 2, then 1); empty without limits."""
    found = []
    for limit, used in (
        ("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):  # fmt: skip
        try:
            found.append(float((CGROUP / limit).read_text()) - float((CGROUP / used).read_text()))
        except (OSError, ValueError):  # none, or "max"
            continue
    return found


def peak_memory_mb() -> float:
    """Most memory this process has held so far, MB."""
    with suppress(OSError):  # where there is no /proc
        # The count of `getrusage` starts with the memory of the parent process.
        for line in STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1.024e-3
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1.024e-3


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
