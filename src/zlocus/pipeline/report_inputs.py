"""What a run keeps for its report: footprints and pairs of images, match curves of a few cells, and the page itself."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import GeometryError, ZlocusError
from zlocus.core.footprints import pair_geometries, view_geometry
from zlocus.core.grid import CellWindow, Grid
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.scene import Scene
from zlocus.core.sensor_model import FloatArray
from zlocus.io.run_record import write_record
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.pair_labels import LabelledTies
from zlocus.matching.point_match import Place, cell_of, curves_at, height_nearby
from zlocus.matching.tile import rank_tile
from zlocus.orientation.parameter_groups import kind_of
from zlocus.pipeline.setup import RunSetup
from zlocus.products.footprints import write_footprints
from zlocus.products.match_curve_drawing import mean_svg
from zlocus.products.point_report import PointReport, point_record
from zlocus.products.report.example_cells import FAILED, RULE, ChosenCell, chosen_cells
from zlocus.products.report.file_names import CURVES, FOOTPRINTS, RANKING, REPORT
from zlocus.products.report.page import write_report
from zlocus.products.report.sampling import Survey, survey_rasters
from zlocus.products.report.tables import MAX_MATRIX_IMAGES
from zlocus.products.tie_layers import counted_pairs, label_counts

# The number of pairs grows with the square of the number of views.
MOST_VIEWS_PAIRED = 60
# Time limit for the curves: this share of the time of matching, but at least this time.
TIME_SHARE, LEAST_TIME_S = 0.02, 10.0
# Where a run ranked no images, pairs are labelled at this many places along each side, each this many blocks wide.
SAMPLE_PLACES, SAMPLE_BLOCKS = 3, 2
# Distance in cells within which tie points around a cell are used.
SHOWN_WITHIN_CELLS = 512
NOT_SHOWN = "Fewer than two images show this cell, and the window around it, at the height looked at."


@dataclass(frozen=True)
class ReportedRun:
    """A run as its report shows it.

    scene : all views, with corrected cameras; ties : (n, 3) m, ground points; undulation : for ground points (n, 2),
    the height (n,) m above the ellipsoid of the vertical datum of dsm.tif.
    """

    scene: Scene
    match_scene: MatchScene
    grid: Grid
    ties: FloatArray
    undulation: Callable[[FloatArray], FloatArray] = lambda xy: np.zeros(len(xy))

    @classmethod
    def of(cls, setup: RunSetup, vertical_datum: VerticalDatum) -> ReportedRun:
        """The run with this setup, whose heights are above a vertical datum."""
        scene = setup.scene
        return cls(
            scene, setup.match_scene, setup.grid, setup.orientation.xyz,
            lambda xy: vertical_datum.undulation(xy, scene.crs),
        )  # fmt: skip


def write_shown(
    out: Path,
    run: ReportedRun,
    config: RunConfig,
    match_s: float,
    progress: Progress,
    names: Collection[str] = (FOOTPRINTS, CURVES),
) -> None:
    """Write footprints.geojson and curves.json; a note says where that fails.

    match_s : time of the matching, which limits the time for curves; names : which of the two files.
    """
    most_s = max(LEAST_TIME_S, TIME_SHARE * match_s)
    if FOOTPRINTS in names:
        _tried(FOOTPRINTS, lambda: write_views(out / FOOTPRINTS, run), progress)
    if CURVES in names:
        _tried(CURVES, lambda: write_curves(out / CURVES, out, run, config, most_s), progress)


def try_report(out: Path, progress: Progress) -> None:
    """Write report.html; a note says where that fails."""
    with progress.stage("Report"):
        _tried(REPORT, lambda: write_report(out), progress)


def _tried(name: str, write: Callable[[], Any], progress: Progress) -> None:
    """Write a file, or note why it is missing: a complete surface does not fail because of its report."""
    try:
        write()
    except Exception as error:
        progress.note(f"{name} was not made: {said(error)} The surface does not depend on it.")


def write_views(path: Path, run: ReportedRun) -> None:
    """Write footprints at the median height of the tie points, with properties of images and of overlapping pairs."""
    views = run.scene.views
    z = float(np.median(run.ties[:, 2])) if len(run.ties) else middle_height(run.match_scene)
    geometry = [view_geometry(view, z) for view in views]
    features: list[tuple[Any, dict[str, Any]]] = [
        (
            found.outline,
            {
                "kind": "image", "name": view.name, "sensor": kind_of(view.sensor), "shape": list(view.image.shape),
                "ground_px_m": rounded(found.ground_px_m),
            },
        )
        for view, found in zip(views, geometry, strict=True)
    ]  # fmt: skip
    if len(views) <= MOST_VIEWS_PAIRED:
        features += [
            (
                pair.shared,
                {
                    "kind": "overlap", "views": [views[i].name for i in pair.views], "overlap": rounded(pair.overlap),
                    "base_to_height": rounded(pair.base_to_height),
                },
            )
            for pair in pair_geometries(views, [each.outline for each in geometry], z)
        ]  # fmt: skip
    write_footprints(path, features, run.scene.crs)


def write_curves(path: Path, folder: Path, run: ReportedRun, config: RunConfig, most_s: float) -> None:
    """Write match curves of example cells of the surface in a folder; a cell without curves gets its error."""
    surface_survey, start, cells = survey_rasters(folder), time.perf_counter(), []
    chosen = chosen_cells(surface_survey)
    for cell in chosen:
        if time.perf_counter() - start > most_s:
            break
        cells.append(shown_cell(cell, surface_survey, run, config))
    record = {"rule": RULE, "n_chosen": len(chosen), "most_s": most_s, "cells": cells}
    if not (folder / RANKING).exists() and len(run.match_scene.views) <= MAX_MATRIX_IMAGES:
        record["labels"] = tried_labels(run, config, most_s)
    write_record(path, record)


def tried_labels(run: ReportedRun, config: RunConfig, most_s: float) -> dict[str, Any]:
    """The labels of pairs for curves.json, or the error that prevents them."""
    try:
        return sampled_labels(run, config, most_s)
    except Exception as error:  # a table less, not a surface
        return {"error": said(error)}


def sampled_labels(run: ReportedRun, config: RunConfig, most_s: float) -> dict[str, Any]:
    """Labels of every pair of images at the tie points in and around a few places, each point once.

    As where images are chosen (`rank_tile`): without a choice nothing else says how well each pair of them matches. No
    place is begun after `most_s`.
    """
    match_scene, start = run.match_scene, time.perf_counter()
    is_new, parts = np.ones(len(match_scene.ties), bool), list[LabelledTies]()
    for core in sample_cores(match_scene, SAMPLE_BLOCKS * config.pyramid.block, math.ceil(config.selection.radius_px)):
        if parts and time.perf_counter() - start > most_s:
            break
        tile_labels = rank_tile(match_scene, core, config)
        if tile_labels is None:
            continue
        labels = tile_labels.pair_labels
        new = is_new[labels.tie]
        is_new[labels.tie] = False
        view_numbers = np.array(tile_labels.view_numbers, np.int64)
        parts.append(LabelledTies(match_scene.ties[labels.tie[new]], labels.labels[new], view_numbers))
    names = [view.name for view in match_scene.views]
    n_points = sum(len(part.xyz) for part in parts)
    return {"points": n_points, "pairs": counted_pairs(label_counts(parts, len(names)), names)}


def sample_cores(match_scene: MatchScene, side: int, reach: int) -> list[CellWindow]:
    """Windows of `side` cells around tie points spread over the scene; each lies far from the earlier ones.

    reach : tie points are labelled up to this many cells beyond a window. Where the windows with their reach have more
    cells than the scene, the scene is the only window.
    """
    xy = (match_scene.ties[:, :2] - match_scene.anchor) * (1.0, -1.0) / match_scene.cell_size
    first, size = (
        (match_scene.overlap_window.col, match_scene.overlap_window.row),
        (match_scene.overlap_window.cols, match_scene.overlap_window.rows),
    )
    xy = xy[((xy >= first) & (xy < np.add(first, size))).all(axis=1) & np.isfinite(match_scene.ties[:, 2])]
    if not len(xy):
        return []
    low, high = xy.min(axis=0), xy.max(axis=0)
    share = (np.arange(SAMPLE_PLACES) + 0.5) / SAMPLE_PLACES
    places = low + np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2) * (high - low)
    nearest = [int(np.hypot(*(xy - place).T).argmin()) for place in places]
    # Places are ordered so that the first few are already spread over the scene.
    order = [nearest[len(nearest) // 2]]
    while rest := [tie for tie in nearest if tie not in order]:
        order.append(max(rest, key=lambda tie: min(float(np.hypot(*(xy[tie] - xy[old]))) for old in order)))
    if len(order) * (side + 2 * reach) ** 2 >= match_scene.overlap_window.rows * match_scene.overlap_window.cols:
        return [match_scene.overlap_window]
    cells = np.floor(xy[order]).astype(int) - side // 2
    return [CellWindow(int(row), int(col), side, side).within(match_scene.overlap_window) for col, row in cells]


def shown_cell(chosen_cell: ChosenCell, surface_survey: Survey, run: ReportedRun, config: RunConfig) -> dict[str, Any]:
    """The record of a cell for curves.json, or of the first alternative cell that can be shown."""
    first = tried_cell(chosen_cell, surface_survey, run, config)
    for row, col in chosen_cell.others if "error" in first else ():
        other = tried_cell(replace(chosen_cell, row=row, col=col), surface_survey, run, config)
        if "error" not in other:
            return other
    return first


def tried_cell(chosen_cell: ChosenCell, surface_survey: Survey, run: ReportedRun, config: RunConfig) -> dict[str, Any]:
    """The record of a cell for curves.json, with an error where no curve can be made."""
    x, y = surface_survey.transform * (chosen_cell.col + 0.5, chosen_cell.row + 0.5)
    i, j = ((at - surface_survey.first) // surface_survey.stride for at in (chosen_cell.row, chosen_cell.col))
    height_m = float(surface_survey.height[i, j])
    record = {
        "kind": chosen_cell.kind, "why": chosen_cell.why, "row": chosen_cell.row, "col": chosen_cell.col,
        "x": x, "y": y,
        "height_m": height_m, "sigma_m": float(surface_survey.sigma[i, j]),
        "quality": int(surface_survey.quality[i, j]),
    }  # fmt: skip
    try:
        return record | curves_of(chosen_cell, np.array([x, y]), height_m, run, config)
    except GeometryError:
        return record | {"error": NOT_SHOWN}
    except Exception as error:  # a picture less, not a surface
        return record | {"error": said(error)}


def curves_of(
    chosen_cell: ChosenCell, xy: FloatArray, height_m: float, run: ReportedRun, config: RunConfig
) -> dict[str, Any]:
    """Record and figure of the match curves of a chosen_cell."""
    match_scene = run.match_scene
    asked = f"The cell at row {chosen_cell.row}, column {chosen_cell.col}"
    looked = curves_at(asked, None, match_scene, place_of_cell(xy, height_m, run), config, SHOWN_WITHIN_CELLS)
    undulation_m = float(run.undulation(xy[None])[0])
    report = PointReport.of(asked, looked, match_scene, run.scene.crs).above(undulation_m)
    # Where no height was found, all images are shown.
    n_images = len(report.search) if chosen_cell.kind == FAILED else report.curves.n_used
    drawing = mean_svg(report, n_images)
    record = {"point": point_record(report, config.selection), "n_shown": n_images, "svg": drawing}
    return record | {"undulation_m": round(undulation_m, 4)}


def place_of_cell(xy: FloatArray, height_m: float, run: ReportedRun) -> Place:
    """A cell with its centre (2,) m at its height in dsm.tif, or at that of the nearest tie points."""
    match_scene = run.match_scene
    if math.isfinite(height_m):
        z, source = height_m + float(run.undulation(xy[None])[0]), "that of the surface"
    elif len(run.ties):
        z, source = height_nearby(xy, run.ties), "that of the nearest tie points"
    else:
        z, source = middle_height(match_scene), "the middle of the heights searched"
    return Place(np.array([*xy, z]), source, cell_of(xy, match_scene), xy)


def middle_height(match_scene: MatchScene) -> float:
    """The middle of the height range, m."""
    return match_scene.height_origin + match_scene.n_steps * match_scene.height_step / 2


def said(error: Exception) -> str:
    """An error as a sentence."""
    words = " ".join(str(error).split())
    return words if isinstance(error, ZlocusError) else f"{type(error).__name__}: {words}".rstrip(": ") + "."


def rounded(value: float) -> float | None:
    """A rounded number for JSON; None where it is not finite."""
    return round(float(value), 4) if math.isfinite(value) else None
