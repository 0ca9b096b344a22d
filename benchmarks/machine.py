"""Rates of one core, reached by plain loops that are compiled like the kernels (IEEE arithmetic, whole vectors).

Every rate is the best of several short runs in CPU time of the thread, because the machine may be shared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from zlocus.core.jit import kernel

RUNS = 30
IN_L1, IN_L2, IN_L3, IN_MEMORY = 12 << 10, 192 << 10, 6 << 20, 60 << 20
FLOAT_TERMS, SHORT_TERMS = 19, 16


# (n,) f4, f4, f4, i8, (n,) f4 -> None
@kernel
def multiply_add(a, x, y, rounds, out):
    """Ten multiplications and nine additions per value read and written, four chains at a time."""
    for _ in range(rounds):
        for j in range(a.shape[0]):
            v = a[j]
            p, q = (v * x + y) * x + y, (v * y + x) * y + x
            r, s = (v * x + x) * y + y, (v * y + y) * x + x
            out[j] = p * q + r * s


# (n,) u2, (2,) u2, i8, (n,) u2 -> None
@kernel
def least_sums(a, terms, rounds, out):
    """Eight additions and eight minima of uint16 per value read and written."""
    x, y = terms[0], terms[1]
    for _ in range(rounds):
        for j in range(a.shape[0]):
            v = a[j]
            v = min(np.uint16(min(np.uint16(min(np.uint16(min(np.uint16(v + x), y) + x), y) + x), y) + x), y)
            v = min(np.uint16(min(np.uint16(min(np.uint16(min(np.uint16(v + y), x) + y), x) + y), x) + y), x)
            out[j] = v


# (n,) f4, i8, (n,) f4 -> None
@kernel
def inverse_roots(a, rounds, out):
    """One square root and one division per value."""
    for _ in range(rounds):
        for j in range(a.shape[0]):
            out[j] = np.float32(1.0) / np.sqrt(a[j])


# (n,) f4, (n,) u4, i8, (n,) f4 -> None
@kernel
def gathers(a, index, rounds, out):
    """Four values from each index on, as bilinear interpolation reads them, and the three additions that join them."""
    right, below, diagonal = np.uint64(1), np.uint64(64), np.uint64(65)
    for _ in range(rounds):
        for j in range(index.shape[0]):
            p = np.uint64(index[j])
            out[j] = (a[p] + a[p + right]) + (a[p + below] + a[p + diagonal])


# (n,) u2, (n,) u2, (n,) u2, (n,) u2, i8 -> u2
@kernel
def greatest(a, b, c, d, rounds):
    """Loads only: four arrays, one value kept."""
    most = np.uint16(0)
    for _ in range(rounds):
        for j in range(a.shape[0]):
            most = max(max(most, max(a[j], b[j])), max(c[j], d[j]))
    return most


# (n,) u2, u2, i8 -> None
@kernel
def written(a, value, rounds):
    """Stores only."""
    for _ in range(rounds):
        for j in range(a.shape[0]):
            a[j] = value


# (n,) u2, (n,) u2, i8 -> None
@kernel
def added(a, b, rounds):
    """b += a: two loads and one store per value."""
    for _ in range(rounds):
        for j in range(a.shape[0]):
            b[j] = np.uint16(b[j] + a[j])


@dataclass(frozen=True)
class Machine:
    """Rates of one core, in 1e9 a second.

    arithmetic : float32 operations; narrow : uint16 operations; roots : 1 / sqrt of float32; gathers : scalar reads at
    an index; loads, stores : bytes in the first cache; reads : bytes read and written by `b += a` with both arrays of
    so many bytes together.
    """

    arithmetic: float
    narrow: float
    roots: float
    gathers: float
    loads: float
    stores: float
    reads: dict[int, float]

    def or_better(self, other: Machine) -> Machine:
        """The higher of two measurements of every rate, because other load on the machine only lowers them."""
        mine, theirs = asdict(self), asdict(other)
        reads = {size: max(found, theirs["reads"][size]) for size, found in mine.pop("reads").items()}
        return Machine(**{name: max(found, theirs[name]) for name, found in mine.items()}, reads=reads)

    def bandwidth(self, size: int) -> float:
        """GB/s on arrays of `size` bytes: the rate of the next smaller measured size, so that it is never too low."""
        return self.reads[max((known for known in self.reads if known <= size), default=min(self.reads))]


def rate(call: Callable[[int], object], n: float, runs: int = RUNS, seconds: float = 0.02) -> float:
    """Rate of the best run, in 1e9 units per second; each run takes about `seconds` of CPU.

    call : takes the number of rounds; n : units per round.
    """
    call(1)
    start, rounds = time.thread_time(), 1
    while (passed := time.thread_time() - start) < seconds / 4:
        call(rounds)
        rounds *= 2
    rounds = max(1, int(rounds * seconds / max(passed, 1e-9) / 2))
    best = np.inf
    for _ in range(runs):
        start = time.thread_time()
        call(rounds)
        best = min(best, time.thread_time() - start)
    return rounds * n / best / 1e9


def measured(runs: int = RUNS) -> Machine:
    """Measure the rates of this core, each as the best of `runs` runs."""
    rng = np.random.default_rng(1)
    n = IN_L1 // 4
    grey, out = rng.random(n // 2).astype(np.float32) + np.float32(0.5), np.empty(n // 2, np.float32)
    short, short_out = rng.integers(0, 99, n).astype(np.uint16), np.empty(n, np.uint16)
    terms = np.array([3, 5], np.uint16)
    index = rng.integers(0, n // 2 - 66, n // 4).astype(np.uint32)
    quarters = [rng.integers(0, 99, IN_L1 // 8).astype(np.uint16) for _ in range(4)]
    reads = {}
    for size in (IN_L1, IN_L2, IN_L3, IN_MEMORY):
        a, b = np.ones(size // 4, np.uint16), np.ones(size // 4, np.uint16)
        reads[size] = rate(lambda rounds, a=a, b=b: added(a, b, rounds), 6 * len(a), runs)
    x, y = np.float32(0.9), np.float32(0.1)
    return Machine(
        arithmetic=rate(lambda rounds: multiply_add(grey, x, y, rounds, out), FLOAT_TERMS * len(grey), runs),
        narrow=rate(lambda rounds: least_sums(short, terms, rounds, short_out), SHORT_TERMS * len(short), runs),
        roots=rate(lambda rounds: inverse_roots(grey, rounds, out), len(grey), runs),
        gathers=rate(lambda rounds: gathers(grey, index, rounds, out), 4 * len(index), runs),
        loads=rate(lambda rounds: greatest(*quarters, rounds), 8 * len(quarters[0]), runs),
        stores=rate(lambda rounds: written(short, terms[0], rounds), 2 * len(short), runs),
        reads=reads,
    )
