"""The order of a ranking that stands alone: scene, ties, labels of every pair of images, files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import grid_from_bounds
from zlocus.core.options import RunConfig
from zlocus.core.parallel import run_all
from zlocus.core.progress import Progress
from zlocus.core.requests import RankRequest, check_output
from zlocus.io.input_files import InputFiles, files_of
from zlocus.io.run_record import Stopwatch, made_record, write_record
from zlocus.matching.ground_pixels import check_resolution, default_cell
from zlocus.matching.match_scene import settle
from zlocus.matching.tile import rank_tile
from zlocus.matching.view_ranking import RankedPoints
from zlocus.pipeline.execution.plan import plan_tiles
from zlocus.pipeline.orient import check_ties
from zlocus.pipeline.preparing import (
    area_to_match,
    heights_asked_for,
    heights_of_ties,
    made_folder,
    note_orientation,
    opened_alone,
    oriented,
    taking_part,
)
from zlocus.products.tie_layers import counted_pairs, label_counts, write_ranking, write_ties


def run_rank(request: RankRequest, config: RunConfig, progress: Progress) -> str:
    """Label every pair of images at the tie points, as `zlocus dsm` does to choose them, and write ranking.gpkg,
    ranking.json and ties.gpkg to `request.out`; a table of what came out.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used, before anything is written.
    StoppedError
        Where an input has changed meanwhile; nothing is written.
    """
    check_output(request.out, request.overwrite)
    watch, before = Stopwatch(), InputFiles.of(request.inputs)
    with watch.stage("open"), progress.stage("Opening images"):
        scene = opened_alone(request.inputs, request.crs, request.heights)
        inputs = InputFiles.of([*request.inputs, *files_of(scene)], scene, before)
    with watch.stage("orient"):
        orientation = oriented(scene, config.orientation, scene.heights, progress)
        check_ties(orientation, scene)
        note_orientation(orientation, progress)
        scene = orientation.apply(scene)
        used = taking_part(scene, orientation)
    with watch.stage("rank"):
        if scene.heights is None:
            z_range = heights_of_ties(scene, orientation, config.orientation)
        else:
            z_range = heights_asked_for(scene, scene.heights, progress)
        z = sum(z_range) / 2
        cell = request.resolution or default_cell(scene, z)
        check_resolution(cell, scene, z, "--resolution")
        grid = grid_from_bounds(area_to_match(used, orientation, z_range), cell, scene.crs)
        settled = settle(
            used, grid.cell_m, grid.anchor, z_range, orientation.xyz, None, config.pyramid, orientation.measured
        )
        tiles = plan_tiles(grid.window, settled.seen, config.pyramid)
        ranked = []
        with progress.stage("Ranking", len(tiles)) as stage:
            for tile, found in run_all(lambda t: rank_tile(settled, t.core, config), tiles, request.workers):
                if found is not None:
                    ranked.append(RankedPoints.of(*found, settled.ties, tile.core))
                stage.advance()
    names, checksums = [view.name for view in settled.views], inputs.record()
    with watch.stage("write"), made_folder(request.out):
        write_ties(request.out / "ties.gpkg", orientation, scene)
        write_ranking(request.out / "ranking.gpkg", ranked, names, scene.crs)
        counts = label_counts(ranked, len(names))
        write_record(request.out / "ranking.json", ranking_record(counts, names))
    write_record(request.out / "run.json", made_record(request, config, checksums, watch))
    return ranking_table(counts, names)


def ranking_record(counts: NDArray[np.int64], names: Sequence[str]) -> dict[str, Any]:
    """For ranking.json: per pair of images that were compared, the points and their labels."""
    return {"images": list(names), "pairs": counted_pairs(counts, names)}


def ranking_table(counts: NDArray[np.int64], names: Sequence[str]) -> str:
    """Percent of the points at which an image (column) is good against a reference (row), the leading image first, and
    what that says in a line."""
    total = counts.sum(axis=0)
    share = np.where(total > 0, 100.0 * counts[0] / np.maximum(total, 1), np.nan)
    width = max(max(len(name) for name in names), 5) + 2
    lines = ["Points at which an image (column) alone tells the height against a reference (row), percent:"]
    lines.append("".join([" " * width, *(f"{name:>{width}}" for name in names)]))
    for name, row in zip(names, share, strict=True):
        lines.append("".join([f"{name:<{width}}", *(f"{'-' if np.isnan(v) else f'{v:.0f}':>{width}}" for v in row)]))
    of_image = [np.nanmean(share[:, j]) if np.isfinite(share[:, j]).any() else 0.0 for j in range(len(names))]
    order = sorted(range(len(names)), key=lambda j: (-of_image[j], names[j]))
    lines.append(f"From the most to the least useful: {', '.join(names[j] for j in order)}.")
    return "\n".join(lines)
