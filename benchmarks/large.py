"""Rows of the acceptance table on large areas: what halos change, and how time and memory grow."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import rasterio

import scaling
from workplace import ZLOCUS, Figure, Workplace, rendered_images, run

# Tiles of a quarter of the usual side, so that a town has many, and halos of which each is wider than the usual one.
HALO_TILE, HALOS = 256, {"usual": 32, "twice": 64, "four times": 128}
# Cells that a wider halo may change by more than half a height step.
CHANGED = 1e-3
# Cells asked for, in millions: a run of the usual size, and a large one.
USUAL_M, LARGE_M = 4.0, 100.0
GROWTH, WORKER_GB, SPEED_UP = 1.15, 4.0, 1.8


def halo(at: Workplace) -> list[Figure]:
    """Share of the cells of a town that wider halos change."""
    scene, steps, heights = at.scene("rendered-city"), {}, {}
    for name, cells in HALOS.items():
        out, options = at.out / name, at.out / f"{cells}.toml"
        options.parent.mkdir(parents=True, exist_ok=True)
        options.write_text(f"[pyramid]\ntile = {HALO_TILE}\nhalo = {cells}\n")
        run(
            [ZLOCUS, "dsm", *rendered_images(scene), "-o", out, "--resolution", 0.5, "--config", options, "--overwrite"]
        )
        heights[name], steps[name] = heights_of(out), scaling.record_of(out)["heights"]["step_m"]
    usual = heights.pop("usual")
    return [
        Figure(f"changed by a halo {name} as wide", changed(usual, wide, steps["usual"]), at_most=CHANGED)
        for name, wide in heights.items()
    ]


def changed(one: np.ndarray, other: np.ndarray, step_m: float) -> float:
    """Share of all cells whose heights differ by more than half a step; one that only one surface has does."""
    both = np.isfinite(one) & np.isfinite(other)
    differs = np.isfinite(one) != np.isfinite(other)
    differs[both] = np.abs(one[both] - other[both]) > step_m / 2
    return float(differs.mean())


def heights_of(out: Path) -> np.ndarray:
    """Heights of a run, m."""
    with rasterio.open(out / "dsm.tif") as file:
        return file.read(1)


def growth(at: Workplace) -> list[Figure]:
    """100 M cells of six images beside 4 M cells, and two workers beside one."""
    town, rows = scaling.town(), {}
    with tempfile.TemporaryDirectory(dir=at.out.parent) as scratch:
        for million in (USUAL_M, LARGE_M):
            images = scaling.write_views(Path(scratch), town, 6, round((million * 1e6) ** 0.5))
            for workers in (1, 2):
                rows[million, workers] = scaling.measured(images, Path(scratch) / "out", workers, 2 * WORKER_GB)
    one, two, usual = rows[LARGE_M, 1], rows[LARGE_M, 2], rows[USUAL_M, 2]
    return [
        Figure("million cells", two.million, at_least=LARGE_M),
        Figure("worker's memory", two.worker_mb / 1e3, "GB", at_most=WORKER_GB),
        Figure("command's memory", two.command_mb / 1e3, "GB", at_most=WORKER_GB),
        Figure("CPU per cell over that of 4 M", two.cpu_s_per_million / usual.cpu_s_per_million, at_most=GROWTH),
        Figure("the same, matching alone", two.match_cpu_s / two.million * usual.million / usual.match_cpu_s,
               at_most=GROWTH),
        Figure("two workers over one", one.wall_s / two.wall_s, at_least=SPEED_UP),
        Figure("the same, matching alone", one.match_s / two.match_s, at_least=SPEED_UP),
    ]  # fmt: skip
