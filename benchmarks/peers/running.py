"""All programs on all scenes, one after the other on the same cores; what they took and how good they are."""

from __future__ import annotations

import datetime
import itertools
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import psutil
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from bench_kernels import processor
from judging import JUDGE, judged
from peers import own
from peers.environments import Environment
from peers.measuring import Failed, Usage, measured
from peers.middlebury import middlebury
from peers.scenes import RENDERED, WARM_UP, Scene, shared
from zlocus.core.errors import ZlocusError
from zlocus.evaluation.evaluate import evaluate

OWN = "zlocus"
# zlocus is quick, so noise of the machine shows: the median of so many runs.
OWN_RUNS = 3
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


@dataclass(frozen=True)
class Asked:
    """What is to be measured.

    names : scenes, of RENDERED, `pleiades`, `middlebury`, `kernels`; views : of rendered scenes, these numbers of views
    alone; side : cells along a side of the rendered scenes in place of their own; own_runs : of zlocus, whose median
    counts.
    """

    names: Sequence[str]
    views: Sequence[int] | None = None
    side: int | None = None
    own_runs: int = OWN_RUNS


class Results:
    """What has been measured, on disk after each step, so that a run that was cut off goes on.

    cores : which everything is pinned to. What was measured on others, or by other versions, is measured again.
    """

    def __init__(self, path: Path, cores: Sequence[int]) -> None:
        self.path = path
        self.found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        self.found["machine"] = machine(cores)
        for part in ("programs", "scenes"):
            self.found.setdefault(part, {})
        for part in ("surfaces", "differences", "kernels", "middlebury"):
            self.found.setdefault(part, [])

    def has(self, part: str, **what: object) -> bool:
        """Whether a measurement was made, on these cores, and did not fail."""
        same = what | {"cores": self.found["machine"]["cores"]}
        return any(same.items() <= row.items() for row in self.found[part] if "failed" not in row)

    def add(self, part: str, row: dict[str, Any], *key: str) -> None:
        """Adds a measurement in place of an earlier one of the same key, and writes all."""
        same = {name: row[name] for name in key}
        kept = [each for each in self.found[part] if not same.items() <= each.items()]
        it = self.found["machine"]
        self.found[part] = [*kept, row | {"when": now(), "cores": it["cores"], "commit": it["commit"]}]
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
    """Of this checkout, with a mark where files differ from it."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=Path(__file__).parent
    )
    return done.stdout.strip() or "unknown"


def run_all(
    programs: Sequence[Program],
    asked: Asked,
    out: Path,
    cores: Sequence[int],
    environments: dict[str, Environment],
) -> Path:
    """Measure everything that is not there yet. Returns the file of results."""
    results = Results(out / "results.json", cores)
    for program in programs:
        results.say_of("programs", program.name, program.versions())
        warm_up(program, out, cores, asked)
    if "kernels" in asked.names:
        speeds(results, environments, cores[0])
    if "middlebury" in asked.names:
        middlebury(results, out / "middlebury", environments, cores)
    for scene in scenes(asked, out):
        surfaces_of(scene, programs, results, out, cores, asked.own_runs)
    return results.path


def warm_up(program: Program, out: Path, cores: Sequence[int], asked: Asked) -> None:
    """A run on a small scene, which compiles and fills caches, once for each state of a program."""
    folder = out / "warm-up" / program.name
    done, state = folder / "done", json.dumps(program.versions())
    if done.exists() and done.read_text() == state:
        return
    say(f"warm-up: {program.name}")
    rendered = WARM_UP if asked.side is None else replace(WARM_UP, side=min(asked.side, WARM_UP.side))
    row = measured_row(rendered.scenes("warm-up", out / "scenes")[0], program, folder, cores, asked.own_runs)
    if "failed" not in row:
        done.write_text(state)


def scenes(asked: Asked, out: Path) -> Iterator[Scene]:
    """Of the names and numbers of views asked for, rendered as they are needed.

    A rendered scene of another side than its own has that in its name, so that results of both stay apart.
    """
    for name, rendered in RENDERED.items():
        if name in asked.names:
            if asked.side not in (None, rendered.side):
                name, rendered = f"{name} of {asked.side} cells", replace(rendered, side=asked.side)
            found = rendered.scenes(name, out / "scenes")
            yield from (scene for scene in found if asked.views is None or len(scene.images) in asked.views)
    if "pleiades" in asked.names:
        yield from shared(out / "scenes")


def surfaces_of(
    scene: Scene,
    programs: Sequence[Program],
    results: Results,
    out: Path,
    cores: Sequence[int],
    own_runs: int = OWN_RUNS,
) -> None:
    """All programs on one scene: measured where that is not done yet, all judged by one judge, and compared with each
    other where there is no truth."""
    results.say_of("scenes", scene.name, described(scene))
    made: dict[str, Path] = {} if scene.reference is None else {"s2p, delivered": scene.reference}
    for program in programs:
        key = {"scene": scene.name, "program": program.name, "versions": results.found["programs"][program.name]}
        if scene.truth is None:
            scene = replace(scene, shifts=own.shifts(out / "surfaces" / scene.slug / OWN, scene))
        if not results.has("surfaces", **key):
            say(f"{scene.name}: {program.name}")
            folder = out / "surfaces" / scene.slug / program.name
            row = key | measured_row(scene, program, folder, cores, own_runs)
            results.add("surfaces", json.loads(json.dumps(row).replace(f"{out}/", "")), "scene", "program")
    rows = [row for row in results.found["surfaces"] if row["scene"] == scene.name and "failed" not in row]
    made |= {row["program"]: out / row["surface"] for row in rows}
    for row in rows:
        # Surfaces of an earlier run may be gone; then its figures stay.
        if scene.truth is not None and scene.classes is not None and made[row["program"]].exists():
            row["classes"] = judged(made[row["program"]], scene.truth, scene.classes)
            row["judge"] = JUDGE.name if JUDGE.exists() else "zlocus evaluate"
    results.write()
    if scene.truth is None:
        differences(scene, {name: path for name, path in made.items() if path.exists()}, results)


def measured_row(
    scene: Scene, program: Program, folder: Path, cores: Sequence[int], own_runs: int = OWN_RUNS
) -> dict[str, Any]:
    """What a program took for a scene, and where its surface lies; or why there is none. Each run begins with an empty
    folder, so that nothing of an earlier one is taken for its work."""
    runs = []
    try:
        for _ in range(own_runs if program.name == OWN else 1):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            surface, used = program.run(scene, folder, cores)
            runs.append(used)
        with rasterio.open(surface) as file:
            if not np.isfinite(file.read(1, masked=True).astype(float).filled(np.nan)).any():
                raise Failed(f"{surface} holds no height")
    except (Failed, rasterio.errors.RasterioIOError) as failure:
        return {"failed": str(failure)}
    return {"surface": str(surface), **middle(runs)}


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


def speeds(
    results: Results,
    environments: dict[str, Environment],
    core: int,
    side: int = SPEED_SIDE,
    all_heights: Sequence[int] = SPEED_HEIGHTS,
    turns: int = SPEED_TURNS,
) -> None:
    """Aggregation of zlocus, OpenCV, libSGM and Pandora on one core, in turns; the best of all turns. All programs of a
    number of heights are measured together.

    side : cells along a side of the volume; all_heights : numbers of heights of a cell, one measurement for each.
    """
    matchers = environments.get("matchers")
    pythons: dict[str, Path] = {"zlocus": Path(sys.executable)}
    if matchers is not None:
        pythons |= dict.fromkeys(("opencv", "libsgm", "pandora"), matchers.python)
    for heights in all_heights:
        if all(results.has("kernels", heights=heights, program=name) for name in pythons):
            continue
        best: dict[tuple[str, str], float] = {}
        for _, (name, python) in itertools.product(range(turns), pythons.items()):
            say(f"kernels, {heights} heights: {name}")
            log = results.path.parent / "kernels" / f"{name}.log"
            try:
                measured([python, SPEED, name, side, heights, SPEED_ROUNDS], (core,), log)
            except Failed as failure:
                say(str(failure))
                continue
            for form, seconds in json.loads(log.read_text().splitlines()[-1]).items():
                best[name, form] = min(seconds, best.get((name, form), seconds))
        for (name, form), seconds in best.items():
            million = side**2 * heights / seconds / 1e6
            row = {"program": name, "form": form, "heights": heights, "million_cell_steps_per_s": million}
            results.add("kernels", row, "program", "form", "heights")


def say(what: str) -> None:
    print(f"{now()} {what}", file=sys.stderr, flush=True)


warnings.simplefilter("ignore", NotGeoreferencedWarning)
