"""Row of the acceptance table on other programs, from the results of the last full comparison (`make peers`, hours)."""

from __future__ import annotations

import json

from peers.frames import FRAME
from peers.page import figure, judged, of_scene, per_million, succeeded
from peers.verdicts import with_means_of_seeds
from workplace import ROOT, CannotRun, Figure, Workplace

BEHIND = "another program is more accurate on this scene"
OWN, CARS = "zlocus", "CARS"
RESULTS = ROOT / "benchmarks" / "peers" / "results.json"


def peers(_workplace: Workplace) -> list[Figure]:
    """Accuracy, CPU and speed of zlocus over those of the best other program (docs/reference/peers.md)."""
    if not RESULTS.exists():
        raise CannotRun(f"{RESULTS} is not there: run `make peers`")
    found, figures = with_means_of_seeds(json.loads(RESULTS.read_text(encoding="utf-8"))), []
    for scene in judged(found):
        run = of_scene(found, scene)
        rows = succeeded(run)
        if OWN not in rows or len(rows) < 2:
            raise CannotRun(f"{RESULTS} has no surface of {scene} by {OWN} and by another program")
        if CARS not in run and found["scenes"][scene]["kind"] != FRAME:
            raise CannotRun(f"{RESULTS} has no run of {CARS} on {scene}, whose CPU is compared: run `make peers`")
        own, others = rows.pop(OWN), rows.values()
        within, nmad = (figure(own, "all", what) for what in ("within", "nmad"))
        most = max(figure(row, "all", "within") for row in others)
        least = min(figure(row, "all", "nmad") for row in others)
        figures += [
            Figure(f"{scene}, within 1 m over the next", within / most, at_least=1, fails_when=BEHIND),
            Figure(f"{scene}, NMAD over the next", nmad / least, at_most=1, fails_when=BEHIND),
        ]
        if CARS in rows:
            figures.append(
                Figure(
                    f"{scene}, CPU of {CARS} over ours",
                    per_million(found, rows[CARS]) / per_million(found, own),
                    at_least=50,
                    fails_when="zlocus becomes slower, or CARS faster",
                )
            )
        elif CARS in run:
            # The cost of a run that ends in an error says nothing.
            figures.append(Figure(f"{scene}, runs in which {CARS} failed", run[CARS].get("n_failed", 1)))
    speeds: dict[int, dict[bool, float]] = {}
    for row in found["kernels"]:
        best, is_own = speeds.setdefault(row["heights"], {}), row["program"] == OWN
        best[is_own] = max(row["million_cell_steps_per_s"], best.get(is_own, 0.0))
    for heights, best in sorted(speeds.items()):
        ratio = best[True] / best[False]
        figures.append(
            Figure(
                f"SGM, {heights} heights, over the next", ratio, at_least=1,
                fails_when="another program aggregates faster on this processor",
            )
        )  # fmt: skip
    return figures
