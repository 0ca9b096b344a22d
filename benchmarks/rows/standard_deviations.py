"""Row of the acceptance table on sigma.tif: shares of the true errors within one and two standard deviations."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from precision import (
    JUDGED,
    VIEWS,
    Judged,
    judge,
    rendered,
    share_in_worst_tenth,
    share_within,
    with_views,
)
from workplace import Figure, Workplace
from zlocus.evaluation.truth import CLASS_NAMES

# Of a normal distribution 68 and 95 % of the errors lie within one and two standard deviations, and a mean over the
# scenes of one recipe may be so far from that.
WITHIN = {"one": (1, 0.68, 0.07), "two": (2, 0.95, 0.04)}


def precision(workplace: Workplace) -> list[Figure]:
    """Scenes that did not calibrate sigma, with six, three and two views: ground and roofs by recipe, and all cells."""
    workplace.inputs["scenes"] = [f"{kind} {seed}" for kind, seed in JUDGED]
    workplace.out.mkdir(parents=True, exist_ok=True)
    kind_of = {rendered(kind, seed, workplace.out): kind for kind, seed in JUDGED}
    runs: dict[tuple[str, int], list[Judged]] = {}
    for folder, n_views in with_views(list(kind_of), list(VIEWS)):
        runs.setdefault((kind_of[folder], n_views), []).append(judge(folder, VIEWS[n_views], workplace.out / "run"))
    return [*of_recipes(runs), *of_all_cells(one for group in runs.values() for one in group)]


def of_recipes(runs: dict[tuple[str, int], list[Judged]]) -> list[Figure]:
    """Mean shares of the ground and roofs of each recipe (key: its name, and the number of views)."""
    figures = []
    for (kind, n_views), group in runs.items():
        for name, (times, asked, apart) in WITHIN.items():
            share = float(np.mean([share_within(one, times, ("ground", "building")) for one in group]))
            figures.append(
                Figure(
                    f"{kind}, {n_views} views, ground and roofs within {name} sigma", share,
                    at_least=round(asked - apart, 2), at_most=round(asked + apart, 2),
                    fails_when="sigma is too small or too large for scenes of this recipe",
                )
            )  # fmt: skip
    return figures


def of_all_cells(runs: Iterable[Judged]) -> list[Figure]:
    """Least and most of the scenes: shares of all cells, and errors above 1 m in the tenth with the largest sigma."""
    every, figures = list(runs), []
    for name, (times, _, _) in WITHIN.items():
        shares = [share_within(one, times, list(CLASS_NAMES)) for one in every]
        figures.append(Figure(f"within {name} sigma, least of the scenes", min(shares)))
        figures.append(Figure(f"within {name} sigma, most of the scenes", max(shares)))
    shares = [share_in_worst_tenth(one) for one in every]
    figures.append(Figure("errors above 1 m in the tenth with the largest sigma, least", min(shares)))
    figures.append(Figure("errors above 1 m in the tenth with the largest sigma, most", max(shares)))
    return figures
