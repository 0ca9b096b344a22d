"""Rows of the acceptance table on large areas: what halos change, and how time and memory grow."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rasterio

import scaling
from workplace import ZLOCUS, Figure, Workplace, rendered_images, run

# Halos, in cells; a town of nine tiles; and tiles of a quarter of the usual side, so that a small town has many seams.
USUAL_HALO, WIDER = 32, {"twice": 64, "four times": 128}
HALO_TOWN_PX, SMALL_TILE = 3500, 256
# Cells that a wider halo may change by more than half a height step.
CHANGED = 1e-3
# Cells asked for, in millions: a run of the usual size, and a large one.
USUAL_M, LARGE_M = 4.0, 100.0
GROWTH, WORKER_GB, SPEED_UP = 1.15, 4.0, 1.8


def halo(at: Workplace) -> list[Figure]:
    """Share of the cells of a town that wider halos change."""
    small = at.scene("rendered-city")
    with tempfile.TemporaryDirectory(dir=at.out.parent) as scratch:
        town = scaling.write_views(Path(scratch), scaling.town(), 6, HALO_TOWN_PX)
        options = ["--crs", "EPSG:32632", *map(str, town)]
        return [
            *changes(at, options, None, {"twice": WIDER["twice"]}),
            *changes(at, rendered_images(small), SMALL_TILE, WIDER),
        ]


def changes(at: Workplace, images: Sequence[str | Path], tile: int | None, wider: dict[str, int]) -> list[Figure]:
    """What halos do to a town. tile : cells a side, None for the usual size."""
    heights, step_m = {}, 0.0
    for cells in (USUAL_HALO, *wider.values()):
        out, options = at.out / f"halo{cells}", at.out / f"{cells}.toml"
        options.parent.mkdir(parents=True, exist_ok=True)
        options.write_text(f"[pyramid]\nhalo = {cells}\n" + (f"tile = {tile}\n" if tile else ""))
        run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--config", options, "--overwrite", "--no-report"])
        heights[cells], step_m = heights_of(out), scaling.record_of(out)["heights"]["step_m"]
    of = f"tiles of {tile}" if tile else "usual tiles"
    return [
        Figure(f"{of}, changed by a halo {name} as wide", changed(heights[USUAL_HALO], heights[cells], step_m),
               at_most=CHANGED)
        for name, cells in wider.items()
    ]  # fmt: skip


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


def growth(
    at: Workplace, usual_m: float = USUAL_M, large_m: float = LARGE_M, period_px: int = scaling.PERIOD_PX
) -> list[Figure]:
    """100 M cells of six images beside 4 M cells, and two workers beside one.

    usual_m, large_m : cells asked for, in millions; period_px : side of the town that is repeated.
    """
    town, rows = scaling.town(period_px), {}
    with tempfile.TemporaryDirectory(dir=at.out.parent) as scratch:
        for million in (usual_m, large_m):
            images = scaling.write_views(Path(scratch), town, 6, round((million * 1e6) ** 0.5))
            for workers in (1, 2):
                rows[million, workers] = scaling.measured(images, Path(scratch) / "out", workers, 2 * WORKER_GB)
    one, two, usual = rows[large_m, 1], rows[large_m, 2], rows[usual_m, 2]
    return [
        Figure("million cells", two.million, at_least=large_m),
        Figure("worker's memory", two.worker_mb / 1e3, "GB", at_most=WORKER_GB),
        Figure("command's memory", two.command_mb / 1e3, "GB", at_most=WORKER_GB),
        Figure(f"CPU per cell over that of {usual_m:g} M", two.cpu_s_per_million / usual.cpu_s_per_million,
               at_most=GROWTH),
        Figure("the same, matching alone", two.match_cpu_s / two.million * usual.million / usual.match_cpu_s,
               at_most=GROWTH),
        Figure("two workers over one", one.wall_s / two.wall_s, at_least=SPEED_UP),
        Figure("the same, matching alone", one.match_s / two.match_s, at_least=SPEED_UP),
    ]  # fmt: skip
