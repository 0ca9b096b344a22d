"""Bound of each kernel on this machine, the speed that it reaches, and the gain of a second thread.

    python benchmarks/roofline.py [--no-threads] [--program FOLDER [--rounds N]] [--kernels NAME ...] [--seconds S]
                                  [--rates N]

Operations are counted in `roofline_counts.py`, the rates of the machine are measured (`machine.py`), and kernels run on
the scenes of `bench_kernels.py`. Times are CPU times of the thread, the best of several short runs: each kernel runs
for S seconds, each rate N times. A kernel that is faster than its bound shows a wrong count: exit status 1. NAME
selects the kernels whose names begin with it. FOLDER is a rendered scene, on which the whole program runs with one and
with two workers, N rounds each; the best round counts.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bench_kernels as bench
from bench_kernels import SGM_SIDE, SIDE, Case
from machine import IN_L1, IN_L2, IN_L3, IN_MEMORY, RUNS, Machine, measured
from roofline_counts import MGM, ORTHO, REACH, RESAMPLE, SGM, SMOOTH, SPLINE, VISIBILITY, WINNERS, Count, costs, profile
from threads import RUN_SECONDS, kernels_on_two, program_on_two

SECONDS, FEWEST_RUNS = 1.5, 5
ROUNDS = 2
# So often the rates of the machine are measured again where a kernel seems to be faster than they allow.
MORE_RATES = 5
STEPS = 32
# Tolerance for noise: a kernel that needs less than this share of its bound has a wrong count.
TOLERANCE = 1.05


@dataclass(frozen=True)
class Kernel:
    """A line of the table. size : bytes of the arrays; lost : reason why the kernel does not reach its bound."""

    name: str
    case: Callable[[], Case]
    count: Count
    size: int
    lost: str


CELLS, SUM_CELLS = SIDE * SIDE, SGM_SIDE * SGM_SIDE
# The reasons were found once, on the machine that README.md names, by measurements and in the compiled code.
COSTS = (
    "resampling (2.6 ns with its border; 2.9 with that of 5 x 5) loads from one index after the other; then planes of "
    "all images (32 KB an image with two windows) are read and written from the second cache, and 1 / sqrt takes 0.4 "
    "ns a window"
)
SGM_LOST = (
    "47 ns a cell whatever its heights (76 ns with 16, 163 with 64: minima across lanes, ends of loops, pointers); the "
    "row before lies in the second cache (450 KB with 64)"
)
MGM_LOST = "some 200 ns a cell whatever its heights; volumes and sheets larger than the caches: see below"
SEEN_LOST = "scalar code: places in float64 turned into indices, a branch a cell"
REACH_LOST = (
    "`lengthen` (1.1 ns) is compiled to masked stores, which this processor does slowly; `step_cells` (1.4 ns) is "
    "float64, its verdicts narrowed to int32"
)
KERNELS = (
    Kernel(
        "resample_plane", bench.resample_case, RESAMPLE, IN_L1,
        "loads at an index (0.9 ns) are scalar code and stored to be read again; positions (0.7 ns) and interpolation "
        "(0.6 ns) are vectors",
    ),
    *(
        Kernel(
            f"tile_costs, {views} views, {name}",
            lambda views=views, windows=windows: bench.costs_case(views, windows, 1.0),
            costs(views, windows, STEPS), CELLS * (STEPS + 16 * views), COSTS,
        )
        for views in (3, 6)
        for name, windows in (("3 x 3", [1]), ("3 x 3 and 5 x 5", [1, 2]))
    ),
    *(
        Kernel(f"sgm.sweep, {n} heights", lambda n=n: bench.sgm_case(n), SGM, SUM_CELLS * n * 3, SGM_LOST)
        for n in (16, 64)
    ),
    *(
        Kernel(f"mgm.sweep_quarter, {n} heights", lambda n=n: bench.mgm_case(n), MGM, SUM_CELLS * n * 3, MGM_LOST)
        for n in (16, 64)
    ),
    Kernel(
        "winners, ragged", lambda: bench.winners_case(None), WINNERS, SUM_CELLS * 40 * 2,
        "some 60 ns a cell whatever its heights: two minima across lanes, ends of loops, the parabola; 0.6 ns a step",
    ),
    Kernel(
        "tile_profile, 5 x 5 and 9 x 9, 3 views", bench.profile_case, profile([2, 4], 3, 3), CELLS * (4 * 3 + 3 * 16),
        "the 35 operations on 4 x 4 pixels are scalar code (6.3 ns with the border); 9 rows are summed anew for every "
        "cell (moments 2.2 ns, pairs 2.3 ns)",
    ),
    Kernel(
        "smooth_surface", bench.smooth_case, SMOOTH, CELLS * 16,
        "operations, loads and stores are near each other's bounds and overlap in part; both sums go through the "
        "first cache for every tap",
    ),
    *(
        Kernel(
            f"lowest_visible, by {way}", lambda place=place: bench.visibility_case(*place), VISIBILITY, CELLS * 8,
            SEEN_LOST,
        )
        for way, place in (("column", (0.4, 0.2)), ("row", (0.2, 0.4)))
    ),
    Kernel("block_reach, at borders", bench.reach_case, REACH, IN_L1, REACH_LOST),
    Kernel(
        "spline_coefficients", bench.spline_case, SPLINE, 1200 * 1000 * 8,
        "turning the image round twice (1 ns each) is scalar code with a stride; the filter takes 0.35 ns a direction",
    ),
    Kernel(
        "tile_ortho", bench.ortho_case, ORTHO, CELLS * 12,
        "loads at an index are scalar code (0.9 ns), levels are float64",
    ),
)  # fmt: skip


def best_ns(case: Case, seconds: float = SECONDS) -> float:
    """CPU time of one unit of work, ns: the best of the runs in some seconds, after a run that compiles."""
    case.call()
    best, runs, end = float("inf"), 0, time.perf_counter() + seconds
    while runs < FEWEST_RUNS or time.perf_counter() < end:
        start = time.thread_time()
        case.call()
        best, runs = min(best, time.thread_time() - start), runs + 1
    return best / case.n * 1e9


def show_machine(machine: Machine) -> None:
    """Print the rates of a core."""
    print(f"One core of {bench.processor()}, as Numba's loops reach it:\n")
    print("| what | rate |\n|---|---|")
    print(f"| float32 multiplications and additions | {machine.arithmetic:.0f} G/s |")
    print(f"| uint16 minima and additions | {machine.narrow:.0f} G/s |")
    print(f"| float32 1 / sqrt | {machine.roots:.1f} G/s |")
    print(f"| values read at an index | {machine.gathers:.1f} G/s |")
    print(f"| loads, stores in the first cache | {machine.loads:.0f}, {machine.stores:.0f} GB/s |")
    names = {IN_L1: "first cache", IN_L2: "second", IN_L3: "third", IN_MEMORY: "memory"}
    found = ", ".join(f"{name} {machine.reads[size]:.0f}" for size, name in names.items())
    print(f"| `b += a` | {found} GB/s |\n")


def show_kernels(machine: Machine, cases: dict[str, Case], reached_ns: dict[str, float]) -> bool:
    """Print the table; return whether every kernel is within its bound."""
    print("| kernel | unit | operations | bytes in cache, from beyond | bound, ns | reached, ns | share | lost |")
    print("|---|---|---|---|---|---|---|---|")
    sound = True
    for kernel in (kernel for kernel in KERNELS if kernel.name in cases):
        case, reached = cases[kernel.name], reached_ns[kernel.name]
        bounds = kernel.count.bounds_ns(machine, kernel.size)
        what, bound = max(bounds.items(), key=lambda item: item[1])
        sound = sound and is_within_bound(machine, kernel, reached)
        count = kernel.count
        moved = f"{count.loads + count.stores:.3g}, {count.memory:.2g}"
        print(
            f"| {kernel.name} | {case.unit} | {operations(count)} | {moved} | {bound:.2g} ({what}) "
            f"| {reached:.3g} | {bound / reached:.0%} | {kernel.lost} |",
            flush=True,
        )
    return sound


def is_within_bound(machine: Machine, kernel: Kernel, reached_ns: float) -> bool:
    """Whether a kernel is no faster than the machine allows."""
    return max(kernel.count.bounds_ns(machine, kernel.size).values()) <= reached_ns * TOLERANCE


def operations(count: Count) -> str:
    """Operations as text, by kind."""
    parts = [f"{count.ops + count.narrow:.3g}"]
    parts += [f"{count.roots:.2g} roots"] if count.roots else []
    parts += [f"{count.gathers:.3g} gathers"] if count.gathers else []
    return " + ".join(parts)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-threads", dest="threads", action="store_false", help="only the roofline")
    parser.add_argument("--program", type=Path, metavar="FOLDER", help="also the whole program on a rendered scene")
    parser.add_argument("--rounds", type=int, default=ROUNDS, metavar="N", help="of the whole program")
    parser.add_argument("--kernels", nargs="+", metavar="NAME", help="; ".join(kernel.name for kernel in KERNELS))
    parser.add_argument("--seconds", type=float, default=SECONDS, metavar="S", help="for each kernel")
    parser.add_argument("--rates", type=int, default=RUNS, metavar="N", help="runs for each rate of the machine")
    options = parser.parse_args()
    chosen = [kernel for kernel in KERNELS if kernel.name.startswith(tuple(options.kernels or ("",)))]
    if not chosen:
        parser.error(f"no kernel begins with {options.kernels[0]}; there are {', '.join(k.name for k in KERNELS)}")
    before, cases = measured(options.rates), {kernel.name: kernel.case() for kernel in chosen}
    reached_ns = {name: best_ns(case, options.seconds) for name, case in cases.items()}
    machine = before.or_better(measured(options.rates))
    for _ in range(MORE_RATES):
        # Another program may have slowed the rates down, and not the kernels.
        if all(is_within_bound(machine, kernel, reached_ns[kernel.name]) for kernel in chosen):
            break
        machine = machine.or_better(measured(options.rates))
    show_machine(machine)
    sound = show_kernels(machine, cases, reached_ns)
    if options.threads:
        kernels_on_two({kernel.name: kernel.case for kernel in chosen}, min(options.seconds, RUN_SECONDS))
    if options.program:
        program_on_two(options.program, options.rounds)
    if not sound:
        print("A kernel is faster than its bound: its count is wrong.", file=sys.stderr)
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
