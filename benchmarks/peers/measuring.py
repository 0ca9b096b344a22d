"""Cost of a command on given cores: CPU and memory of all its processes, and wall time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LAUNCH = Path(__file__).with_name("launch.py")
LIMIT_S = 3 * 3600.0
# Libraries get as many threads as there are cores.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class Failed(Exception):
    """A program failed; the message names it, its exit status and its log."""


@dataclass(frozen=True)
class Usage:
    """Cost of a command. peak_gb : GB of 1024^3 bytes; beside : share of the cores used by other processes."""

    cpu_s: float = 0.0
    wall_s: float = 0.0
    peak_gb: float = 0.0
    beside: float = 0.0

    def __add__(self, other: Usage) -> Usage:
        wall_s = self.wall_s + other.wall_s
        beside = (self.beside * self.wall_s + other.beside * other.wall_s) / wall_s if wall_s else 0.0
        return Usage(self.cpu_s + other.cpu_s, wall_s, max(self.peak_gb, other.peak_gb), beside)


def measured(
    command: Sequence[Any],
    cores: Sequence[int],
    log: Path,
    cwd: Path | None = None,
    limit_s: float = LIMIT_S,
    accept: Sequence[int] = (0,),
) -> Usage:
    """Run a command with its output in a log file, and measure it.

    Raises
    ------
    Failed
        The exit status is not one of `accept`.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | dict.fromkeys(THREADS, str(len(cores)))
    with tempfile.TemporaryDirectory() as scratch, log.open("wb") as said:
        usage = Path(scratch) / "usage.json"
        launch = [sys.executable, LAUNCH, usage, ",".join(map(str, cores)), limit_s, *command]
        done = subprocess.run(
            [str(word) for word in launch], stdout=said, stderr=subprocess.STDOUT, cwd=cwd, env=environment
        )
        found = json.loads(usage.read_text()) if usage.exists() else {"status": done.returncode}
    if found["status"] not in accept:
        last = [line for line in log.read_text(errors="replace").splitlines() if line.strip()][-1:] or ["nothing said"]
        raise Failed(f"{Path(str(command[0])).name} ended with {found['status']} ({last[0].strip()}); see {log}")
    return Usage(found["cpu_s"], found["wall_s"], found["peak_gb"], found["beside"])
