"""Row of the acceptance table on the warnings of quality.tif and the recipe of the README for trusted heights.

A warning is worth something where its cells are wrong more often than others, where it marks most of what is wrong, and
where it marks few of the right heights.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio

from precision import VIEWS, errors_of, rendered, run
from rows.drone_block import errors_of_cells, provide_block, true_cells
from seeds import fresh_seeds
from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace
from workplace import run as run_command
from zlocus.evaluation.heights import read_heights
from zlocus.matching.quality import Quality, is_water
from zlocus.synthetic.drone_block import DroneBlockSpec

WARNINGS = (Quality.WEAK, Quality.AMBIGUOUS, Quality.JUMP, Quality.UNREFINED, Quality.DISPUTED, Quality.PLANE)
# Scenes of each recipe, all from three images; the frames of the drone are small, and the block is seen as a whole.
N_SCENES = {"real": 3, "city": 2, "hills": 2}
LABELS = {"real": "realistic scenes", "city": "towns", "hills": "hills"}
DRONE = "drone images"
DRONE_SPEC = DroneBlockSpec(columns=1200, rows=900, strips=3, frames_per_strip=4, focal_px=900.0)
# A height is right within so many cells, and wrong beyond; the recipe trusts a sigma below so many cells.
RIGHT_CELLS, TRUSTED_CELLS = 2.0, 2.0
MAX_SIGMAS = 3.0
# These marked a third of the right heights and more; they may mark so many.
MAX_RIGHT_MARKED = {Quality.UNREFINED: 0.25, Quality.DISPUTED: 0.25}
MIN_RIGHT_KEPT = 0.75
# With fewer marked cells the shares of a flag say nothing.
MIN_CELLS = 200


@dataclass(frozen=True)
class FlaggedHeights:
    """Heights of known errors, (n,) each: error_cells, sigma_cells, both in sides of a cell; quality : uint16."""

    error_cells: np.ndarray
    sigma_cells: np.ndarray
    quality: np.ndarray


def flags(workplace: Workplace) -> list[Figure]:
    """Realistic scenes, towns, hills and a block of drone images that nobody could tune to."""
    seeds = fresh_seeds(max(N_SCENES.values()))
    workplace.inputs["seeds"] = seeds
    workplace.out.mkdir(parents=True, exist_ok=True)
    figures = []
    for kind, n in N_SCENES.items():
        scenes = [of_scene(rendered(kind, seed, workplace.out), workplace.out / "run") for seed in seeds[:n]]
        figures += figures_of(LABELS[kind], scenes)
    return [*figures, *figures_of(DRONE, [of_drone_block(workplace.out / "drone", seeds[0])])]


def of_scene(folder: Path, out: Path) -> FlaggedHeights:
    """The heights of a rendered scene from three images."""
    run(folder, VIEWS[3], out)
    _, xy, errors = errors_of(folder, out / "dsm.tif")
    return flagged(out, xy, errors)


def of_drone_block(folder: Path, seed: int) -> FlaggedHeights:
    """The heights of a block of drone images at twice the ground pixel."""
    spec = DroneBlockSpec(**{**vars(DRONE_SPEC), "seed": seed})
    scene, out = folder / "block", folder / "dsm"
    provide_block(spec, scene)
    command = [ZLOCUS, "dsm", scene / "scene.yaml", "-o", out, "--resolution", 2 * spec.ground_pixel_m]
    run_command([*command, "--workers", 1, "--no-report", "--overwrite"], accept=(0, COVERAGE_SHORT))
    surface = read_heights(out / "dsm.tif")
    cells = true_cells(surface, scene)
    return flagged(out, cells.xy, errors_of_cells(surface.nearest(cells.xy), cells.heights))


def flagged(out: Path, xy: np.ndarray, errors: np.ndarray) -> FlaggedHeights:
    """Errors beside sigma and flags. out : folder of the surface; xy : (n, 2) m; errors : (n,) m, NaN where empty."""
    cell_m = abs(json.loads((out / "run.json").read_text(encoding="utf-8"))["grid"]["transform"][0])
    sigma = read_heights(out / "sigma.tif").nearest(xy)
    known = np.isfinite(errors) & np.isfinite(sigma)
    with rasterio.open(out / "quality.tif") as file:
        col, row = ~file.transform * (xy[known, 0], xy[known, 1])
        quality = file.read(1)[np.floor(row).astype(int), np.floor(col).astype(int)]
    return FlaggedHeights(np.abs(errors[known]) / cell_m, sigma[known] / cell_m, quality)


def figures_of(label: str, scenes: Sequence[FlaggedHeights]) -> list[Figure]:
    """Means over the scenes of a recipe: what each warning marks, and what the recipe of the README keeps."""

    def mean(share: Callable[[FlaggedHeights], float]) -> float:
        shares = [share(scene) for scene in scenes]
        return float(np.nanmean(shares)) if np.isfinite(shares).any() else float("nan")

    figures = [
        Figure(f"{label}, heights off by more than 3 sigma", mean(lambda one: float(is_off(one).mean()))),
        Figure(f"{label}, wrong heights", mean(lambda one: float(is_wrong(one).mean()))),
    ]
    for flag in WARNINGS:
        if all(has_flag(scene, flag).sum() < MIN_CELLS for scene in scenes):
            continue
        name = f"{label}, {flag.name}"
        figures += [
            Figure(f"{name}: marked, off by more than 3 sigma", mean(lambda one, f=flag: _share(is_off(one), one, f))),
            Figure(f"{name}: marked, wrong", mean(lambda one, f=flag: _share(is_wrong(one), one, f))),
            Figure(f"{name}: of the wrong heights", mean(lambda one, f=flag: _of(one, f, is_wrong(one)))),
            Figure(
                f"{name}: of the right heights", mean(lambda one, f=flag: _of(one, f, ~is_wrong(one))),
                at_most=MAX_RIGHT_MARKED.get(flag),
                fails_when="the flag warns of heights that are right" if flag in MAX_RIGHT_MARKED else "",
            ),
        ]  # fmt: skip
    trusted = "sigma below two cells"
    return [
        *figures,
        Figure(
            f"{label}, {trusted}: right heights kept", mean(lambda one: float(is_trusted(one)[~is_wrong(one)].mean())),
            at_least=MIN_RIGHT_KEPT, fails_when="sigma is large where heights are right",
        ),
        Figure(
            f"{label}, {trusted}: wrong heights among the kept",
            mean(lambda one: float(is_wrong(one)[is_trusted(one)].mean())),
        ),
    ]  # fmt: skip


def is_off(heights: FlaggedHeights) -> np.ndarray:
    """(n,) bool: heights off by more than 3 sigma."""
    return heights.error_cells > MAX_SIGMAS * heights.sigma_cells


def is_wrong(heights: FlaggedHeights) -> np.ndarray:
    """(n,) bool: heights off by more than two cells."""
    return heights.error_cells > RIGHT_CELLS


def is_trusted(heights: FlaggedHeights) -> np.ndarray:
    """(n,) bool: heights that the recipe of the README keeps."""
    return heights.sigma_cells < TRUSTED_CELLS


def has_flag(heights: FlaggedHeights, flag: Quality) -> np.ndarray:
    """(n,) bool: heights with a flag; water, whose flags are its own, has none."""
    return ((heights.quality & np.uint16(flag)) != 0) & ~is_water(heights.quality)


def _share(is_bad: np.ndarray, heights: FlaggedHeights, flag: Quality) -> float:
    """Share of the cells with a flag that are bad; NaN where too few have it."""
    marked = has_flag(heights, flag)
    return float(is_bad[marked].mean()) if marked.sum() >= MIN_CELLS else float("nan")


def _of(heights: FlaggedHeights, flag: Quality, group: np.ndarray) -> float:
    """Share of a group of heights that has a flag."""
    return float(has_flag(heights, flag)[group].mean())
