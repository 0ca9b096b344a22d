"""Tables of realistic scenes, painted troubles and other programs, for README and the accuracy page."""

from __future__ import annotations

import json
from typing import Any

from pages.tables import AllResults, markdown, of_row, seed_spread, table
from peers.verdicts import (
    DECIDING,
    FORMS,
    OWN,
    best,
    figure,
    judged,
    of_scene,
    severity,
    succeeded,
    verdict_lines,
    with_means_of_seeds,
)
from result_files import Results
from workplace import ROOT, CannotRun

PEERS_RESULTS = ROOT / "benchmarks" / "peers" / "results.json"
# Scenes of the short table: those with so many views.
SHORT_TABLE_VIEWS = (3, 19)
CLASSES = ("all", "ground", "road", "building", "tree")


def peer_results() -> dict[str, Any]:
    """Results of the comparison with other programs, fresh seeds as their mean.

    Raises
    ------
    CannotRun
        There are none.
    """
    if not PEERS_RESULTS.exists():
        raise CannotRun(f"{PEERS_RESULTS} is missing, and a table needs it: run `make peers`.")
    return with_means_of_seeds(json.loads(PEERS_RESULTS.read_text(encoding="utf-8")))


@table("programs")
def programs(_: AllResults) -> str:
    """Who is first on each scene, where zlocus loses and why; the heaviest loss first."""
    head = ["scene", "share within 1 m", "RMSE", "NMAD", "where zlocus loses, and why"]
    return markdown(head, list(verdict_lines(peer_results())))


@table("programs-short")
def programs_short(_: AllResults) -> str:
    """Share within 1 m and RMSE of zlocus and of the best other program; the heaviest loss first."""
    found, lines = peer_results(), []
    by_scene = {
        scene: succeeded(of_scene(found, scene))
        for scene in judged(found)
        if found["scenes"][scene]["views"] in SHORT_TABLE_VIEWS
    }
    for scene, rows in sorted(by_scene.items(), key=lambda item: -severity(item[1])):
        others = {program: row for program, row in rows.items() if program != OWN}
        cells = [scene]
        for what in ("within", "rmse"):
            form, own, other = FORMS[what].format, figure(rows.get(OWN, {}), "all", what), best(others, what)
            text = "" if own is None else form(own)
            is_first = own is not None and (other is None or DECIDING[what] * own <= DECIDING[what] * other[1])
            cells += [f"**{text}**" if is_first else text, "" if other is None else f"{form(other[1])} {other[0]}"]
        lines.append(cells)
    head = ["scene", "within 1 m: zlocus", "best other program", "RMSE: zlocus", "best other program"]
    return markdown(head, lines)


@table("realistic")
def realistic(results: AllResults) -> str:
    """The shared realistic scenes by their number of views."""
    it, lines = of_row(results, "realistic"), []
    labels = [f.what.partition(", within 1 m: all")[0] for f in it.figures if f.what.endswith(", within 1 m: all")]
    for label in labels:
        lines.append([f"rendered-real-{label}", *realistic_cells(it, label, "")])
    return markdown(realistic_head(), lines)


@table("fresh-realistic")
def fresh_realistic(results: AllResults) -> str:
    """Mean and standard deviation over the realistic scenes of the fresh seeds."""
    it, lines = of_row(results, "fresh-realistic"), []
    for views in ("two", "three"):
        label = f"{views} views"
        shares = [seed_spread(it, f"{label}, within 1 m: {name}", 3) for name in CLASSES]
        rest = ("within 1 m as it lies: all", "with a height", "off by more than 3 m", "off by more than 10 m")
        others = [seed_spread(it, f"{label}, {what}", 3) for what in rest]
        lines.append([label, *shares, *others, seed_spread(it, f"{label}, RMSE", 1)])
    return markdown(realistic_head(), lines)


def realistic_head() -> list[str]:
    """Heading of the tables of realistic scenes."""
    shares = [f"within 1 m: {name}" if name == "all" else name for name in CLASSES]
    return ["scene, views", *shares, "as it lies: all", "with a height", "off by > 3 m", "> 10 m", "RMSE, m"]


def realistic_cells(it: Results, label: str, ending: str) -> list[str]:
    """Cells of a line of a realistic scene. ending : of the labels of its figures."""
    rest = ("within 1 m as it lies: all", "with a height", "off by more than 3 m", "off by more than 10 m")
    values = [it.value(f"{label}, within 1 m: {name}{ending}") for name in CLASSES]
    values += [it.value(f"{label}, {what}{ending}") for what in rest]
    return [*(f"{value:.3f}" for value in values), f"{it.value(f'{label}, RMSE{ending}'):.1f}"]


@table("water")
def water(results: AllResults) -> str:
    """Levels of lakes with different shores: root mean square of their errors, by views and by what is given."""
    it = of_row(results, "water")
    given = [("two", "exact"), ("three", "exact"), ("three", "1 m wide"), ("three", "1 m narrow"), ("two", "possible"),
             ("three", "possible")]  # fmt: skip
    words = {"exact": "outline given", "possible": "`--level-water`"}
    names = list(dict.fromkeys(f.what.partition(", ")[0] for f in it.figures if f.what.startswith("lake-")))
    head = ["lake", *(f"{views} views, {words.get(outline, f'outline {outline}')}" for views, outline in given)]
    lines = [
        [
            name,
            *(
                f"{it.value(f'{name}, {views} views, {outline}: level off, root mean square'):.2f}"
                for views, outline in given
            ),
        ]
        for name in names
    ]
    return markdown(head, lines)


@table("flags")
def flags(results: AllResults) -> str:
    """What each warning of quality.tif marks on scenes with truth, by recipe."""
    it, lines = of_row(results, "flags"), []
    labels = [f.what.partition(", heights off")[0] for f in it.figures if ", heights off by" in f.what]
    whats = ("marked, off by more than 3 sigma", "marked, wrong", "of the wrong heights", "of the right heights")
    for label in labels:
        off, wrong = (it.value(f"{label}, {what}") for what in ("heights off by more than 3 sigma", "wrong heights"))
        lines.append([label, "all heights", f"{off:.1%}", f"{wrong:.1%}", "100 %", "100 %"])
        start, end = f"{label}, ", f": {whats[0]}"
        names = [
            f.what.removeprefix(start).removesuffix(end)
            for f in it.figures
            if f.what.startswith(start) and f.what.endswith(end)
        ]
        lines += [[label, name, *(f"{it.value(f'{label}, {name}: {what}'):.1%}" for what in whats)] for name in names]
    head = ["scenes", "cells with", "off by more than 3 sigma", "wrong", "of the wrong heights", "of the right heights"]
    return markdown(head, lines)


@table("trusted")
def trusted(results: AllResults) -> str:
    """What the recipe for trusted heights keeps of the right heights, and how many of the kept ones are wrong."""
    it, recipe = of_row(results, "flags"), "sigma below two cells"
    labels = [f.what.partition(", wrong heights")[0] for f in it.figures if f.what.endswith(", wrong heights")]
    whats = ("{}, wrong heights", "{}, {}: wrong heights among the kept", "{}, {}: right heights kept")
    lines = [[label, *(f"{it.value(what.format(label, recipe)):.1%}" for what in whats)] for label in labels]
    head = ["scenes", "wrong before", "wrong among the kept heights", "right heights that are kept"]
    return markdown(head, lines)


@table("troubles")
def troubles(results: AllResults) -> str:
    """Painted troubles: share of the cells with a height, and of these heights those off by more than 3 and 10 m."""
    it = of_row(results, "troubles")
    judged = [f.what for f in it.figures if " views: " in f.what]  # beside them stands the memory of the runs
    names = list(dict.fromkeys(what.partition(", ")[0] for what in judged))
    whats = ("with a height", "off by more than 3 m", "off by more than 10 m")
    lines = [
        [
            name,
            *(" / ".join(f"{it.value(f'{name}, {n} views: {what}'):.2f}" for what in whats) for n in ("two", "three")),
        ]
        for name in names
    ]
    return markdown(["trouble", "two views: with a height / off by > 3 m / > 10 m", "three views"], lines)
