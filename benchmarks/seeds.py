"""Seeds that nobody can tune to, and figures of mean and spread over several scenes.

The seeds follow from the last commit that touches the source, so whoever changes the code does not know its scenes
before the change is committed.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace

from result_files import git
from workplace import CannotRun, Figure

N_SEEDS = 10
SOURCE = "src/"
# Hexadecimal digits of the commit that make the first seed.
SEED_DIGITS = 8
# Words in the labels of figures of which a high value is good.
HIGHER_IS_BETTER = ("within", "valid", "complete", "filled")


def fresh_seeds(n: int = N_SEEDS) -> list[int]:
    """Seeds of `n` scenes: the first eight hexadecimal digits of the last commit that touches src/, and those after.

    Raises
    ------
    CannotRun
        The history is missing or cut off, so that the last commit that touches src/ is unknown.
    """
    try:
        is_shallow = git("rev-parse", "--is-shallow-repository").strip() == "true"
    except CannotRun as error:
        raise CannotRun(
            f"Fresh seeds follow from the git history, and there is none ({error}). Measure in a git clone."
        ) from error
    if is_shallow:
        raise CannotRun(
            "Fresh seeds follow from the last commit that touches src/, and the history of this clone is cut off. "
            "Complete it with `git fetch --unshallow`."
        )
    commit = git("log", "-1", "--format=%H", "--", SOURCE).strip()
    if not commit:
        raise CannotRun("No commit touches src/, so there is no seed. Measure in a clone of the repository.")
    first = int(commit[:SEED_DIGITS], 16)
    return list(range(first, first + n))


def over_seeds(
    seeds: Sequence[int],
    measure: Callable[[int], Sequence[Figure]],
    higher_is_better: Sequence[str] = HIGHER_IS_BETTER,
) -> list[Figure]:
    """Mean, standard deviation and worst value over the seeds of every figure that `measure` gives for one seed.

    measure : figures of the scene of a seed, with the same labels for each seed. The bar of a figure is the bar of its
    mean. higher_is_better : words; of a figure whose label has one of them the lowest value is the worst, of all others
    the highest.

    Raises
    ------
    CannotRun
        A figure is missing for one of the seeds.
    """
    found: dict[str, list[Figure]] = {}
    for seed in seeds:
        for figure in measure(seed):
            found.setdefault(figure.what, []).append(figure)
    lines = []
    for what, figures in found.items():
        if len(figures) != len(seeds):
            raise CannotRun(f"{len(figures)} of {len(seeds)} seeds give `{what}`: a mean over fewer would mislead.")
        worst = min if any(word in what for word in higher_is_better) else max
        lines += mean_and_spread(figures, worst)
    return lines


def mean_and_spread(figures: Sequence[Figure], worst: Callable[[Sequence[float]], float]) -> list[Figure]:
    """Mean with the bar of the figures, sample standard deviation, and worst value of one figure on several scenes."""
    first, values = figures[0], [figure.value for figure in figures]
    spread = statistics.stdev(values) if len(values) > 1 else math.nan
    return [
        replace(first, what=f"{first.what}, mean", value=statistics.fmean(values)),
        Figure(f"{first.what}, standard deviation", spread, first.unit, is_detail=True),
        Figure(f"{first.what}, worst", worst(values), first.unit, is_detail=True),
    ]
