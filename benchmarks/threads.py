"""Gain of a second thread: for each kernel, and for the whole program.

On a shared machine a wall time says little. Therefore the tables also show the CPU seconds that the two threads got per
second of wall time (2 on a quiet machine with two cores), and the ratio of the CPU of a thread beside another one to
its CPU alone. Two divided by this ratio is the gain of two threads when both cores are free.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bench_kernels import Case

BAR = 1.8
PAIRS, RUN_SECONDS = 8, 0.15
STRIPS = ("n1", "f1", "b1", "n2", "f2", "b2")


@dataclass(frozen=True)
class Run:
    """Threads that do the same work: wall time until the last one ends, and CPU time of the slowest, s."""

    wall_s: float
    cpu_s: float


def run_together(cases: list[Case], calls: int) -> Run:
    """Time some calls of each case, each case in a thread of its own."""
    cpu = [0.0] * len(cases)
    ready = threading.Barrier(len(cases) + 1)

    def work(number: int) -> None:
        ready.wait()
        start = time.thread_time()
        for _ in range(calls):
            cases[number].call()
        cpu[number] = time.thread_time() - start

    running = [threading.Thread(target=work, args=(number,)) for number in range(len(cases))]
    for thread in running:
        thread.start()
    ready.wait()
    start = time.perf_counter()
    for thread in running:
        thread.join()
    return Run(time.perf_counter() - start, max(cpu))


def kernels_on_two(cases: dict[str, Callable[[], Case]], seconds: float = RUN_SECONDS) -> None:
    """Print the best times of each kernel with one and with two threads. seconds : approximate time of a run."""
    print("\n| kernel | two threads over one, wall | CPU per wall | the same from CPU: 2 x alone / beside the other |")
    print("|---|---|---|---|")
    for name, make in cases.items():
        two = [make(), make()]
        for case in two:
            case.call()
        start = time.perf_counter()
        two[0].call()
        calls = max(1, round(seconds / (time.perf_counter() - start)))
        runs = [(run_together(two[:1], calls), run_together(two, calls)) for _ in range(PAIRS)]
        alone, both = min(a.wall_s for a, _ in runs), min((b for _, b in runs), key=lambda run: run.wall_s)
        clean = 2 * min(a.cpu_s for a, _ in runs) / min(b.cpu_s for _, b in runs)
        gain, got = 2 * alone / both.wall_s, 2 * both.cpu_s / both.wall_s
        print(f"| {name} | {gain:.2f} | {got:.2f} | {clean:.2f} |", flush=True)


def program_on_two(scene: Path, rounds: int = 2) -> None:
    """Print wall time and CPU of each stage of `zlocus dsm` with one and with two workers, of the best run of each.

    rounds : runs with each number of workers, after a run that compiles.
    """
    images = [image for name in STRIPS if (image := scene / f"img_{name}.tif").exists()]
    best: dict[int, tuple[float, float, list[dict]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out"
        for turn in range(2 * rounds + 1):  # the first compiles
            workers = 1 + turn % 2
            shutil.rmtree(out, ignore_errors=True)
            command = [sys.executable, "-c", "from zlocus.cli.app import main; main()", "dsm", *map(str, images)]
            command += ["-o", str(out), "--like", str(scene / "truth_dsm.tif"), "--workers", str(workers)]
            start = time.perf_counter()
            done = subprocess.run(command, capture_output=True, text=True)
            wall = time.perf_counter() - start
            if done.returncode:
                raise SystemExit(f"zlocus dsm exits {done.returncode}: {done.stderr.strip().splitlines()[-1]}")
            stages = json.loads((out / "run.json").read_text())["stages"]
            if turn and (workers not in best or wall < best[workers][0]):
                best[workers] = wall, sum(stage["cpu_s"] for stage in stages), stages
    print("\n| stage | wall, 1 worker | CPU | wall, 2 workers | CPU | gain |\n|---|---|---|---|---|---|")
    (wall, cpu, one), (wall_2, cpu_2, two) = best[1], best[2]
    rows = [(a["name"], a["wall_s"], a["cpu_s"], b["wall_s"], b["cpu_s"]) for a, b in zip(one, two, strict=True)]
    for name, *figures in [*rows, ("all, with start and imports", wall, cpu, wall_2, cpu_2)]:
        gain = figures[0] / figures[2] if figures[2] else float("nan")
        print(f"| {name} | {' | '.join(f'{figure:.1f}' for figure in figures)} | {gain:.2f} |")
    serial = cpu - next(stage["cpu_s"] for stage in one if stage["name"] == "match")
    print(
        f"\nOutside matching: {serial / cpu:.0%} of the CPU of one worker; were matching alone twice as fast, the "
        f"whole would gain {cpu / (serial + (cpu - serial) / 2):.2f}. Bar: {BAR}."
    )
