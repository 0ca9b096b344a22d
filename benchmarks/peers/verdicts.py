"""Who wins on each scene, where and why: the verdicts of the page, and the mean over the scenes of ten seeds."""

from __future__ import annotations

import re
import statistics
from collections.abc import Iterator
from typing import Any

from peers.frames import FRAME

OWN = "zlocus"
# Figures that decide a scene: of all cells, with the sign of a good figure (1: low, -1: high).
DECIDING = {"within": -1.0, "rmse": 1.0, "nmad": 1.0}
HEADINGS = {"within": "share within 1 m", "rmse": "RMSE", "nmad": "NMAD"}
FORMS = {"within": "{:.3f}", "rmse": "{:.2f} m", "nmad": "{:.3f} m"}
# A class counts as lost where another program has this much more of it within 1 m.
LOST = 0.01
# Why zlocus loses a class of cells, as experiments with its stages have shown.
REASONS = {
    "road": "even and saturated roads have match curves of noise, and the sum over paths takes them as evidence",
    "tree": "crowns look different in each image, so that the ground below fits about as well, and jumps cost more",
    "field": "rows of crops repeat, and a wrong repetition costs as little as the right one",
    "building": "roofs without texture take the height that noise gives them",
    "ground": "the search range is wide, so that noise finds false heights far away",
}
# The same on scenes of frame cameras, whose pixels are smaller than the cells that all programs are asked for.
SMALL_PIXELS = (
    "windows of the asked cells smooth away what smaller pixels show; in cells as large as a pixel more are found"
)
FRAME_REASONS = REASONS | {"tree": SMALL_PIXELS, "building": SMALL_PIXELS}
PLURALS = {"road": "roads", "tree": "trees", "field": "fields", "building": "roofs", "ground": "ground"}
GROSS = "gross errors of cells that no two images see, at heights where the images agree on what lies elsewhere"
SEED_SCENE = re.compile(r"^realistic \d+, (\d) views$")
MEAN_SCENE = "realistic scenes of {n} fresh seeds, {views} views"


def figure(row: dict[str, Any], kind: str, what: str) -> float | None:
    """A figure of a class of cells; None if the scene has none of them."""
    figures = row.get("classes", {}).get(kind, {})
    value = figures.get(what) if figures.get("n") else None
    return None if value is None or value != value else value


def with_means_of_seeds(found: dict[str, Any]) -> dict[str, Any]:
    """The results in which all scenes of fresh seeds with equally many views are one scene: their mean.

    A program that has no surface on some of them has failed, and its row says on how many (`n_failed`). `spread` of a
    row is the standard deviation of its share within 1 m.
    """
    groups: dict[str, list[str]] = {}
    for scene in found["scenes"]:
        if match := SEED_SCENE.match(scene):
            groups.setdefault(match[1], []).append(scene)
    scenes = {name: about for name, about in found["scenes"].items() if not SEED_SCENE.match(name)}
    rows = [row for row in found["surfaces"] if not SEED_SCENE.match(row["scene"])]
    for views, members in sorted(groups.items()):
        name = MEAN_SCENE.format(n=len(members), views=views)
        scenes[name] = found["scenes"][members[0]]
        for program in found["programs"]:
            of_program = [r for r in found["surfaces"] if r["program"] == program and r["scene"] in members]
            # An interrupted comparison may hold surfaces that were not judged yet.
            of_program = [row for row in of_program if "classes" in row or "failed" in row]
            n_failed = sum("failed" in row for row in of_program)
            if len(of_program) == len(members):
                said = f"no surface on {n_failed} of {len(members)} scenes"
                failed = {"scene": name, "failed": said, "n_failed": n_failed}
                rows.append(of_program[-1] | failed if n_failed else mean_row(name, of_program))
    return found | {"scenes": scenes, "surfaces": rows}


def mean_row(scene: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """One row with the means of the figures and costs of several."""
    costs = ("cpu_s", "wall_s", "peak_gb", "beside")
    mean = rows[-1] | {name: statistics.fmean(row[name] for row in rows) for name in costs}
    classes: dict[str, dict[str, float]] = {}
    for kind in rows[0]["classes"]:
        here = [row["classes"][kind] for row in rows if row["classes"].get(kind, {}).get("n")]
        names = set.intersection(*(set(figures) for figures in here)) if here else set()
        values = {name: [f[name] for f in here if f[name] == f[name]] for name in sorted(names)}
        classes[kind] = {name: statistics.fmean(of) for name, of in values.items() if of}
    within = [row["classes"]["all"]["within"] for row in rows]
    return mean | {"scene": scene, "classes": classes, "spread": statistics.stdev(within) if len(within) > 1 else None}


def of_scene(found: dict[str, Any], scene: str) -> dict[str, dict[str, Any]]:
    """Measurements on a scene by program, in the order in which the programs were first run."""
    order = list(found["programs"])
    rows = [row for row in found["surfaces"] if row["scene"] == scene]
    return {row["program"]: row for row in sorted(rows, key=lambda row: order.index(row["program"]))}


def succeeded(rows: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The measurements that gave a surface."""
    return {name: row for name, row in rows.items() if "failed" not in row}


def judged(found: dict[str, Any]) -> list[str]:
    """Names of the measured scenes that have a truth."""
    return [name for name, scene in found["scenes"].items() if scene["truth"] and of_scene(found, name)]


def best(rows: dict[str, dict[str, Any]], what: str) -> tuple[str, float] | None:
    """The program with the best figure of all cells, and the figure; a tie goes to zlocus."""
    values = {program: figure(row, "all", what) for program, row in rows.items()}
    known = {program: value for program, value in values.items() if value is not None}
    if not known:
        return None
    program = min(known, key=lambda name: (DECIDING[what] * known[name], name != OWN))
    return program, known[program]


def lost(rows: dict[str, dict[str, Any]]) -> dict[str, tuple[str, float, float]]:
    """Deciding figures in which zlocus is not first: the winner, its figure, and that of zlocus."""
    found = {}
    for what in DECIDING:
        first, own = best(rows, what), figure(rows.get(OWN, {}), "all", what)
        if first is not None and first[0] != OWN and own is not None:
            found[what] = (*first, own)
    return found


def severity(rows: dict[str, dict[str, Any]]) -> float:
    """How much zlocus loses on a scene: the ratio of wrong cells to those of the winner; 0 where nothing is lost."""
    losses = lost(rows)
    if not losses:
        return 0.0
    if "within" not in losses:
        return 1e-3 * len(losses)
    _, first, own = losses["within"]
    return (1.0 - own) / max(1.0 - first, 1e-6)


def lost_classes(rows: dict[str, dict[str, Any]]) -> list[tuple[str, str, float, float]]:
    """Classes of cells of which another program has more within 1 m: class, program, its share and that of zlocus."""
    found = []
    for kind in REASONS:
        own = figure(rows.get(OWN, {}), kind, "within")
        others = {name: figure(row, kind, "within") for name, row in rows.items() if name != OWN}
        known = {name: value for name, value in others.items() if value is not None}
        if own is not None and known:
            program = max(known, key=known.__getitem__)
            if known[program] > own + LOST:
                found.append((kind, program, known[program], own))
    return sorted(found, key=lambda loss: loss[3] - loss[2])


def why(rows: dict[str, dict[str, Any]], scene_kind: str | None = None) -> str:
    """Where zlocus loses on a scene, and why, as a sentence; empty where it loses nothing. scene_kind : of `Scene`."""
    losses, classes = lost(rows), lost_classes(rows)
    reasons = FRAME_REASONS if scene_kind == FRAME else REASONS
    if not losses:
        return ""
    parts = [
        f"{PLURALS[kind]} {own:.3f}, {program} {other:.3f} ({reasons[kind]})" for kind, program, other, own in classes
    ]
    if "rmse" in losses and losses["rmse"][2] > 1.2 * losses["rmse"][1]:
        parts.append(GROSS)
    return "; ".join(parts) or "a small difference in all classes"


def verdict_lines(found: dict[str, Any]) -> Iterator[list[str]]:
    """Cells of the table of verdicts, the heaviest loss first: scene, a cell per deciding figure, where and why."""
    by_scene = {scene: succeeded(of_scene(found, scene)) for scene in judged(found)}
    for scene in sorted(by_scene, key=lambda name: -severity(by_scene[name])):
        rows = by_scene[scene]
        cells = [scene]
        for what in DECIDING:
            first, own = best(rows, what), figure(rows.get(OWN, {}), "all", what)
            form = FORMS[what].format
            if first is None:
                cells.append("")
            elif first[0] == OWN or own is None:
                others = best({name: row for name, row in rows.items() if name != OWN}, what)
                cells.append(f"{first[0]} {form(first[1])}" + (f", {others[0]} {form(others[1])}" if others else ""))
            else:
                cells.append(f"**{first[0]} {form(first[1])}**, {OWN} {form(own)}")
        yield [*cells, why(rows, found["scenes"].get(scene, {}).get("kind"))]
