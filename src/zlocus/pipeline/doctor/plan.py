"""Plan of a full run: cells, tiles, memory and time."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zlocus.core.footprints import matched_area
from zlocus.core.options import RunConfig
from zlocus.core.requests import DoctorRequest, SetupRequest
from zlocus.core.resources import WORKER_BYTES
from zlocus.core.scene import Scene, is_local
from zlocus.pipeline.doctor.findings import POOR, STOPS, Finding
from zlocus.pipeline.doctor.ties import QuickTies
from zlocus.pipeline.execution.plan import kept_bytes, plan_tiles, tile_needs
from zlocus.pipeline.extent import Extent, area_of, ground_height, seen_sentence, seen_share
from zlocus.pipeline.required_space import check_room
from zlocus.pipeline.setup import check_cells, grid_of_run, match_scene_of_run

# Factor by which the time may be shorter or longer, on other machines, height ranges and kinds of ground.
ROUGHLY = 3.0


@dataclass(frozen=True)
class RunPlan:
    """Plan of a run with the given options.

    cell_m, shape : of the products; heights, step_m, n_steps : of the search; tile_bytes : memory of one tile;
    workers : tiles at a time, as asked and as memory and tiles allow; machine_bytes : memory of this machine, None
    where it does not say; view_cells : cells times images that see them; seconds : of matching, a rough estimate;
    extent : of the products; seen_share : share of the area asked for that two images see, None where none is asked
    for.
    """

    cell_m: float
    shape: tuple[int, int]
    heights: tuple[float, float]
    step_m: float
    n_steps: int
    n_tiles: int
    tile_bytes: int
    workers: int
    machine_bytes: int | None
    view_cells: float
    seconds: float
    extent: Extent
    seen_share: float | None = None


def run_plan(
    request: DoctorRequest, config: RunConfig, scene: Scene, ties: QuickTies, outlines: Sequence[Any]
) -> RunPlan:
    """The plan of a surface. scene : with corrected cameras; outlines : footprint of each view.

    Raises
    ------
    ConfigError, GeometryError, OutputError
        A run would stop for the same reason.
    """
    setup_request, height_range = SetupRequest.of(request), ties.height_range
    grid = grid_of_run(setup_request, None, scene, ties.orientation, height_range)
    check_cells(setup_request, scene, height_range, grid, config)
    match_scene = match_scene_of_run(setup_request, scene, ties.orientation, height_range, grid, config)
    matched_area(grid, match_scene.overlap_window)  # says where both lie
    check_room(request.out or Path(), grid, match_scene, match_scene.has_colours)
    tiles = plan_tiles(grid.window, match_scene.overlap_window, config.pyramid)
    needs = tile_needs(match_scene, tiles, config)
    tile_bytes = int(needs.n_bytes + kept_bytes(match_scene) + WORKER_BYTES)
    fit = request.workers if request.memory_gb is None else int(request.memory_gb * 1e9 / tile_bytes)
    workers = max(min(request.workers, fit, len(tiles)), 1)
    area, is_asked = area_of(grid), request.bounds is not None or scene.bounds is not None
    z = ground_height(ties.orientation, height_range)
    share = seen_share(scene, z, area) if is_asked and not is_local(scene.crs) else None
    view_cells = sum(outline.intersection(area).area for outline in outlines) / grid.cell_m**2
    return RunPlan(
        cell_m=grid.cell_m,
        shape=(grid.window.rows, grid.window.cols),
        heights=height_range.searched,
        step_m=match_scene.height_step,
        n_steps=match_scene.n_steps,
        n_tiles=len(tiles),
        tile_bytes=tile_bytes,
        workers=workers,
        machine_bytes=machine_memory_bytes(),
        view_cells=view_cells,
        seconds=needs.seconds / min(workers, os.cpu_count() or 1),
        extent=Extent.of(grid, scene.crs),
        seen_share=share,
    )


def machine_memory_bytes() -> int | None:
    """Memory of this machine; None where it is unknown."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None


def plan_findings(plan: RunPlan, memory_gb: float | None) -> list[Finding]:
    """Findings about the area of the plan, and the memory that it needs."""
    tile_gb, needed = plan.tile_bytes / 1e9, plan.tile_bytes * plan.workers
    smaller = "set a smaller pyramid.tile in --config"
    found = [Finding(POOR, sentence)] if (sentence := seen_sentence(plan.seen_share, "about ")) else []
    if memory_gb is not None and tile_gb > memory_gb:
        sentence = f"--memory {memory_gb:g} GB is too little for one tile, which needs about {tile_gb:.1f} GB."
        found.append(Finding(STOPS, f"{sentence} Allow more, or {smaller}."))
        return found
    if plan.machine_bytes is not None and needed > plan.machine_bytes:
        sentence = (
            f"{plan.workers} tiles at a time need about {needed / 1e9:.1f} GB, and this machine has "
            f"{plan.machine_bytes / 1e9:.1f} GB."
        )
        found.append(Finding(POOR, f"{sentence} Use fewer --workers, give --memory, or {smaller}."))
    return found
