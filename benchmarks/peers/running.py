"""All programs on all scenes, one after the other on the same cores; what they took and how good they are."""

from __future__ import annotations

import contextlib
import datetime
import itertools
import json
import os
import platform
import statistics
import subprocess
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Protocol

import psutil
from rasterio.errors import NotGeoreferencedWarning

from bench_kernels import processor
from judging import judged
from peers import own
from peers.environments import Environment
from peers.measuring import Failed, Usage, measured
from peers.middlebury import middlebury
from peers.scenes import RENDERED, WARM_UP, Scene, shared
from zlocus.errors import ZlocusError
from zlocus.evaluation.evaluate import evaluate

OWN = "zlocus"
# zlocus is quick, so noise of the machine shows: the median of so many runs, around those of the others.
OWN_RUNS = 3
CLASSES = ("all", "ground", "building", "tree")
SPEED_SIDE, SPEED_HEIGHTS, SPEED_ROUNDS, SPEED_TURNS = 576, (16, 64, 128), 3, 3
SPEED = Path(__file__).with_name("sgm_speed.py")


class Program(Protocol):
    """One that makes surfaces."""

    @property
    def name(self) -> str: ...

    def versions(self) -> dict[str, str]:
        """Of what computes, by name."""

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        """The surface of a scene, and what it took."""


class Results:
    """What has been measured, on disk after each step, so that a run that was cut off goes on."""

    def __init__(self, path: Path, cores: Sequence[int]) -> None:
        self.path = path
        self.found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        self.found.setdefault("machine", machine(cores))
        for part in ("programs", "scenes"):
            self.found.setdefault(part, {})
        for part in ("surfaces", "differences", "kernels", "middlebury"):
            self.found.setdefault(part, [])

    def has(self, part: str, **what: str) -> bool:
        """Whether a measurement was made and did not fail."""
        return any(what.items() <= row.items() and "failed" not in row for row in self.found[part])

    def add(self, part: str, row: dict[str, Any], *key: str) -> None:
        """Adds a measurement in place of an earlier one of the same key, and writes all."""
        same = {name: row[name] for name in key}
        kept = [each for each in self.found[part] if not same.items() <= each.items()]
        self.found[part] = [*kept, row | {"when": now()}]
        self.write()

    def say_of(self, part: str, name: str, what: dict[str, Any]) -> None:
        """Describes a program or a scene; the page has them in the order of the last run."""
        self.found[part].pop(name, None)
        self.found[part][name] = what
        self.write()

    def write(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_suffix(".tmp")
        fresh.write_text(json.dumps(self.found, indent=1) + "\n", encoding="utf-8")
        os.replace(fresh, self.path)


def now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def machine(cores: Sequence[int]) -> dict[str, Any]:
    """What everything runs on."""
    return {
        "processor": processor(), "cores": list(cores), "of_cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 1024**3, 1),
        "system": f"{platform.system()} {platform.release().split('-')[0]}", "python": platform.python_version(),
        "commit": commit(), "started": now(),
    }  # fmt: skip


def commit() -> str:
    """Of this checkout, with a mark where files differ from it; nothing where there is none."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=Path(__file__).parent
    )
    return done.stdout.strip()


def run_all(
    programs: Sequence[Program],
    names: Iterable[str],
    out: Path,
    cores: Sequence[int],
    environments: dict[str, Environment],
) -> Path:
    """Everything that is not there yet. names : scenes, of RENDERED, `pleiades`, `middlebury`, `kernels`. Returns the
    file of results."""
    results = Results(out / "results.json", cores)
    results.found["machine"]["commit"] = commit()
    for program in programs:
        results.say_of("programs", program.name, program.versions())
    names = list(names)
    warm = WARM_UP.scenes("warm-up", out / "scenes")[0]
    for program in programs:
        if not (out / "warm-up" / program.name / "done").exists():
            with contextlib.suppress(Failed):
                program.run(warm, out / "warm-up" / program.name, cores)
            (out / "warm-up" / program.name / "done").touch()
    if "kernels" in names:
        speeds(results, environments, cores[0])
    if "middlebury" in names:
        middlebury(results, out / "middlebury", environments, cores)
    for scene in scenes(names, out):
        surfaces_of(scene, programs, results, out, cores)
    return results.path


def scenes(names: Sequence[str], out: Path) -> Iterator[Scene]:
    """Of these names, rendered as they are needed."""
    for name, rendered in RENDERED.items():
        if name in names:
            yield from rendered.scenes(name, out / "scenes")
    if "pleiades" in names:
        yield from shared(out / "scenes")


def surfaces_of(scene: Scene, programs: Sequence[Program], results: Results, out: Path, cores: Sequence[int]) -> None:
    """All programs on one scene: measured where that is not done yet, all judged by one judge, and compared with each
    other where there is no truth."""
    results.say_of("scenes", scene.name, described(scene))
    made: dict[str, Path] = {} if scene.reference is None else {"s2p, delivered": scene.reference}
    for program in programs:
        say(f"{scene.name}: {program.name}")
        if scene.truth is None:
            scene = replace(scene, shifts=own.shifts(out / "surfaces" / scene.slug / OWN, scene))
        if not results.has("surfaces", scene=scene.name, program=program.name):
            results.add("surfaces", measured_row(scene, program, out, cores), "scene", "program")
    rows = [row for row in results.found["surfaces"] if row["scene"] == scene.name and "failed" not in row]
    made |= {row["program"]: out / row["surface"] for row in rows}
    for row in rows:
        if scene.truth is not None and scene.classes is not None:
            row["classes"] = judged(made[row["program"]], scene.truth, scene.classes)
    results.write()
    if scene.truth is None:
        differences(scene, made, results)


def measured_row(scene: Scene, program: Program, out: Path, cores: Sequence[int]) -> dict[str, Any]:
    """What a program took for a scene, and where its surface lies; or why there is none."""
    row: dict[str, Any] = {"scene": scene.name, "program": program.name}
    folder = out / "surfaces" / scene.slug / program.name
    try:
        runs = [program.run(scene, folder, cores) for _ in range(OWN_RUNS if program.name == OWN else 1)]
    except Failed as failure:
        return row | {"failed": str(failure).replace(str(out), "OUT")}
    return row | {"surface": str(runs[-1][0].relative_to(out)), **middle([used for _, used in runs])}


def middle(runs: list[Usage]) -> dict[str, Any]:
    """Medians of what some runs took; all of their CPU where there are several."""
    found: dict[str, Any] = {name: statistics.median(asdict(used)[name] for used in runs) for name in asdict(runs[0])}
    return found | ({"all_cpu_s": [used.cpu_s for used in runs]} if len(runs) > 1 else {})


def described(scene: Scene) -> dict[str, Any]:
    """What the page says of a scene."""
    return {
        "kind": scene.kind, "views": len(scene.images), "million_cells": scene.million_cells,
        "pairs": len(scene.pairs), "truth": scene.truth is not None,
    }  # fmt: skip


def differences(scene: Scene, made: dict[str, Path], results: Results) -> None:
    """Each surface against each other one, where both have heights; neither is the truth."""
    for first, second in itertools.combinations(made, 2):
        row: dict[str, Any] = {"scene": scene.name, "first": first, "second": second}
        try:
            found = evaluate(made[second], made[first], margin_m=0.0).all
        except ZlocusError as error:
            row["failed"] = str(error)
        else:
            row |= {
                "median": found.median,
                "nmad": found.nmad,
                "within": found.within,
                "completeness": found.completeness,
            }
        results.add("differences", row, "scene", "first", "second")


def speeds(results: Results, environments: dict[str, Environment], core: int) -> None:
    """Aggregation of zlocus, OpenCV, libSGM and Pandora on one core, in turns; the best of all turns."""
    matchers = environments.get("matchers")
    pythons: dict[str, Path] = {"zlocus": Path(sys.executable)}
    if matchers is not None:
        pythons |= dict.fromkeys(("opencv", "libsgm", "pandora"), matchers.python)
    for heights in SPEED_HEIGHTS:
        if results.has("kernels", heights=heights):  # type: ignore[arg-type]
            continue
        best: dict[tuple[str, str], float] = {}
        for _, (name, python) in itertools.product(range(SPEED_TURNS), pythons.items()):
            say(f"kernels, {heights} heights: {name}")
            log = results.path.parent / "kernels" / f"{name}.log"
            measured([python, SPEED, name, SPEED_SIDE, heights, SPEED_ROUNDS], (core,), log)
            for form, seconds in json.loads(log.read_text().splitlines()[-1]).items():
                best[name, form] = min(seconds, best.get((name, form), seconds))
        for (name, form), seconds in best.items():
            million = SPEED_SIDE**2 * heights / seconds / 1e6
            row = {"program": name, "form": form, "heights": heights, "million_cell_steps_per_s": million}
            results.add("kernels", row, "program", "form", "heights")


def say(what: str) -> None:
    print(f"{now()} {what}", file=sys.stderr, flush=True)


warnings.simplefilter("ignore", NotGeoreferencedWarning)
