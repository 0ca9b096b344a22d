"""Run all programs on all scenes, one after the other on the same cores, and measure their cost and accuracy."""

from __future__ import annotations

import itertools
import json
import shutil
import statistics
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from judging import JUDGE
from peers import own
from peers.environments import Environment
from peers.frames import FRAMES, takes_frames
from peers.measuring import Failed, Usage, measured
from peers.middlebury import middlebury
from peers.realistic import RealisticScene, jax_scenes, judged_scene, seed_scenes, shared_scenes
from peers.results import Results, say
from peers.scenes import RENDERED, WARM_UP, Scene, shared
from peers.verdicts import SEED_SCENE
from zlocus.core.errors import ZlocusError
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate

OWN = "zlocus"
# A run of zlocus is short, so the load of the machine shows; the median of this many runs counts.
OWN_RUNS = 3
SPEED_SIDE, SPEED_HEIGHTS, SPEED_ROUNDS, SPEED_TURNS = 576, (16, 64, 128), 3, 3
SPEED = Path(__file__).with_name("sgm_speed.py")


class Program(Protocol):
    """A program that makes surfaces."""

    @property
    def name(self) -> str: ...

    def versions(self) -> dict[str, str]:
        """Versions of the packages that compute, by name."""

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        """Make the surface of a scene; return its path and the cost."""


@dataclass(frozen=True)
class PeerComparison:
    """Measurements to make.

    names : scenes of RENDERED and FRAMES, `pleiades`, `middlebury`, `kernels`; views : numbers of views of rendered
    scenes, None for all; side : cells along a side of the rendered scenes, or columns of a frame, None for their own;
    own_runs : runs of zlocus, of which the median counts; seeds : of the realistic recipe.
    """

    names: Sequence[str]
    views: Sequence[int] | None = None
    side: int | None = None
    own_runs: int = OWN_RUNS
    seeds: Sequence[int] = ()


def run_all(
    programs: Sequence[Program],
    comparison: PeerComparison,
    out: Path,
    cores: Sequence[int],
    environments: dict[str, Environment],
) -> Path:
    """Make all measurements that the results do not hold yet; return the file of results."""
    results = Results(out / "results.json", cores)
    if "seeds" in comparison.names:
        results.forget_scenes(SEED_SCENE.match, [f"realistic {seed}, " for seed in comparison.seeds])
    for program in programs:
        results.describe("programs", program.name, program.versions())
        warm_up(program, out, cores, comparison)
    if "kernels" in comparison.names:
        speeds(results, environments, cores[0])
    if "middlebury" in comparison.names:
        middlebury(results, out / "middlebury", environments, cores)
    for scene in scenes(comparison, out):
        surfaces_of(scene, programs, results, out, cores, comparison.own_runs)
    return results.path


def warm_up(program: Program, out: Path, cores: Sequence[int], comparison: PeerComparison) -> None:
    """Run a program on a small scene, to compile it and fill its caches, once for each of its versions."""
    folder = out / "warm-up" / program.name
    done, state = folder / "done", json.dumps(program.versions())
    if done.exists() and done.read_text() == state:
        return
    say(f"warm-up: {program.name}")
    rendered = WARM_UP if comparison.side is None else replace(WARM_UP, side=min(comparison.side, WARM_UP.side))
    row = measured_row(rendered.scenes("warm-up", out / "scenes")[0], program, folder, cores, comparison.own_runs)
    if "failed" not in row:
        done.write_text(state)


def scenes(comparison: PeerComparison, out: Path) -> Iterator[Scene]:
    """The scenes of a comparison, rendered when they are needed.

    A rendered scene of another size than its own has the size in its name, so that the results stay separate.
    """
    for name, rendered in RENDERED.items():
        if name in comparison.names:
            if comparison.side not in (None, rendered.side):
                name, rendered = f"{name} of {comparison.side} cells", replace(rendered, side=comparison.side)
            found = rendered.scenes(name, out / "scenes")
            yield from (scene for scene in found if comparison.views is None or len(scene.images) in comparison.views)
    for name, block in FRAMES.items():
        if name in comparison.names:
            if comparison.side not in (None, block.columns):
                name, block = f"{name} of {comparison.side} columns", replace(block, columns=comparison.side)
            yield block.scene(name, out / "scenes")
    if "realistic" in comparison.names:
        yield from shared_scenes(out / "scenes")
    if "seeds" in comparison.names:
        yield from seed_scenes(comparison.seeds, out / "scenes")
    if "jax068" in comparison.names:
        yield from jax_scenes(out / "scenes")
    if "pleiades" in comparison.names:
        yield from shared(out / "scenes")


def surfaces_of(
    scene: Scene,
    programs: Sequence[Program],
    results: Results,
    out: Path,
    cores: Sequence[int],
    own_runs: int = OWN_RUNS,
) -> None:
    """Run all programs on one scene if that is not done yet, and judge their surfaces by one judge.

    Without a truth, the surfaces are compared with each other.
    """
    results.describe("scenes", scene.name, described(scene))
    made: dict[str, Path] = {} if scene.reference is None else {"s2p, delivered": scene.reference}
    for program in (each for each in programs if scene.cameras is None or takes_frames(each.name)):
        key = {"scene": scene.name, "program": program.name, "versions": results.found["programs"][program.name]}
        if scene.truth is None or isinstance(scene, RealisticScene):
            scene = replace(scene, shifts=own.shifts(out / "surfaces" / scene.slug / OWN, scene))
        if not results.has("surfaces", **key):
            say(f"{scene.name}: {program.name}")
            folder = out / "surfaces" / scene.slug / program.name
            row = key | measured_row(scene, program, folder, cores, own_runs)
            results.add("surfaces", json.loads(json.dumps(row).replace(f"{out}/", "")), "scene", "program")
    rows = [row for row in results.found["surfaces"] if row["scene"] == scene.name and "failed" not in row]
    made |= {row["program"]: out / row["surface"] for row in rows}
    for row in rows:
        # If the surface of an earlier run is gone, its figures stay.
        if scene.truth is not None and scene.classes is not None and made[row["program"]].exists():
            row["classes"] = judged_scene(scene, made[row["program"]])
            row["judge"] = JUDGE.name if JUDGE.exists() else "zlocus evaluate"
    results.write()
    if scene.truth is None:
        differences(scene, {name: path for name, path in made.items() if path.exists()}, results)


def measured_row(
    scene: Scene, program: Program, folder: Path, cores: Sequence[int], own_runs: int = OWN_RUNS
) -> dict[str, Any]:
    """Cost of a program on a scene and path of its surface, or the reason why there is none.

    Each run begins with an empty folder, so that no file of an earlier run is taken for its result.
    """
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
    """Medians of the cost of some runs, and the CPU of each if there are several."""
    found: dict[str, Any] = {name: statistics.median(asdict(used)[name] for used in runs) for name in asdict(runs[0])}
    return found | ({"all_cpu_s": [used.cpu_s for used in runs]} if len(runs) > 1 else {})


def described(scene: Scene) -> dict[str, Any]:
    """Description of a scene for the page."""
    return {
        "kind": scene.kind, "views": len(scene.images), "million_cells": scene.million_cells,
        "pairs": len(scene.pairs), "truth": scene.truth is not None,
    }  # fmt: skip


def differences(scene: Scene, made: dict[str, Path], results: Results) -> None:
    """Compare each two surfaces where both have heights; neither is the truth."""
    for first, second in itertools.combinations(made, 2):
        row: dict[str, Any] = {"scene": scene.name, "first": first, "second": second}
        try:
            found = evaluate(made[second], Comparison(made[first], margin_m=0.0)).statistics
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
    """Measure the semi-global aggregation of zlocus, OpenCV, libSGM and Pandora on one core.

    The programs take turns, and the best of all turns counts. side : cells along a side of the volume; all_heights :
    numbers of heights of a cell, each measured separately.
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


warnings.simplefilter("ignore", NotGeoreferencedWarning)
