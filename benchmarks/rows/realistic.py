"""Rows of the acceptance table on scenes that are as hard as real images, and on how hard they are for others."""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path

import rasterio

from peers.realistic import SHARED, judged_realistic
from rows.other_programs import RESULTS
from seeds import fresh_seeds, over_seeds
from workplace import COVERAGE_SHORT, ZLOCUS, CannotRun, Figure, Workplace, rendered_images, run

VIEWS = {"two": ("n1", "f1"), "three": ("n1", "f1", "b1")}
ALL_VIEWS = {**VIEWS, "five": ("n1", "f1", "b1", "n2", "f2")}
CLASSES = ("all", "ground", "road", "building", "tree")
# Programs whose share within 1 m says how hard a scene is, and how far it may be from that on the independent scenes.
GAUGES, MAX_GAP = ("CARS", "OpenCV SGBM"), 0.03
# Seeds on which such a program may end with an error of its own.
MAX_FAILED = 2
SEED_SCENE = "realistic "


def realistic(workplace: Workplace) -> list[Figure]:
    """The shared realistic scenes from two, three and five views of two days."""
    figures: list[Figure] = []
    for name in SHARED:
        scene = workplace.scene(name)
        for number, views in ALL_VIEWS.items():
            out = workplace.out / f"{name}-{number}"
            figures += realistic_figures(f"{name[-1]}, {number} views", scene, views, out)
    return figures


def fresh_realistic(workplace: Workplace) -> list[Figure]:
    """Ten scenes of the realistic recipe that follow from the last commit, from two and from three views."""
    seeds = fresh_seeds()
    workplace.inputs["seeds"] = seeds
    return over_seeds(seeds, lambda seed: _on_seed(workplace.out, seed))


def _on_seed(out: Path, seed: int) -> list[Figure]:
    scene, figures = out / f"real{seed}", []
    if not (scene / "scene.json").exists():
        # All images, as for the other programs: the ground reaches as far as they see, so its details follow from them.
        run([sys.executable, "-m", "zlocus.synthetic", "-o", scene, "--kind", "real", "--seed", seed])
    for number, views in VIEWS.items():
        figures += realistic_figures(f"{number} views", scene, views, out / f"real{seed}-{number}")
    return figures


def realistic_figures(label: str, scene: Path, views: tuple[str, ...], out: Path) -> list[Figure]:
    """Accuracy of a surface: shares within 1 m by class, wrong heights, and RMSE, after the ground's common height was
    removed (pairs cannot see it), and the share within 1 m as the surface lies. out : folder of the run."""
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        area = ["--resolution", 0.5, "--crs", truth.crs.to_string(), "--bounds", *truth.bounds]
    command = [ZLOCUS, "dsm", *rendered_images(scene, views), "-o", out, *area, "--no-report", "--overwrite"]
    run(command, accept=(0, COVERAGE_SHORT))
    found = judged_realistic(scene, out / "dsm.tif")
    return [
        *(Figure(f"{label}, within 1 m: {name}", found[name]["within"]) for name in CLASSES),
        Figure(f"{label}, within 1 m as it lies: all", found["all"]["within_absolute"]),
        Figure(f"{label}, with a height", found["all"]["completeness"]),
        Figure(f"{label}, off by more than 3 m", found["all"]["off3"]),
        Figure(f"{label}, off by more than 10 m", found["all"]["off10"]),
        Figure(f"{label}, RMSE", found["all"]["rmse"], "m"),
    ]


def hardness(_workplace: Workplace) -> list[Figure]:
    """How far the recipe's scenes are from the independent ones in what other programs reach on them.

    From the results of the last comparison with other programs (`make peers`).
    """
    if not RESULTS.exists():
        raise CannotRun(f"{RESULTS} is not there: run `make peers`")
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    figures: list[Figure] = []
    for program in GAUGES:
        for number, views in VIEWS.items():
            scenes = [
                scene for scene in found["scenes"]
                if scene.endswith(f"{len(views)} views") and scene.startswith((SEED_SCENE, *SHARED))
            ]  # fmt: skip
            runs = {row["scene"]: row for row in found["surfaces"] if row["program"] == program}
            if absent := [scene for scene in scenes if scene not in runs]:
                raise CannotRun(f"{RESULTS} has no run of {program} on {', '.join(absent)}: run `make peers`")
            within = {scene: runs[scene]["classes"]["all"]["within"] for scene in scenes if "failed" not in runs[scene]}
            seeds = [value for scene, value in within.items() if scene.startswith(SEED_SCENE)]
            # A program may end with an error of its own on a scene or two; with more, the mean is of another sample.
            if len(scenes) - len(within) > MAX_FAILED or len(within) - len(seeds) != len(SHARED) or len(seeds) < 2:
                raise CannotRun(f"{RESULTS} has too few realistic scenes matched by {program}: run `make peers`")
            label, mean = f"{program}, {number} views", statistics.fmean(seeds)
            figures.append(Figure(f"{label}: mean within 1 m of {len(seeds)} seeds", mean))
            figures.append(Figure(f"{label}: median within 1 m", statistics.median(seeds), is_detail=True))
            figures.append(Figure(f"{label}: standard deviation", statistics.stdev(seeds), is_detail=True))
            for name in SHARED:
                gap = mean - within[f"{name}, {len(views)} views"]
                figures.append(
                    Figure(
                        f"{label}: mean less that on {name}",
                        gap,
                        at_least=-MAX_GAP,
                        at_most=MAX_GAP,
                        fails_when="the recipe's scenes are easier or harder than the independent ones",
                    )
                )
    return figures
