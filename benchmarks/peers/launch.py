"""Runs a command on given cores and says what it took: `python launch.py USAGE CORES SECONDS COMMAND ...`.

In a process of its own, which adopts what the command leaves behind (a server of workers outlives it by a moment),
so that CPU counts whatever it started. Memory is that of all its processes together, shared pages once
(proportional set size).
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import psutil

ADOPT = 36  # PR_SET_CHILD_SUBREAPER
SAMPLE_S, LINGER_S = 0.25, 5.0
TOO_LONG = 124


def memory(process: psutil.Process) -> int:
    """Bytes of a process, shared pages divided among those that share them; 0 once it has ended."""
    with contextlib.suppress(psutil.Error, OSError):
        return int(process.memory_full_info().pss)
    return 0


def watch(process: subprocess.Popen[bytes], limit_s: float) -> tuple[int, int]:
    """Exit status and the most bytes that all processes held at once; stops them when time is up."""
    itself, peak, start = psutil.Process(), 0, time.monotonic()
    while process.poll() is None:
        peak = max(peak, sum(memory(each) for each in itself.children(recursive=True)))
        if time.monotonic() - start > limit_s:
            stop(itself)
            process.wait()
            return TOO_LONG, peak
        time.sleep(SAMPLE_S)
    return process.returncode, peak


def stop(itself: psutil.Process) -> None:
    """Ends all that was started."""
    for each in itself.children(recursive=True):
        with contextlib.suppress(psutil.Error):
            each.kill()


def reap(itself: psutil.Process) -> None:
    """Waits for what was left behind, and ends what does not end by itself."""
    until = time.monotonic() + LINGER_S
    while True:
        try:
            found, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if not found:
            if time.monotonic() > until:
                stop(itself)
            time.sleep(0.05)


def main() -> int:
    usage, cores, limit_s, *command = sys.argv[1:]
    os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    ctypes.CDLL(None).prctl(ADOPT, 1, 0, 0, 0)
    start = time.monotonic()
    with subprocess.Popen(command) as process:
        status, peak = watch(process, float(limit_s))
        wall_s = time.monotonic() - start
    reap(psutil.Process())
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = {"status": status, "cpu_s": used.ru_utime + used.ru_stime, "wall_s": wall_s, "peak_gb": peak / 1024**3}
    Path(usage).write_text(json.dumps(found))
    return status


if __name__ == "__main__":
    sys.exit(main())
