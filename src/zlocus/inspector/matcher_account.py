"""What the matcher weighed at a cell: the coarser level, the evidence of each pair of images, and the neighbours.

The part of the run's tile around the cell is matched again, because a run keeps no costs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.grid import CellWindow
from zlocus.core.sensor_model import FloatArray
from zlocus.inspector.folder import SurfaceFolder
from zlocus.inspector.restored_run import Restored
from zlocus.matching.cell_costs import (
    CellCosts,
    MatchedCosts,
    PairEvidence,
    cell_costs,
    match_with_costs,
    tile_around,
)
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.point_match import cell_of
from zlocus.matching.prior_costs import COST_OF_CANDIDATES
from zlocus.matching.tile import tile_inputs
from zlocus.pipeline.execution.plan import core_size

# Side of the part that is matched again, cells: enough of them to learn the evidence from.
SIDE_CELLS = 288
# A pair says nothing where its evidence is smaller, natural units: such windows are at most a quarter more frequent.
SILENT = 0.22
# A difference of two heights is told from so many steps on.
TOLD_STEPS = 0.05
NOT_REPEATED = {
    "gc3-sgm": "This run matched the pixels of its images (gc3-sgm). Its costs belong to pixels, and not to cells, so "
    "that they are not shown here.",
    "paper": "This run matched each cell by itself (--selection paper). Its match curves are all that it weighed.",
}  # fmt: skip


@dataclass(frozen=True)
class MatchedPart:
    """A part of the run's tile that was matched again. core_window : its finest cells; is_whole : whether it is all of
    the tile's core, so that its heights are those of the run."""

    core_window: CellWindow
    is_whole: bool
    matched_costs: MatchedCosts | None


def part_of(restored: Restored, xy: FloatArray) -> tuple[CellWindow, bool]:
    """The part of the run's tile to match again for a cell, and whether it is the whole core. xy : (2,) m."""
    match_scene, options = restored.run.match_scene, restored.config.pyramid
    row, col = cell_of(xy, match_scene)
    overlap = match_scene.overlap_window
    height, width = core_size(overlap, options)
    tile = CellWindow(
        row - (row - overlap.row) % height, col - (col - overlap.col) % width, height, width
    ).within(overlap)  # fmt: skip
    part = tile_around(tile, row, col, SIDE_CELLS)
    return part, part == tile


def matched_part(folder: SurfaceFolder, restored: Restored, xy: FloatArray) -> MatchedPart:
    """Match the part around a cell again, with the options of the run. xy : (2,) m.

    Raises
    ------
    ConfigError
        The run weighed no costs of cells.
    """
    request = folder.run["config"]["request"]
    for key in (request["method"], request.get("selection", "default")):
        if key in NOT_REPEATED:
            raise ConfigError(NOT_REPEATED[key])
    core_window, is_whole = part_of(restored, xy)
    if not (core_window.rows and core_window.cols):
        return MatchedPart(core_window, is_whole, None)
    is_guided, preselect = request.get("selection") == "guided", request["views"] == "auto"
    tile = tile_inputs(
        restored.run.match_scene, core_window, restored.config, request["method"], is_guided, preselect
    )  # fmt: skip
    return MatchedPart(core_window, is_whole, match_with_costs(tile))


@dataclass(frozen=True)
class WeighedCell:
    """A cell with its costs. part : that was matched again; undulation_m : of the vertical datum there; surface_m :
    height in dsm.tif, NaN without one; method : of the run; min_uniqueness : see `checks.min_uniqueness`."""

    costs: CellCosts
    part: MatchedPart
    match_scene: MatchScene
    undulation_m: float
    surface_m: float
    method: str
    min_uniqueness: float

    def metres(self, height_m: float) -> str:
        """An ellipsoidal height in the vertical datum of the surface, with its unit."""
        digits = max(2, math.ceil(1 - math.log10(self.match_scene.height_step) - 1e-9))
        return f"{height_m - self.undulation_m:.{digits}f} m"

    def names(self, pair_evidence: PairEvidence) -> str:
        """The names of the images of a pair."""
        return " and ".join(self.match_scene.views[number].name for number in pair_evidence.views)

    @property
    def chosen_m(self) -> float:
        """The height that the semi-global constraint chose, ellipsoidal."""
        return float(self.costs.heights_m[self.costs.chosen])


def matcher_record(restored: Restored, part: MatchedPart, folder: SurfaceFolder, xy: FloatArray) -> dict[str, Any]:
    """What the matcher weighed at a cell, for the page. xy : (2,) m, the centre of the cell.

    Raises
    ------
    GeometryError
        No two images see the cell.
    """
    match_scene, row_col = restored.run.match_scene, folder.cell_of(float(xy[0]), float(xy[1]))
    costs = None if part.matched_costs is None else cell_costs(part.matched_costs, *cell_of(xy, match_scene))
    if costs is None or row_col is None:
        raise GeometryError("No two images see this cell, so nothing was weighed.")
    undulation_m = float(restored.run.undulation(xy[None])[0])
    method = folder.run["config"]["request"]["method"]
    surface_m, least = folder.cell(*row_col)["dsm"], restored.config.checks.min_uniqueness
    cell = WeighedCell(costs, part, match_scene, undulation_m, surface_m, method, least)
    says = [repeated(cell), *coarser_level(cell), evidence(cell), *constraint(cell)]
    takes_part = [number for number, sees in zip(costs.view_numbers, costs.sees, strict=True) if sees]
    return {
        "says": says, "pairs": pair_records(cell), "heights_m": (costs.heights_m - undulation_m).round(4).tolist(),
        "cost": costs.cost.tolist(), "known_cost": costs.known_cost.tolist(), "chosen": costs.chosen,
        "takes_part": [match_scene.views[number].name for number in takes_part],
    }  # fmt: skip


def repeated(cell: WeighedCell) -> str:
    """What was matched again, and whether it gives the height of the surface."""
    window, part = cell.part.core_window, cell.part
    what = "The tile of the run" if part.is_whole else "A part of the run's tile"
    text = f"{what}, {window.rows} × {window.cols} cells, was matched again for this page."
    again_m, surface_m = cell.costs.height_m - cell.undulation_m, cell.surface_m
    if math.isnan(again_m) or math.isnan(surface_m):
        both = math.isnan(again_m) and math.isnan(surface_m)
        return text if not both else f"{text} The cell gets no height again."
    away = abs(again_m - surface_m)
    if away < TOLD_STEPS * cell.match_scene.height_step:
        return f"{text} The cell gets the height of the surface again."
    why = "" if part.is_whole else " Evidence is learned from other cells there."
    return f"{text} The cell gets a height {away:.2f} m from that of the surface.{why}"


def coarser_level(cell: WeighedCell) -> list[str]:
    """What the coarser level knew of the cell, and what its prior costs."""
    costs = cell.costs
    best, *others = costs.coarser_m
    more = [cell.metres(other) for other in dict.fromkeys(others) if other != best]
    found = f"The coarser level, with cells of {costs.coarser_cell_m:g} m, found {cell.metres(best)} here."
    if more:
        found += f" It also considered {' and '.join(more)}."
    low, high = cell.metres(costs.heights_m[0]), cell.metres(costs.heights_m[-1])
    searched = f"So {len(costs.heights_m)} heights, from {low} to {high}, were searched in this cell."
    if not costs.known_cost.any():
        return [f"{found} {searched}"]
    prior, most = int(costs.known_cost[costs.chosen]), int(COST_OF_CANDIDATES.max_cost)
    if prior == 0:
        fits = "The chosen height fits what the coarser level found around the cell, so this prior adds no cost to it."
    else:
        fits = (
            "The chosen height is far from what the coarser level found around the cell, so this prior adds a cost of "
            f"{prior} to it, of {most} at most."
        )
    return [f"{found} {searched}", fits]


def evidence(cell: WeighedCell) -> str:
    """How many pairs of images speak for and against the chosen height."""
    costs = cell.costs
    if not costs.pair_evidence:
        return (
            "The costs are those of correlation. Evidence is learned with mvll-sgm, in tiles of 80 000 cells or more, "
            "where enough cells have heights to learn from."
        )
    seen = [pair for pair in costs.pair_evidence if math.isfinite(pair.log_ratio[costs.chosen])]
    if not seen:
        return "No pair of images sees the cell at the chosen height, so there is no evidence for it."
    ratio = np.array([pair.log_ratio[costs.chosen] for pair in seen])
    n_for, n_against = int((ratio > SILENT).sum()), int((ratio < -SILENT).sum())
    n_counting = sum(bool(pair.counts[costs.chosen]) for pair in seen)
    strongest = seen[int(np.abs(ratio).argmax())]
    of_all = f"Of {len(costs.pair_evidence)} pairs of images {len(seen)} see the cell at the chosen height."
    n_silent = len(seen) - n_for - n_against
    votes = f"{n_for or 'None'} {_verb(n_for)} for this height and {n_against or 'none'} against it."
    votes += f" {n_silent} {'says' if n_silent == 1 else 'say'} nothing." if n_silent else ""
    which = f"The evidence of the {n_counting} that speak most for it counts."
    most = f"That of {cell.names(strongest)} is the strongest: {_odds(strongest.log_ratio[costs.chosen])}."
    return f"{of_all} {votes} {which} {most}"


def _verb(n: int) -> str:
    return "speaks" if n <= 1 else "speak"


def _odds(log_ratio: float) -> str:
    """Evidence as odds."""
    times = math.exp(abs(log_ratio))
    number = f"{times:.0f}" if times >= 10 else f"{times:.1f}"
    return f"windows so alike are {number} times more frequent at {'right' if log_ratio >= 0 else 'wrong'} heights"


def constraint(cell: WeighedCell) -> list[str]:
    """How the cost at the chosen height compares with the least cost of the cell, and what decided."""
    costs = cell.costs
    chosen, least = int(costs.cost[costs.chosen]), int(costs.cost.min())
    where = int(costs.cost.argmin())
    if chosen == least:
        text = f"The cost of the cell itself is least at the chosen height of {cell.metres(cell.chosen_m)}: {chosen}."
        parts = [text]
    else:
        text = (
            f"The cost of the cell itself is least at {cell.metres(costs.heights_m[where])}: {least}. At the chosen "
            f"height of {cell.metres(cell.chosen_m)} it is {chosen}."
        )
        why = (
            "The semi-global constraint chose this height all the same. It saves larger costs of jumps to the "
            "neighbouring cells."
        )
        parts = [f"{text} {why}" if cell.method != "mvll" else text]
    if cell.method != "mvll" and math.isfinite(costs.second_m):
        parts.append(
            f"With the neighbours, the next best height is {cell.metres(costs.second_m)}. Its sum of path costs is "
            f"larger by {costs.uniqueness}. Below {cell.min_uniqueness:g} the cell is flagged AMBIGUOUS."
        )
    return parts


def pair_records(cell: WeighedCell) -> list[dict[str, Any]]:
    """Evidence of each pair of images at the chosen height, and where it is largest; the strongest first."""
    costs, records = cell.costs, []
    for pair in costs.pair_evidence:
        here = float(pair.log_ratio[costs.chosen])
        record: dict[str, Any] = {
            "images": [cell.match_scene.views[number].name for number in pair.views], "evidence": here,
            "counts": bool(pair.counts[costs.chosen]), "weight": pair.weight, "best": None, "best_m": None,
        }  # fmt: skip
        if np.isfinite(pair.log_ratio).any():
            k = int(np.nanargmax(pair.log_ratio))
            record |= {"best": float(pair.log_ratio[k]), "best_m": float(costs.heights_m[k]) - cell.undulation_m}
        record["says"] = _pair_says(cell, pair, here)
        records.append(record)
    return sorted(records, key=lambda each: -abs(each["evidence"]) if math.isfinite(each["evidence"]) else 1.0)


def _pair_says(cell: WeighedCell, pair_evidence: PairEvidence, here: float) -> str:
    """The evidence of a pair in a sentence."""
    if not math.isfinite(here):
        return "does not see the cell at this height"
    if abs(here) <= SILENT:
        return "says nothing"
    text = _odds(here)
    return text if pair_evidence.counts[cell.costs.chosen] else f"{text}, but the pair is not among those that count"
