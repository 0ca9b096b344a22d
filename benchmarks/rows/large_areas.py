"""Rows of the acceptance table on large areas: effect of the halo of tiles, and growth of time and memory."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rasterio

import large
from workplace import ZLOCUS, Figure, Workplace, rendered_images, run

# Cells of overlap of a tile with its neighbours: by default, and in the comparison.
USUAL_HALO, WIDER = 32, {"twice": 64, "four times": 128}
# Side of a town of nine tiles; and tiles of a quarter of the usual side, so that a small town has many seams.
HALO_TOWN_PX, SMALL_TILE = 3500, 256
# Largest share of the cells that a wider halo may change by more than half a height step.
MAX_CHANGED = 1e-3
# Millions of cells of a run of the usual size, and of a large one.
USUAL_M, LARGE_M = 4.0, 100.0
# Bars: CPU per cell of the large run over that of the usual one, memory of a process, gain of a second worker.
MAX_GROWTH, MAX_WORKER_GB, MIN_SPEED_UP = 1.15, 4.0, 1.8

HOLDS_ALL = "a process holds whole images or rasters instead of tiles"
GROWS = "a stage compares all tiles, images or ties with each other"
WAITS = "workers wait for the command or for each other"


def halo(workplace: Workplace) -> list[Figure]:
    """Share of the cells of two towns that change when the halo is wider."""
    small = workplace.scene("rendered-city")
    with tempfile.TemporaryDirectory(dir=workplace.out.parent) as scratch:
        town = large.write_views(Path(scratch), large.town(), 6, HALO_TOWN_PX)
        options = ["--crs", "EPSG:32632", *map(str, town)]
        return [
            *changes(workplace, options, None, {"twice": WIDER["twice"]}),
            *changes(workplace, rendered_images(small), SMALL_TILE, WIDER),
        ]


def changes(
    workplace: Workplace, images: Sequence[str | Path], tile: int | None, wider: dict[str, int]
) -> list[Figure]:
    """Share of the cells that change with each halo of `wider`. tile : cells along a side, None for the usual size."""
    heights, step_m = {}, 0.0
    for cells in (USUAL_HALO, *wider.values()):
        out, options = workplace.out / f"halo{cells}", workplace.out / f"{cells}.toml"
        options.parent.mkdir(parents=True, exist_ok=True)
        options.write_text(f"[pyramid]\nhalo = {cells}\n" + (f"tile = {tile}\n" if tile else ""))
        run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--config", options, "--overwrite", "--no-report"])
        heights[cells], step_m = heights_of(out), large.record_of(out)["heights"]["step_m"]
    of = f"tiles of {tile}" if tile else "usual tiles"
    return [
        Figure(f"{of}, changed by a halo {name} as wide", changed(heights[USUAL_HALO], heights[cells], step_m),
               at_most=MAX_CHANGED, fails_when="a decision of a tile depends on cells outside its halo")
        for name, cells in wider.items()
    ]  # fmt: skip


def changed(one: np.ndarray, other: np.ndarray, step_m: float) -> float:
    """Share of the cells that differ by more than half a step, or that have a height in only one of the surfaces."""
    both = np.isfinite(one) & np.isfinite(other)
    differs = np.isfinite(one) != np.isfinite(other)
    differs[both] = np.abs(one[both] - other[both]) > step_m / 2
    return float(differs.mean())


def heights_of(out: Path) -> np.ndarray:
    """Heights of a run, (r, c) m, NaN without a height."""
    with rasterio.open(out / "dsm.tif") as file:
        return file.read(1)


def growth(
    workplace: Workplace, usual_m: float = USUAL_M, large_m: float = LARGE_M, period_px: int = large.PERIOD_PX
) -> list[Figure]:
    """Cost of 100 million cells of six images compared with 4 million, and of two workers compared with one.

    usual_m, large_m : size of the two areas in millions of cells; period_px : side of the town that is repeated.
    """
    town, rows = large.town(period_px), {}
    with tempfile.TemporaryDirectory(dir=workplace.out.parent) as scratch:
        for million in (usual_m, large_m):
            images = large.write_views(Path(scratch), town, 6, round((million * 1e6) ** 0.5))
            for workers in (1, 2):
                rows[million, workers] = large.measured(images, Path(scratch) / "out", workers, 2 * MAX_WORKER_GB)
    one, two, usual = rows[large_m, 1], rows[large_m, 2], rows[usual_m, 2]
    return [
        Figure("million cells", two.million),
        Figure("worker's memory", two.worker_mb / 1e3, "GB", at_most=MAX_WORKER_GB, fails_when=HOLDS_ALL),
        Figure("command's memory", two.command_mb / 1e3, "GB", at_most=MAX_WORKER_GB, fails_when=HOLDS_ALL),
        Figure(f"CPU per cell over that of {usual_m:g} M", two.cpu_s_per_million / usual.cpu_s_per_million,
               at_most=MAX_GROWTH, fails_when=GROWS),
        Figure(f"CPU per cell over that of {usual_m:g} M, matching only",
               two.match_cpu_s / two.million * usual.million / usual.match_cpu_s,
               at_most=MAX_GROWTH, fails_when=GROWS),
        Figure("two workers over one", one.wall_s / two.wall_s, at_least=MIN_SPEED_UP, fails_when=WAITS),
        Figure("two workers over one, matching only", one.match_s / two.match_s, at_least=MIN_SPEED_UP,
               fails_when=WAITS),
    ]  # fmt: skip
