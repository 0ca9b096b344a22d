"""The tiles of a run: matched by workers, kept on disk as checkpoints, and assembled into rasters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.core.errors import StoppedError
from zlocus.core.grid import CellWindow, Grid
from zlocus.core.options import RunConfig, large_window_side
from zlocus.core.progress import Progress, Stage
from zlocus.core.quoting import counted
from zlocus.core.requests import DsmRequest
from zlocus.io.grid_inputs import cells_inside, dem_datum, read_dem
from zlocus.io.run_record import WorkerUsage
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.fill import filled, filled_from
from zlocus.matching.masked_cells import with_masked_cells
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.pair_labels import LabelledTies
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.matching.tile import TileResult, match_tile
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.execution.event_log import EventLog
from zlocus.pipeline.execution.plan import Tile, keep_at_most
from zlocus.pipeline.execution.tasks import Failure, Here, Outcome, Workers, run_tasks
from zlocus.pipeline.run_plan import Plan
from zlocus.pipeline.setup import RunSetup, reference_features
from zlocus.products.rasters import SurfaceRasters
from zlocus.products.water import WaterFound

# A message names at most this many failed tiles.
MAX_NAMED_TILES = 3


@dataclass
class Tally:
    """Counts over the requested cells of all tiles.

    n_left_out : cells that an image sees too obliquely; n_masked : cells of which masks left fewer than two images;
    labelled_ties : labels of tie points, tile by tile; water_found : water surfaces, once all tiles are written.
    """

    n_asked: int = 0
    n_seen: int = 0
    n_matched: int = 0
    n_left_out: int = 0
    n_masked: int = 0
    evaluations: int = 0
    all_images: int = 0
    labelled_ties: list[LabelledTies] = field(default_factory=list)
    water_found: WaterFound = field(default_factory=WaterFound)

    def add(self, tile_product: TileProduct) -> None:
        """Add the counts of a tile."""
        quality = tile_product.surface.quality
        asked = (quality & np.uint16(Quality.OUTSIDE)) == 0
        self.n_asked += int(asked.sum())
        self.n_seen += int((asked & ((quality & np.uint16(Quality.UNSEEN)) == 0)).sum())
        is_matched = np.isfinite(tile_product.surface.height) & ((quality & np.uint16(Quality.FILLED)) == 0)
        self.n_matched += int(is_matched.sum())
        self.n_left_out += tile_product.n_left_out
        masked = np.uint16(Quality.MASKED)
        self.n_masked += int((asked & ((quality & masked) == masked)).sum())
        self.evaluations += tile_product.evaluations
        self.all_images += tile_product.all_images
        if tile_product.labelled_ties is not None:
            self.labelled_ties.append(tile_product.labelled_ties)

    def add_water(self, water_found: WaterFound) -> None:
        """Take levelled cells out of the counts: the images need not tell their height. Called after the last tile."""
        self.n_seen -= water_found.n_seen
        self.n_matched -= water_found.n_matched
        self.water_found = water_found

    @property
    def coverage(self) -> float:
        """Share of the cells seen by two images or more, without levelled water, whose height was matched."""
        return self.n_matched / self.n_seen if self.n_seen else 0.0

    @property
    def seen_share(self) -> float:
        """Share of the requested cells that two images or more see."""
        return round(self.n_seen / self.n_asked, 6) if self.n_asked else 1.0

    def as_dict(self) -> dict[str, Any]:
        """The counts as run.json holds them."""
        return {
            "evaluations": {"done": self.evaluations, "all_images": self.all_images},
            "coverage": round(self.coverage, 6),
            "left_out_cells": self.n_left_out,
            "water": self.water_found.as_dict(),
            "masked_cells": self.n_masked,
        }


@dataclass(frozen=True)
class TileRun:
    """The tiles of a run: what makes them, and where they are kept."""

    tile_job: TileJob
    tiles: Sequence[Tile]
    checkpoint: TileCheckpoint
    log: EventLog

    @property
    def n_there(self) -> int:
        """Number of finished tiles of the surface; the checkpoint may also hold tiles of images."""
        return sum(name_of(tile) in self.checkpoint.finished for tile in self.tiles)

    def check(self, failed_outcomes: Sequence[Outcome], partial: bool) -> None:
        """Stop the run where tiles failed, unless an incomplete surface is accepted and there is at least one tile.

        Raises
        ------
        StoppedError
            Tiles failed; or all of them, for no reason that the input explains.
        ZlocusError
            All of them failed, for this reason.
        """
        if not failed_outcomes:
            return
        self.log.add("stopped", failed=len(failed_outcomes))
        if not self.n_there:
            first = failed_outcomes[0].failure
            if first is not None and first.error is not None:
                self.log.remove()
                raise first.error
            raise StoppedError(f"{self.what_failed(failed_outcomes)} Nothing was made.")
        if not partial:
            raise StoppedError(
                f"{self.what_failed(failed_outcomes)} The others are kept in {self.checkpoint.folder}: give the same "
                "command again to try those once more, or add --partial for a surface without them."
            )

    def end(self, failed_outcomes: Sequence[Outcome], tally: Tally) -> None:
        """Write the end of the run to its log.

        Raises
        ------
        StoppedError
            Tiles failed; they are empty in the surface.
        """
        self.log.add("ended", coverage=round(tally.coverage, 6), failed=len(failed_outcomes))
        if failed_outcomes:
            raise StoppedError(
                f"{self.what_failed(failed_outcomes)} They are empty in the surface (FAILED in quality.tif): give the "
                "same command again to try them once more."
            )

    def what_failed(self, failed_outcomes: Sequence[Outcome]) -> str:
        """Which tiles failed, and why, as a sentence."""
        said = [
            f"{place_of(self.tile_job.match_scene, outcome.task.core_window)}: {_reason(outcome.failure, self.log)}"
            for outcome in failed_outcomes[:MAX_NAMED_TILES]
        ]
        more = f"; and {len(failed_outcomes) - MAX_NAMED_TILES} more" if len(failed_outcomes) > MAX_NAMED_TILES else ""
        return f"{len(failed_outcomes)} of {counted(len(self.tiles), 'tile')} failed: {'; '.join(said)}{more}."

    def run(
        self, plan: Plan, workers: AbstractContextManager[Workers], progress: Progress, worker_usage: WorkerUsage
    ) -> list[Outcome]:
        """Make every tile that is not finished yet, and return the outcomes of those that failed.

        A run that resumes none begins a new log.

        Raises
        ------
        StoppedError
            Tiles cannot be written.
        """
        worked = [tile for tile in self.tiles if tile.core_window.rows and tile.core_window.cols]
        todo = [tile for tile in worked if not self.checkpoint.holds(name_of(tile))]
        failed_outcomes: list[Outcome] = []
        with progress.stage("Matching", len(worked)) as stage, workers if todo else nullcontext() as ready:
            if not self.n_there:
                self.log.remove()
            self.log.add("began", **asdict(plan), tiles_there=self.n_there)
            if len(todo) < len(worked):
                n_there = len(worked) - len(todo)
                are = "is" if n_there == 1 else "are"
                progress.note(f"{n_there} of {counted(len(worked), 'tile')} {are} there already.")
                self.log.add("resumed", tiles_there=len(worked) - len(todo))
                stage.advance(len(worked) - len(todo))
            if ready is not None:
                for outcome in run_tasks(ready, todo):
                    self._took(outcome, stage, worker_usage, is_elsewhere=not isinstance(ready, Here))
                    if outcome.failure is not None and outcome.is_final:
                        failed_outcomes.append(outcome)
        return failed_outcomes

    def _took(self, outcome: Outcome, stage: Stage, worker_usage: WorkerUsage, is_elsewhere: bool) -> None:
        tile: Tile = outcome.task
        record = {
            "tile": name_of(tile), "worker": outcome.worker, "attempt": outcome.attempt,
            "wall_s": round(outcome.wall_s, 3), "cpu_s": round(outcome.cpu_s, 3), "peak_mb": round(outcome.peak_mb, 1),
        }  # fmt: skip
        if is_elsewhere:
            worker_usage.cpu_s += outcome.cpu_s
            worker_usage.peak_mb = max(worker_usage.peak_mb, outcome.peak_mb)
        if outcome.failure is None:
            self.checkpoint.keep(name_of(tile), outcome.result.arrays())
            self.log.add("tile", **record)
        else:
            again = {} if outcome.is_final else {"again": True}
            trace = {"trace": outcome.failure.trace} if outcome.failure.trace else {}
            failure = {"cause": str(outcome.failure.cause), "reason": outcome.failure.reason}
            self.log.add("tile failed", **record, **failure, **again, **trace)
        if outcome.is_final:
            stage.advance()
        if outcome.peak_mb:
            stage.tell(f"{outcome.peak_mb / 1e3:.1f} GB")

    def tell_interrupted(self, progress: Progress) -> None:
        """Say, after an interrupt, which tiles are kept."""
        self.log.add("interrupted", tiles_done=self.n_there)
        if self.n_there and self.checkpoint.is_there:
            done = f"{self.n_there} of {counted(len(self.tiles), 'tile')} {'is' if self.n_there == 1 else 'are'}"
            progress.note(f"{done} finished and kept: {self.checkpoint.how_to_resume}.")

    def assemble(
        self, failed_outcomes: Sequence[Outcome], rasters: SurfaceRasters, tally: Tally, progress: Progress
    ) -> None:
        """Write all tiles in a fixed order, whatever the order in which they were made; failed tiles are empty.

        Raises
        ------
        StoppedError
            A tile that was finished is damaged.
        """
        lost = {outcome.task for outcome in failed_outcomes}
        with progress.stage("Writing", len(self.tiles)) as stage:
            for tile in self.tiles:
                product = self._failed(tile) if tile in lost else self._finished(tile)
                tally.add(product)
                window = self.tile_job.grid.window
                rasters.write(tile.kept_window.row - window.row, tile.kept_window.col - window.col, product.surface)
                stage.advance()

    def _finished(self, tile: Tile) -> TileProduct:
        if not (tile.core_window.rows and tile.core_window.cols):
            return self.tile_job.product(tile, TileResult(Surface.nothing(tile.core_window)))
        arrays = self.checkpoint.load(name_of(tile))
        if arrays is None:
            raise StoppedError(
                f"{self.checkpoint.folder / name_of(tile)}.npz was damaged since it was written. Give the same command "
                "again: that tile is made anew."
            )
        return TileProduct.of(arrays)

    def _failed(self, tile: Tile) -> TileProduct:
        nothing = Surface.nothing(tile.kept_window)
        empty = replace(nothing, quality=np.full_like(nothing.quality, Quality.FAILED))
        return self.tile_job.product(tile, TileResult(empty.part(tile.core_window, tile.kept_window)))


def tile_job(request: DsmRequest, setup: RunSetup, config: RunConfig, polygons: Polygons, plan: Plan) -> TileJob:
    """What makes the tiles of a request."""
    terrain = None
    if request.fill == "dem":
        assert request.dem is not None, "a request that fills from a terrain model names it"
        terrain = Terrain(request.dem, dem_datum(request.dem, request.dem_vertical))
    fill = "none" if request.fill == "dem" else request.fill
    match_scene = setup.match_scene
    if request.selection == "paper":
        match_scene = replace(match_scene, ties=reference_features(setup))
    method = MatchMethod(request.method, request.selection, request.views == "auto")
    return TileJob(match_scene, setup.grid, config, method, fill, plan.kept_bytes, polygons, terrain)


def workers_for(plan: Plan, make: Callable[[Tile], TileProduct], progress: Progress) -> AbstractContextManager[Workers]:
    """The workers that make the tiles of a plan: a cluster, processes, or this process.

    Raises
    ------
    ConfigError
        See `Cluster`.
    """
    if plan.scheduler is not None:
        from zlocus.pipeline.execution.cluster import Cluster

        cluster = Cluster(make, plan.scheduler)
        progress.note(f"Dask cluster at {plan.scheduler}; what it does is shown at {cluster.dashboard}")
        return cluster
    if plan.processes:
        from zlocus.pipeline.execution.processes import Processes

        keep_at_most(0)  # the workers read the images from here on
        return Processes(make, plan.slots)
    return nullcontext(Here(make))


def name_of(tile: Tile) -> str:
    """Name of a tile: row and column of its first kept cell on the lattice of cells."""
    return f"{tile.kept_window.row}_{tile.kept_window.col}"


def place_of(match_scene: MatchScene, core_window: CellWindow) -> str:
    """Bounds of a tile on the ground, as text."""
    transform = match_scene.transform(core_window, 0)
    (west, north), (east, south) = transform * (0, 0), transform * (core_window.cols, core_window.rows)
    return f"E {west:.0f} to {east:.0f} m, N {south:.0f} to {north:.0f} m"


def _reason(failure: Failure | None, log: EventLog) -> str:
    assert failure is not None, "callers pass failed outcomes only"
    if failure.trace:
        return f"{failure.reason} (a fault of zlocus, not of the input: report it with what {log.path.name} says of it)"
    return failure.reason


Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Polygons:
    """Polygons of the requested area, (n,) shapely geometries in the grid's CRS.

    Cells outside `inside`, or inside `outside`, are not requested.
    """

    inside: NDArray[Any] | None = None
    outside: NDArray[Any] | None = None

    def cut(self, surface: Surface, geobox: GeoBox) -> Surface:
        """The surface on a grid, with the cells that are not requested emptied."""
        beyond = np.zeros(surface.height.shape, bool)
        if self.inside is not None:
            beyond |= ~cells_inside(self.inside, geobox)
        if self.outside is not None:
            beyond |= cells_inside(self.outside, geobox)
        return surface.without(beyond) if beyond.any() else surface


@dataclass(frozen=True)
class Terrain:
    """A terrain model whose heights fill empty cells. vertical_datum : of its heights."""

    path: Path
    vertical_datum: VerticalDatum


@dataclass(frozen=True)
class TileProduct:
    """What a run keeps of a tile.

    surface : of its kept cells; evaluations, all_images : see `TileResult`; labelled_ties : tie points with their
    labels, None where images were not chosen; n_left_out : cells that an image sees too obliquely.
    """

    surface: Surface
    evaluations: int = 0
    all_images: int = 0
    labelled_ties: LabelledTies | None = None
    n_left_out: int = 0

    def arrays(self) -> Arrays:
        """The product as named arrays, for the checkpoint."""
        surface = self.surface
        found: Arrays = {
            "height": surface.height, "sigma": surface.sigma, "quality": surface.quality, "views": surface.views,
            "ortho": surface.ortho, "evaluations": np.array([self.evaluations, self.all_images], np.int64),
            "left_out": np.array(self.n_left_out, np.int64),
        }  # fmt: skip
        if self.labelled_ties is not None:
            found |= {
                "xyz": self.labelled_ties.xyz,
                "labels": self.labelled_ties.labels,
                "which": self.labelled_ties.views,
            }
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> TileProduct:
        """The product from its named arrays."""
        surface = Surface(*(arrays[name] for name in ("height", "sigma", "quality", "views", "ortho")))
        done, every = (int(n) for n in arrays["evaluations"])
        labelled_ties = (
            LabelledTies(*(arrays[name] for name in ("xyz", "labels", "which"))) if "xyz" in arrays else None
        )
        return cls(surface, done, every, labelled_ties, int(arrays["left_out"]))


@dataclass(frozen=True)
class MatchMethod:
    """How tiles are matched. name : see `match_tile`; selection : see `DsmRequest`; preselect : see `match_tile`."""

    name: str
    selection: str = "default"
    preselect: bool = True

    def match(self, match_scene: MatchScene, tile: Tile, config: RunConfig, fill: str = "none") -> TileResult:
        """The result of a tile."""
        if self.selection != "paper":
            is_guided = self.selection == "guided"
            return match_tile(match_scene, tile.core_window, config, self.name, is_guided, fill, self.preselect)
        from zlocus.matching.selected_surface import match_tile_of_paper

        if fill == "none":
            return match_tile_of_paper(match_scene, tile.core_window, tile.kept_window, config)
        # The cells around those that are kept fill gaps at their border.
        result = match_tile_of_paper(match_scene, tile.core_window, tile.core_window, config)
        return replace(result, surface=filled(result.surface, config.pyramid.halo // 2))


@dataclass(frozen=True)
class TileJob:
    """Makes the tiles of a match scene; it is sent to each worker once.

    fill : see `match_tile`; kept_bytes : see `Plan`; terrain : fills cells that are still empty, None fills none.
    """

    match_scene: MatchScene
    grid: Grid
    config: RunConfig
    method: MatchMethod
    fill: str
    kept_bytes: int
    area: Polygons = Polygons()
    terrain: Terrain | None = None

    def __call__(self, tile: Tile) -> TileProduct:
        """The product of a tile."""
        keep_at_most(self.kept_bytes, self.match_scene.views)
        return self.product(tile, self.method.match(self.match_scene, tile, self.config, self.fill))

    def product(self, tile: Tile, result: TileResult) -> TileProduct:
        """The product of a matched tile: cut to the requested cells, with gaps filled from the terrain model."""
        row, col = tile.kept_window.row - self.grid.window.row, tile.kept_window.col - self.grid.window.col
        geobox = self.grid.geobox[row : row + tile.kept_window.rows, col : col + tile.kept_window.cols]
        surface = self.area.cut(result.surface.part(tile.kept_window, tile.core_window), geobox)
        if self.terrain is not None:
            surface = filled_from(
                surface, read_dem(self.terrain.path, geobox, self.terrain.vertical_datum, may_miss=True)
            )
        # Until here the flag says that an image sees a cell too obliquely.
        n_left_out = int(((surface.quality & np.uint16(Quality.IMAGE_EXCLUDED)) != 0).sum())
        half = large_window_side(self.config.cost) // 2
        surface = with_masked_cells(surface, tile.kept_window, self.match_scene, half)
        labelled_ties = None
        if result.tile_labels is not None:
            labelled_ties = LabelledTies.of(result.tile_labels, self.match_scene.ties, tile.core_window)
        return TileProduct(surface, result.evaluations, result.all_images, labelled_ties, n_left_out)
