"""Row on the choice of images: from the paper's method to the default, which uses all images, one step at a time.

A choice by geometry alone stands beside them.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray

import judging
from peers.realistic import judged_realistic
from reprojection import Surface, reprojected
from rows.many_images import CLASSES, FACADE, JUDGE, LIDAR
from rows.photographs import import_tuniu
from rows.real_images import judged, orient, reduced_facade, without
from seeds import fresh_seeds
from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, render, rendered_images, run
from zlocus.io.scene_file import open_scene

WORSE = "a choice of images is better than all of them"
# By geometry alone as many images are used as --selection guided uses at most: the reference image and five others.
BY_GEOMETRY = "[selection]\nmax_candidates = 5\n"
# The rule of the paper for the images of a block, with our semi-global constraint: labels order the images, and decide
# alone when enough are there.
RULE_OF_PAPER = (
    '[selection]\norder = "labels"\nmax_sigma_steps = 1000.0\nstopped_share = 0.95\nmin_label_share = 0.0\n'
    "max_images = 254\n"
)
GUIDED, DEFAULT = "guided by labels and precision", "all images"
STEPS = {
    "the paper": ("", ["--selection", "paper"]),
    "its rule with the semi-global constraint": (RULE_OF_PAPER, ["--selection", "guided"]),
    GUIDED: ("", ["--selection", "guided"]),
    "geometry alone": (BY_GEOMETRY, []),
    DEFAULT: ("", []),
}
# Six images of one date, one of another date and a hazy one.
TOWN_CELLS, TOWN_VIEWS = 300, 8
DRONE_JUDGE = "100_0005_0136"
# The error of the default may be so much larger than the best of the others, and its share within 1 m so much smaller.
ERROR_MARGIN, SHARE_MARGIN = 1.02, 0.002


@dataclass(frozen=True)
class Judged:
    """error : mean absolute error (rendered scenes: root mean square error), m, or 1 less the median correlation of an
    image left out; within : share of the cells within 1 m, None where no heights are known; cpu_s : of the whole run;
    spread : standard deviation of the error over the seeds, None without seeds."""

    error: float
    within: float | None
    cpu_s: float
    spread: float | None = None


def choice_of_images(workplace: Workplace) -> list[Figure]:
    """Every step on every scene, and how far the default is behind the best of the others."""
    figures = []
    for scene, judge in SCENES.items():
        found = {step: judge(workplace, workplace.out / place_of(scene, step), step) for step in STEPS}
        for step, one in found.items():
            figures.append(Figure(f"{scene}, {step}: error", one.error, is_detail=True))
            figures.append(Figure(f"{scene}, {step}: CPU", one.cpu_s, "s", is_detail=True))
            if one.within is not None:
                figures.append(Figure(f"{scene}, {step}: within 1 m", one.within, is_detail=True))
            if one.spread is not None:
                figures.append(Figure(f"{scene}, {step}: spread of the error", one.spread, "m", is_detail=True))
        figures += behind_the_best(scene, found)
    return figures


def behind_the_best(scene: str, found: dict[str, Judged]) -> list[Figure]:
    """How far the default is behind the best of the other steps on a scene."""
    default, others = found[DEFAULT], [one for step, one in found.items() if step != DEFAULT]
    figures = [
        Figure(
            f"{scene}: error over the best", default.error / min(one.error for one in others), at_most=ERROR_MARGIN,
            fails_when=WORSE,
        ),
        Figure(f"{scene}: CPU over that of the choice by labels", default.cpu_s / found[GUIDED].cpu_s),
    ]  # fmt: skip
    if default.within is not None:
        lost = max(one.within for one in others if one.within is not None) - default.within
        figures.append(Figure(f"{scene}: within 1 m below the best", lost, at_most=SHARE_MARGIN, fails_when=WORSE))
    return figures


def place_of(scene: str, step: str) -> str:
    """Name of a folder for a run."""
    return f"{scene}-{step}".replace(",", "").replace(" ", "-")


def surface(inputs: Sequence[Path], out: Path, step: str, *options: object) -> float:
    """Make a surface by one of `STEPS`; its CPU time, s."""
    config, more = STEPS[step]
    out.parent.mkdir(parents=True, exist_ok=True)
    if config:
        file = out.with_name(f"{out.name}.toml")
        file.write_text(config, encoding="utf-8")
        more = [*more, "--config", file]
    plain = ["--products", "none", "--no-report", "--overwrite"]
    return run([ZLOCUS, "dsm", *inputs, "-o", out, *plain, *options, *more], accept=(0, COVERAGE_SHORT)).cpu_s


def spoiled_town(workplace: Workplace, out: Path, step: str) -> Judged:
    """Eight images of the rendered town, one of another date and one hazy."""
    return town(workplace.scene("rendered-city"), out, step)


def town(scene: Path, out: Path, step: str) -> Judged:
    """All images of a rendered town against its truth."""
    cpu_s = surface(sorted(scene.glob("img_*.tif")), out, step, "--resolution", 0.5)
    found = judging.judged(out / "dsm.tif", scene / "truth_dsm.tif", scene / "truth_class.tif")["all"]
    return Judged(found["rmse"], found["within"], cpu_s)


def spoiled_towns(workplace: Workplace, out: Path, step: str) -> Judged:
    """Means over the rendered towns of ten seeds, each seen by eight images of which two are spoiled."""
    found = []
    for seed in fresh_seeds():
        scene = workplace.out / f"town-{seed}"
        if not (scene / "truth_dsm.tif").exists():
            render(scene, "city", TOWN_CELLS, "--seed", seed, "--views", TOWN_VIEWS)
        found.append(town(scene, out / str(seed), step))
    errors, within, cpu_s = ([getattr(one, name) for one in found] for name in ("error", "within", "cpu_s"))
    return Judged(statistics.fmean(errors), statistics.fmean(within), sum(cpu_s), statistics.stdev(errors))


def realistic_scene(workplace: Workplace, out: Path, step: str) -> Judged:
    """Six images of a realistic scene."""
    scene = workplace.scene("rendered-real-a")
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        area = ["--resolution", 0.5, "--crs", truth.crs.to_string(), "--bounds", *truth.bounds]
    images = rendered_images(scene, ("n1", "f1", "b1", "n2", "f2", "s1"))
    cpu_s = surface(images, out, step, *area)
    found = judged_realistic(scene, out / "dsm.tif")["all"]
    return Judged(found["rmse"], found["within"], cpu_s)


def jacksonville(workplace: Workplace, out: Path, step: str, n_images: int) -> Judged:
    """The first images of ten months, registered to laser heights."""
    scene = workplace.scene("worldview3_jax068")
    images = sorted(scene.glob("*_RGB.tif"))[:n_images]
    cpu_s = surface(images, out, step, "--like", scene / LIDAR)
    found = workplace.judge_registered(out / "dsm.tif", scene / LIDAR, scene / CLASSES)["all"]
    return Judged(found["mae"], found["within1"], cpu_s)


def seven_of_jacksonville(workplace: Workplace, out: Path, step: str) -> Judged:
    """Seven images, of which some are chosen."""
    return jacksonville(workplace, out, step, 7)


def all_of_jacksonville(workplace: Workplace, out: Path, step: str) -> Judged:
    """Nineteen images, none of which is left out by default."""
    return jacksonville(workplace, out, step, 19)


def triplet(workplace: Workplace, out: Path, step: str) -> Judged:
    """Three Pleiades images against the surface that S2P made of them, which has errors of its own."""
    scene = workplace.scene("pleiades_triplet_calanques")
    reference = scene / "reference" / "s2p_dsm_0.5m_utm31n.tif"
    cpu_s = surface(sorted(scene.glob("img_0*.tif")), out, step, "--like", reference)
    expected, difference = heights_of(reference), heights_of(out / "dsm.tif") - heights_of(reference)
    apart = np.abs(difference - np.nanmedian(difference))
    within = (apart[np.isfinite(expected)] < 1.0).mean()  # False for cells without a height
    return Judged(float(np.nanmean(apart)), float(within), cpu_s)


def heights_of(path: Path) -> NDArray[np.float32]:
    """Heights of a raster, (r, c) m, NaN where it has none."""
    with rasterio.open(path) as file:
        return np.asarray(file.read(1, masked=True).filled(np.nan), np.float32)


def drone(workplace: Workplace, out: Path, step: str) -> Judged:
    """Three oblique images of a drone; the fourth judges."""
    oriented = orient([import_tuniu(workplace, workplace.out / "tuniu")], workplace.out / "tuniu" / "oriented")
    rest = without(oriented, [DRONE_JUDGE], oriented.with_name("three.yaml"))
    cpu_s = surface([rest], out, step)
    found = judged(Surface.read(out / "dsm.tif"), open_scene([oriented]).views, DRONE_JUDGE)
    return Judged(1 - found.median, None, cpu_s)


def facade(workplace: Workplace, out: Path, step: str) -> Judged:
    """Seven photographs of a facade; the eighth judges."""
    scene = reduced_facade(workplace)
    views = {view.name: view for view in open_scene([scene]).views}
    left = without(scene, set(views) - set(FACADE), scene.with_name("seven.yaml"))
    cpu_s = surface([left], out, step)
    found = reprojected(Surface.read(out / "dsm.tif"), [views[name] for name in FACADE], [views[JUDGE]])
    return Judged(1 - statistics.fmean(one.median for one in found.values()), None, cpu_s)


SCENES = {
    "town, two of eight spoiled": spoiled_town,
    "towns of ten seeds, two of eight spoiled": spoiled_towns,
    "realistic scene a, six": realistic_scene,
    "Jacksonville, seven": seven_of_jacksonville,
    "Jacksonville, nineteen": all_of_jacksonville,
    "triplet": triplet,
    "tuniu, three": drone,
    "Herz-Jesu, seven": facade,
}
