"""`zlocus rank`: setup, labels of every pair of images at the tie points, and their files, in this order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import RunConfig
from zlocus.core.parallel import run_all
from zlocus.core.progress import Progress
from zlocus.core.requests import RankRequest, SetupRequest, check_output
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import Stopwatch, result_record, write_record
from zlocus.matching.match_scene import parallax_rate
from zlocus.matching.pair_labels import LabelledTies
from zlocus.matching.tile import rank_tile
from zlocus.pipeline.execution.plan import plan_tiles
from zlocus.pipeline.messages import note_orientation
from zlocus.pipeline.orient import check_ties
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.rank_advice import SharedPoints, advice
from zlocus.pipeline.setup import RunSetup, open_inputs, orient_views, set_up_run
from zlocus.products.other_styles import write_other_styles
from zlocus.products.report.file_names import RANKING
from zlocus.products.tie_layers import TIES, counted_pairs, label_counts, write_ranking, write_ties

RANKING_TABLE = "ranking.json"


def run_rank(request: RankRequest, config: RunConfig, progress: Progress) -> str:
    """Label every pair of images at the tie points, as `zlocus dsm` does to choose images.

    Writes ranking.gpkg, ranking.json and ties.gpkg to `request.out`. Returns a table of the labels, and sentences that
    say which images to keep, to drop and to buy.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        An input that cannot be used, before anything is written.
    StoppedError
        An input has changed meanwhile; nothing is written.
    """
    check_output(request.out, request.overwrite)
    setup_request, watch, before = SetupRequest.of(request), Stopwatch(), InputFiles.of(request.inputs)
    with watch.stage("open"), progress.stage("Opening images"):
        opened_inputs = open_inputs(setup_request, progress, "unless local")
        inputs = InputFiles.of(opened_inputs.files, opened_inputs.scene, before)
    with watch.stage("orient"):
        orientation = orient_views(opened_inputs.scene, config.orientation, progress)
        check_ties(orientation, opened_inputs.scene)
        note_orientation(orientation, progress, request.heights is not None)
    with watch.stage("rank"):
        setup = set_up_run(setup_request, opened_inputs, orientation, config, progress)
        labelled_ties = rank_tiles(setup, request.workers, config, progress)
    names, checksums = [view.name for view in setup.match_scene.views], inputs.record()
    with watch.stage("write"), made_folder(request.out):
        write_ties(request.out / TIES, orientation, setup.scene)
        write_ranking(request.out / RANKING, labelled_ties, names, setup.scene.crs)
        write_other_styles(request.out, (TIES, RANKING), config.products)
        counts = label_counts(labelled_ties, len(names))
        write_record(request.out / RANKING_TABLE, ranking_record(counts, names))
    write_record(request.out / "run.json", result_record(request, config, checksums, watch))
    views = setup.match_scene.views
    rates = np.array([parallax_rate(view, setup.match_scene.ground_height) for view in views])
    said = advice(SharedPoints.of(labelled_ties, views), rates, names, config.selection)
    return "\n".join([ranking_table(counts, names), *said])


def rank_tiles(setup: RunSetup, workers: int, config: RunConfig, progress: Progress) -> list[LabelledTies]:
    """Labels of every pair of images at the tie points, tile by tile; tiles without tie points give none."""
    match_scene, labelled_ties = setup.match_scene, []
    tiles = plan_tiles(setup.grid.window, match_scene.overlap_window, config.pyramid)
    with progress.stage("Ranking", len(tiles)) as stage:
        for tile, tile_labels in run_all(lambda t: rank_tile(match_scene, t.core_window, config), tiles, workers):
            if tile_labels is not None:
                labelled_ties.append(LabelledTies.of(tile_labels, match_scene.ties, tile.core_window))
            stage.advance()
    return labelled_ties


def ranking_record(counts: NDArray[np.int64], names: Sequence[str]) -> dict[str, Any]:
    """Content of ranking.json: for each pair of images that were compared, the number of points and their labels."""
    return {"images": list(names), "pairs": counted_pairs(counts, names)}


def ranking_table(counts: NDArray[np.int64], names: Sequence[str]) -> str:
    """A table as text: percent of the points at which the pair of a reference image (row) and an image (column) is
    labelled good, and below it the images from the most to the least useful."""
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
