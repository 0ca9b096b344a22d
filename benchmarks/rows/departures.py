"""Row on the departures from the papers: what the surface loses where each of them, or all of them, is taken back.

Each departure is taken back alone, over scenes of fresh seeds and on real images, and compared with the default on the
same scene: the differences are paired, so that easy and hard scenes do not hide them.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import rasterio

from judging import run_here
from peers.realistic import judged_realistic
from precision import VIEWS, rendered
from rows.many_images import CLASSES, LIDAR
from seeds import fresh_seeds
from workplace import COVERAGE_SHORT, CannotRun, Figure, Workplace

N_SEEDS, N_VIEWS = 6, (3, 6)
DEFAULT = "default"
LOSES = "what the papers describe is better than the departure from it"


@dataclass(frozen=True)
class Departure:
    """What is changed to take a departure back. options : of the file of options, by section; words : of the command
    line; patches : functions of zlocus, as `module.name`, and what each returns instead."""

    options: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    words: Sequence[str] = ()
    patches: Mapping[str, object] = field(default_factory=dict)


_SELECTION = {
    "order": '"labels"', "max_sigma_steps": 1000.0, "stopped_share": 0.95, "min_label_share": 0.0, "max_images": 254,
}  # fmt: skip
# In the order in which the pages on the method describe them.
DEPARTURES = {
    "all images instead of chosen ones": Departure({"selection": _SELECTION}, ("--selection", "guided")),
    "evidence learned from the images": Departure(patches={"zlocus.matching.tile.learns_evidence": False}),
    "grey differences beside correlation": Departure({"cost": {"grey_weight": 0.0}}),
    "a small window beside the large one": Departure({"cost": {"small_window": 5}}),
    "occluded images excluded": Departure({"cost": {"occlusion_margin_steps": 1000.0}}),
    "free rays": Departure(patches={"zlocus.matching.tile.add_costs_of_rays": False}),
    "two predecessors of each path": Departure({"semiglobal": {"predecessors": 1}}),
    "cheap jumps at edges": Departure({"semiglobal": {"p2_edge": 400}}),
    "cheaper jumps where the costs agree": Departure({"semiglobal": {"p2": 400}}),
    "planes through plain segments": Departure({"planes": {"texture": 0.0}}),
    "smoothing by planes": Departure({"refine": {"max_plane_side": 0}}),
    "medians of uncertain heights": Departure({"refine": {"median_sigma_steps": 1e6}}),
}  # fmt: skip


def all_of(departures: Sequence[Departure]) -> Departure:
    """All departures taken back together."""
    options: dict[str, dict[str, object]] = {}
    for each in departures:
        for section, values in each.options.items():
            options.setdefault(section, {}).update(values)
    words = [word for each in departures for word in each.words]
    return Departure(options, words, {name: value for each in departures for name, value in each.patches.items()})


RUNS = {
    DEFAULT: Departure(),
    **DEPARTURES,
    "all of these": all_of(list(DEPARTURES.values())),
    "the paper of 2014 literally": Departure(words=("--selection", "paper")),
}


def departures(workplace: Workplace) -> list[Figure]:
    """Share within 1 m and error of every run on every scene, and paired differences over the scenes of the seeds."""
    seeds = fresh_seeds(N_SEEDS)
    workplace.inputs["seeds"] = seeds
    figures = []
    for n in N_VIEWS:
        found = {
            name: [on_realistic(workplace.out, seed, VIEWS[n], departure) for seed in seeds]
            for name, departure in RUNS.items()
        }
        figures += paired(f"realistic scenes, {n} views", found)
    try:
        scene = workplace.scene("worldview3_jax068")
    except CannotRun:
        return figures
    real = {name: [on_jacksonville(workplace, scene, departure)] for name, departure in RUNS.items()}
    return [*figures, *paired("Jacksonville, 19 images", real)]


def on_realistic(out: Path, seed: int, views: Sequence[str], departure: Departure) -> tuple[float, float]:
    """Share within 1 m and RMSE (m) of a realistic scene."""
    scene = rendered("real", seed, out)
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        area = ["--resolution", str(2 * truth.res[0]), "--crs", truth.crs.to_string(), "--bounds",
                *map(str, truth.bounds)]  # fmt: skip
    images = [str(path) for view in views if (path := scene / f"img_{view}.tif").exists()]
    made = surface(out / "run", [*images, *area], departure)
    found = judged_realistic(scene, made)["all"]
    return float(found["within"]), float(found["rmse"])


def on_jacksonville(workplace: Workplace, scene: Path, departure: Departure) -> tuple[float, float]:
    """Share within 1 m and RMSE (m) of nineteen images of ten months, registered to laser heights."""
    images = [str(path) for path in sorted(scene.glob("*_RGB.tif"))]
    made = surface(workplace.out / "run", [*images, "--like", str(scene / LIDAR)], departure)
    found = workplace.judge_registered(made, scene / LIDAR, scene / CLASSES)["all"]
    return float(found["within1"]), float(found["rmse"])


def surface(out: Path, words: Sequence[str], departure: Departure) -> Path:
    """Make a surface with a departure taken back, and return its heights."""
    out.parent.mkdir(parents=True, exist_ok=True)
    file = out.with_name("options.toml")
    file.write_text(toml_of(departure.options), encoding="utf-8")
    with patched(departure.patches):
        run_here(["dsm", *words, "-o", str(out), "--config", str(file), "--overwrite", "--workers", "1", "--no-report",
                  *departure.words], (None, 0, COVERAGE_SHORT))  # fmt: skip
    return out / "dsm.tif"


def toml_of(options: Mapping[str, Mapping[str, object]]) -> str:
    """Options as a file."""
    sections = [
        "\n".join([f"[{section}]", *(f"{name} = {value}" for name, value in values.items()), ""])
        for section, values in options.items()
    ]
    return "\n".join(sections)


@contextmanager
def patched(patches: Mapping[str, object]) -> Iterator[None]:
    """Let functions return something else. patches : see `Departure`."""
    with ExitStack() as stack:
        for name, value in patches.items():
            stack.enter_context(patch(name, _returning(value)))
        yield


def _returning(value: object) -> Any:
    return lambda *_given, **_named: value


def paired(scene: str, found: Mapping[str, Sequence[tuple[float, float]]]) -> list[Figure]:
    """Figures of all runs on the same scenes: means, and what each run loses against the default on the same scene."""
    figures, base = [], found[DEFAULT]
    for name, values in found.items():
        within, rmse = zip(*values, strict=True)
        figures += [
            Figure(f"{scene}, {name}: within 1 m", statistics.fmean(within), is_detail=True),
            Figure(f"{scene}, {name}: RMSE", statistics.fmean(rmse), "m", is_detail=True),
        ]
        if name == DEFAULT:
            continue
        lost = [of_default[0] - of_run[0] for of_default, of_run in zip(base, values, strict=True)]
        worse = [of_run[1] - of_default[1] for of_default, of_run in zip(base, values, strict=True)]
        whole = name == "all of these"
        figures.append(
            Figure(
                f"{scene}, without {name}: lost within 1 m", statistics.fmean(lost), is_detail=not whole,
                at_least=0.0 if whole else None, fails_when=LOSES if whole else "",
            )
        )  # fmt: skip
        figures.append(Figure(f"{scene}, without {name}: RMSE added", statistics.fmean(worse), "m", is_detail=True))
        if len(lost) > 1:
            error = statistics.stdev(lost) / math.sqrt(len(lost))
            figures += [
                Figure(f"{scene}, without {name}: standard error of what is lost", error, is_detail=True),
                Figure(f"{scene}, without {name}: scenes that lose", sum(each > 0 for each in lost), is_detail=True),
            ]
    return figures
