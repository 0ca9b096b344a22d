"""Run a command on given cores and measure its cost: `python launch.py USAGE CORES SECONDS COMMAND ...`.

This is a process of its own that adopts the processes which the command leaves behind (such as a server of workers that
ends a moment later), so that their CPU counts. `beside` is the share of the cores that other processes used meanwhile.
Memory is that of all processes of the command together; shared pages count once (proportional set size).
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
# Memory is sampled rarely, because that takes a tenth of a second if there are many processes.
POLL_S, SAMPLE_S, LINGER_S = 0.02, 0.5, 5.0
TOO_LONG = 124


def memory(process: psutil.Process) -> int:
    """Bytes of a process, shared pages divided among those that share them; 0 once it has ended."""
    with contextlib.suppress(psutil.Error, OSError):
        return int(process.memory_full_info().pss)
    return 0


def busy(cores: set[int]) -> float:
    """Seconds of CPU that all processes of the machine have had on some cores."""
    times = psutil.cpu_times(percpu=True)
    return sum(sum(times[core]) - times[core].idle - getattr(times[core], "iowait", 0.0) for core in cores)


def watch(process: subprocess.Popen[bytes], limit_s: float) -> tuple[int, int]:
    """Exit status, and the largest number of bytes of all processes together; they are stopped at the time limit."""
    itself, peak, start, sampled = psutil.Process(), 0, time.monotonic(), 0.0
    while process.poll() is None:
        now = time.monotonic()
        if now - sampled > SAMPLE_S:
            peak, sampled = max(peak, sum(memory(each) for each in itself.children(recursive=True))), now
        if now - start > limit_s:
            stop(itself)
            process.wait()
            return TOO_LONG, peak
        time.sleep(POLL_S)
    return process.returncode, peak


def stop(itself: psutil.Process) -> None:
    """End all processes of the command."""
    for each in itself.children(recursive=True):
        with contextlib.suppress(psutil.Error):
            each.kill()


def reap(itself: psutil.Process) -> None:
    """Wait for the remaining processes, and end those that do not end by themselves."""
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
    usage, listed, limit_s, *command = sys.argv[1:]
    cores = {int(core) for core in listed.split(",")}
    os.sched_setaffinity(0, cores)
    ctypes.CDLL(None).prctl(ADOPT, 1, 0, 0, 0)
    start, before = time.monotonic(), busy(cores)
    with subprocess.Popen(command) as process:
        status, peak = watch(process, float(limit_s))
        wall_s = time.monotonic() - start
    reap(psutil.Process())
    of_all, took = busy(cores) - before, time.monotonic() - start
    used, own = (resource.getrusage(who) for who in (resource.RUSAGE_CHILDREN, resource.RUSAGE_SELF))
    cpu_s = used.ru_utime + used.ru_stime
    beside = max(0.0, of_all - cpu_s - own.ru_utime - own.ru_stime) / (took * len(cores))
    found = {"status": status, "cpu_s": cpu_s, "wall_s": wall_s, "peak_gb": peak / 1024**3, "beside": beside}
    Path(usage).write_text(json.dumps(found))
    return status


if __name__ == "__main__":
    sys.exit(main())
