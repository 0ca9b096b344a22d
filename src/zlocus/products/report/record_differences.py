"""What differs between the records (run.json) of two runs: options, versions, inputs, cameras and times."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from zlocus.products.report.tables import known_options, nested_values, plain
from zlocus.products.report.text import NONE, STAGES, number, seconds

# Entries of a request that say where a run reads and writes; inputs have a table of their own.
PLACES = ("inputs", "out")
OF_COMMAND = "option of the command line"


@dataclass(frozen=True)
class ValueRow:
    """A value of two runs. meaning : of the value, in words; "" without."""

    name: str
    first: str
    second: str
    meaning: str = ""


@dataclass(frozen=True)
class StageTimes:
    """Wall time, CPU time and memory of a stage of two runs, first and second.

    ratio : wall time of the second run as a multiple of that of the first; bars : widths for both, percent.
    """

    name: str
    does: str
    wall: tuple[str, str]
    cpu: tuple[str, str]
    peak: tuple[str, str]
    ratio: str
    bars: tuple[float, float]


@dataclass(frozen=True)
class CameraRow:
    """Correction of a camera in two runs, first and second.

    shift : column and row, px; apart : distance of both shifts, px; n_ties : number of ties; after : median of their
    residuals after the orientation, px.
    """

    name: str
    shift: tuple[str, str]
    apart: str
    n_ties: tuple[str, str]
    after: tuple[str, str]


def option_differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[ValueRow]:
    """Options that differ: those of the command line, then those of the stages. first, second : of run.json."""
    meanings = {name: meaning for name, _, meaning in known_options()}
    of_stages = [dict(nested_values(run["config"]["options"])) for run in (first, second)]
    requests = _request(first), _request(second)
    of_command = dict.fromkeys([*requests[0], *requests[1]], OF_COMMAND)
    return [*_differing(*requests, of_command), *_differing(of_stages[0], of_stages[1], meanings)]


def _request(run: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in run["config"]["request"].items() if name not in PLACES}


def version_differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[ValueRow]:
    """Versions of zlocus, Python and libraries that differ."""
    return _differing(first["versions"], second["versions"], {})


def _differing(first: Mapping[str, Any], second: Mapping[str, Any], meanings: Mapping[str, str]) -> list[ValueRow]:
    """Rows of the values that differ; what one of both does not have is shown as such."""

    def shown(values: Mapping[str, Any], name: str) -> str:
        return plain(values[name]) if name in values else NONE

    return [
        ValueRow(name, shown(first, name), shown(second, name), meanings.get(name, ""))
        for name in dict.fromkeys([*first, *second])
        if name not in first or name not in second or first[name] != second[name]
    ]


def input_differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[ValueRow]:
    """Input files that only one run has, or whose content differs. A file that was moved is the same, and so is each of
    several copies for which the other run has one as well."""
    mine, theirs = ({each["path"]: each["sha256"] for each in run["inputs"]} for run in (first, second))
    rows = [
        ValueRow(path, mine[path] or "not read completely", theirs[path] or "not read completely", "other content")
        for path in mine
        if path in theirs and mine[path] != theirs[path]
    ]
    for one, other, texts in ((mine, theirs, ("yes", "no", "only in A")), (theirs, mine, ("no", "yes", "only in B"))):
        elsewhere = Counter(other[path] for path in other if path not in one and other[path])
        for path in (path for path in one if path not in other):
            elsewhere[one[path]] -= 1
            if elsewhere[one[path]] < 0:
                rows.append(ValueRow(path, *texts))
    return rows


def camera_rows(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[CameraRow]:
    """Corrections of all cameras of both runs, the largest differences first, then those that one run lacks."""
    mine, theirs = (run["orientation"]["views"] for run in (first, second))
    rows = []
    for name in dict.fromkeys([*mine, *theirs]):
        views = (mine.get(name), theirs.get(name))
        apart = math.inf
        if views[0] is not None and views[1] is not None:
            apart = math.dist(views[0]["shift_px"], views[1]["shift_px"])
        shifts, ties, after = ([_of_view(view, key) for view in views] for key in ("shift", "ties", "after"))
        known = NONE if math.isinf(apart) else f"{apart:.3f}"
        row = CameraRow(name, (shifts[0], shifts[1]), known, (ties[0], ties[1]), (after[0], after[1]))
        rows.append((math.isinf(apart), -apart, row))
    return [row for _, _, row in sorted(rows, key=lambda each: each[:2])]


def _of_view(view: Mapping[str, Any] | None, key: str) -> str:
    """Shift, number of ties, or median residual of a view of run.json, as text."""
    if view is None:
        return NONE
    if key == "shift":
        return ", ".join(f"{round(value, 3) + 0.0:+.3f}" for value in view["shift_px"])
    return str(view["n_ties"]) if key == "ties" else number(view["residual_after_px"]["median"], "", 3)


def stage_times(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[StageTimes]:
    """Times of each stage of two runs, and of all stages."""
    mine, theirs = ({stage["name"]: stage for stage in run["stages"]} for run in (first, second))
    longest = max((stage["wall_s"] for stage in (*mine.values(), *theirs.values())), default=0.0) or 1.0
    rows = [
        _times(name, STAGES.get(name, ""), mine.get(name), theirs.get(name), longest)
        for name in dict.fromkeys([*mine, *theirs])
    ]
    totals = [_total(each.values()) for each in (mine, theirs)]
    return [*rows, _times("all", "", totals[0], totals[1], math.inf)]


def _total(stages: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    stages = list(stages)
    return {
        "wall_s": sum(stage["wall_s"] for stage in stages), "cpu_s": sum(stage["cpu_s"] for stage in stages),
        "peak_mb": max((stage["peak_mb"] for stage in stages), default=0.0),
    }  # fmt: skip


def _times(
    name: str, does: str, mine: Mapping[str, Any] | None, theirs: Mapping[str, Any] | None, longest: float
) -> StageTimes:
    def texts(key: str) -> tuple[str, str]:
        show = seconds if key.endswith("_s") else lambda value: f"{value:.0f} MB"
        found = [NONE if stage is None else show(stage[key]) for stage in (mine, theirs)]
        return found[0], found[1]

    walls = [0.0 if stage is None else stage["wall_s"] for stage in (mine, theirs)]
    ratio = f"{walls[1] / walls[0]:.2f}" if mine is not None and theirs is not None and walls[0] > 0 else NONE
    bars = (100 * walls[0] / longest, 100 * walls[1] / longest)
    return StageTimes(name, does, texts("wall_s"), texts("cpu_s"), texts("peak_mb"), ratio, bars)


def total_s(run: Mapping[str, Any]) -> float:
    """Wall time of all stages of a run, s."""
    return _total(run["stages"])["wall_s"]


def listed_values(rows: Sequence[ValueRow]) -> str:
    """Values that differ, in a line: `views: auto, all; pyramid.tile: 80, 256`; "none" without."""
    return "; ".join(f"{row.name}: {row.first}, {row.second}" for row in rows) or "none"
