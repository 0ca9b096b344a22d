"""Plan of a run before its first tile: tiles, workers, memory and time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from zlocus.core.errors import ConfigError
from zlocus.core.options import RunConfig
from zlocus.core.progress import duration
from zlocus.core.quoting import counted
from zlocus.core.requests import CloudRequest, DsmRequest
from zlocus.core.resources import DEFAULT_MEMORY_SHARE, TILE_CODE_BYTES, WORKER_BYTES, cores, free_bytes, held_bytes
from zlocus.core.scene import View
from zlocus.io.decoded_images import DECODED
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.view_pixels import PYRAMIDS
from zlocus.pipeline.execution.plan import MAX_SAMPLED_TILES, Tile, TileNeeds, kept_bytes, kept_bytes_of, tile_needs
from zlocus.pipeline.execution.rates import (
    ORIENT_PIXEL_S,
    TYPICAL,
    WRITE_CELL_S,
    WRITE_PIXEL_S,
    Rate,
    kind_of,
    rate_of,
    remember,
)

# Parts of a run whose rates are remembered.
ORIENTATION, WRITING, WRITING_MAPS = "orientation", "writing", "writing maps"
# Processes take about two seconds to start, and so are not worth it for less work than this, s.
SHORT_S = 15.0
# Memory of a cloud beside its tiles: writers of points, and the check of a tile across images. And memory of each pixel
# of an image whose gaps are filled.
POINT_CODE_BYTES, FILLED_PIXEL_BYTES = 20e6, 40
# Time to match a cell by the selection of the paper, with six images.
PAPER_CELL_S = 2e-4


@dataclass(frozen=True)
class Plan:
    """How the tiles of a run are worked on.

    slots : tiles at a time; processes : whether each runs in a process of its own; tile_bytes : memory of the largest
    tile, with its process; own_bytes : memory of the command itself; allowed_bytes : memory that all may take together;
    kept_bytes : memory of the images that a process may keep from tile to tile, a part of `tile_bytes` (of `own_bytes`
    for a cloud); seconds : estimated time of one worker for all tiles; scheduler : address of the cluster that does the
    work instead; n_images : number of reference images whose tiles they are, 0 for tiles of the ground; write_s :
    estimated time to write the results; match_rate, write_rate : of this machine, by which both estimates are
    multiplied.
    """

    n_tiles: int
    slots: int
    processes: bool
    tile_bytes: float
    own_bytes: float
    allowed_bytes: float
    kept_bytes: int
    seconds: float
    scheduler: str | None = None
    n_images: int = 0
    write_s: float = 0.0
    match_rate: Rate = TYPICAL
    write_rate: Rate = TYPICAL

    @property
    def match_s(self) -> float:
        """Estimated wall time of the matching at the typical rate."""
        return self.seconds / self.slots

    @property
    def n_bytes(self) -> float:
        """Memory of the command and all tiles that are worked on at a time."""
        return self.own_bytes + self.slots * self.tile_bytes

    @property
    def process_bytes(self) -> float:
        """Memory of the process that takes most."""
        return max(self.own_bytes, self.tile_bytes) if self.processes else self.n_bytes

    def as_dict(self) -> dict[str, float]:
        """The plan as run.json holds it, beside the stages of the run: memory in MB, times in s."""
        return {
            "tiles": self.n_tiles,
            "slots": self.slots,
            "memory_mb": round(self.n_bytes / 1e6, 1),
            "process_mb": round(self.process_bytes / 1e6, 1),
            "match_s": round(self.match_rate.factor * self.match_s, 3),
            "write_s": round(self.write_rate.factor * self.write_s, 3),
        }

    def __str__(self) -> str:
        many = counted(self.n_tiles, "tile")
        where = "in processes of their own" if self.processes else "in this process"
        if self.scheduler is not None:
            need = f"{self.tile_bytes / 1e9:.2g} GB of memory for each of its threads"
            whole = f"{duration(self.seconds)} of one of them at the typical rate"
            return f"Plan: {many} by the cluster at {self.scheduler}, about {need}, and {whole}."
        if self.n_images:
            many += f" of {counted(self.n_images, 'image')}"
        match_s, write_s = self.match_rate.factor * self.match_s, self.write_rate.factor * self.write_s
        parts = [self.match_rate.said("matching", self.match_s), self.write_rate.said("writing", self.write_s)]
        return (
            f"Plan: {many}, {self.slots} at a time {where}, about {self.n_bytes / 1e9:.2g} GB of memory (of "
            f"{self.allowed_bytes / 1e9:.2g} GB) and {duration(match_s + write_s)}: {', '.join(parts)}."
        )


def planned(match_scene: MatchScene, tiles: Sequence[Tile], config: RunConfig, request: DsmRequest) -> Plan:
    """Decide how many tiles are worked on at a time: as requested, or as many as there are cores and work for.

    Memory limits their number. In image space all tiles stay in one process, because the heights of all pixels are too
    large to be copied.

    Raises
    ------
    ConfigError
        One tile needs more memory than it may take.
    """
    needs, own, memory_gb = tile_needs(match_scene, tiles, config), held_bytes(), request.memory_gb
    allowed = own + DEFAULT_MEMORY_SHARE * free_bytes() if memory_gb is None else memory_gb * 1e9
    kept = kept_bytes(match_scene)
    if memory_gb is not None:
        # Where memory is scarce, images are decoded and reduced again instead of being kept.
        kept = min(kept, max(int(allowed - own - needs.n_bytes - WORKER_BYTES), 0))
    here = needs.n_bytes + max(kept - DECODED.held_bytes - PYRAMIDS.held_bytes, 0) + TILE_CODE_BYTES
    if memory_gb is not None and own + here > allowed:
        raise _too_little(memory_gb, here, own)
    n_worked = sum(1 for tile in tiles if tile.core_window.rows and tile.core_window.cols)
    seconds = seconds_of_paper(tiles) if request.selection == "paper" else needs.seconds
    wanted = request.workers or (cores() if seconds > SHORT_S else 1)
    there = needs.n_bytes + kept + WORKER_BYTES
    slots = max(min(wanted, int((allowed - own) / there), n_worked), 1)
    processes = slots > 1 and not request.is_in_image_space
    each = there if processes or request.scheduler else here
    if request.method == "gc3-sgm":
        # The pixels of every image are matched before.
        seconds *= len(match_scene.views)
    kind, n_cells = kind_of(match_scene.views), sum(tile.kept_window.rows * tile.kept_window.cols for tile in tiles)
    return Plan(
        len(tiles), slots, processes, each, own, allowed, kept, seconds, request.scheduler, 0, n_cells * WRITE_CELL_S,
        rate_of(matching_of(request), kind), rate_of(WRITING, kind),
    )  # fmt: skip


def seconds_of_paper(tiles: Sequence[Tile]) -> float:
    """Estimated time of one worker for the selection of the paper, which matches only the kept cells."""
    kept = [tile.kept_window.within(tile.core_window) for tile in tiles]
    return PAPER_CELL_S * sum(window.rows * window.cols for window in kept)


def matching_of(request: DsmRequest | CloudRequest) -> str:
    """Name of the matching whose rate a request follows."""
    return (
        f"matching by {request.method}, {request.selection}" if isinstance(request, DsmRequest) else "matching pixels"
    )


def said_before_orientation(views: Sequence[View], threads: int | None) -> str:
    """How long the images take to be read and their tie points to be found, as a sentence. threads : None for all."""
    rate, seconds = rate_of(ORIENTATION, kind_of(views)), orientation_s(views, threads)
    return f"{rate.said('Reading the images and finding tie points takes', seconds)}."


def orientation_s(views: Sequence[View], threads: int | None) -> float:
    """Time to read images and to find their tie points at the typical rate. threads : None for all cores."""
    n_pixels = sum(math.prod(view.image.shape) for view in views)
    return ORIENT_PIXEL_S * n_pixels / min(threads or cores(), len(views))


def remember_run(
    plan: Plan, request: DsmRequest | CloudRequest, views: Sequence[View], stages: Sequence[Mapping[str, Any]]
) -> None:
    """Remember how long the parts of a run took that made all of its tiles on this machine.

    stages : see `timed_stages`.
    """
    if plan.scheduler is not None:
        return
    took, kind = {stage["name"]: float(stage["wall_s"]) for stage in stages}, kind_of(views)
    writing = WRITING if isinstance(request, DsmRequest) else WRITING_MAPS
    threads = request.workers if isinstance(request, DsmRequest) else None
    for part, stage, typical_s in (
        (ORIENTATION, "orient", orientation_s(views, threads)),
        (matching_of(request), "match", plan.match_s),
        (writing, "write", plan.write_s),
    ):
        remember(part, kind, typical_s, took.get(stage, 0.0))


def timed_stages(stages: Sequence[Mapping[str, Any]], is_compiled: bool) -> list[Mapping[str, Any]]:
    """The stages of a run, see `Stopwatch`, whose times show a rate: not the one in which kernels were compiled.

    is_compiled : whether all kernels were there when the run began.
    """
    return [stage for stage in stages if is_compiled or stage["name"] != "orient"]


class SceneTiles(NamedTuple):
    """The tiles of a reference image, and the match scene of its pixels."""

    match_scene: MatchScene
    tiles: Sequence[Tile]


def planned_pixels(
    scene_tiles: Sequence[SceneTiles], views: Sequence[View], config: RunConfig, request: CloudRequest
) -> Plan:
    """Decide how many tiles of images are worked on at a time: as requested, or as many as memory allows.

    All of them are worked on in this process. The heights of the pixels lie on disk. views : as they were opened.

    Raises
    ------
    ConfigError
        One tile needs more memory than it may take.
    """
    needs, own, memory_gb = needs_of_scenes(scene_tiles, config), held_bytes(), request.memory_gb
    allowed = own + DEFAULT_MEMORY_SHARE * free_bytes() if memory_gb is None else memory_gb * 1e9
    held = DECODED.held_bytes + PYRAMIDS.held_bytes
    kept = max(kept_bytes_of(views, len(scene_tiles)) - held, 0)
    fixed = own + TILE_CODE_BYTES + POINT_CODE_BYTES
    if memory_gb is not None:
        kept = min(kept, max(int(allowed - fixed - needs.n_bytes), 0))
    if memory_gb is not None and fixed + needs.n_bytes > allowed:
        raise _too_little(memory_gb, fixed - own + needs.n_bytes, own)
    n_tiles = sum(len(scene.tiles) for scene in scene_tiles)
    slots = max(min(request.workers, int((allowed - fixed - kept) / needs.n_bytes), n_tiles), 1)
    filled = 0.0
    if request.fill == "interpolate":
        largest = max(math.prod(scene.match_scene.views[0].image.shape) for scene in scene_tiles)
        filled = max(largest * FILLED_PIXEL_BYTES - slots * needs.n_bytes, 0.0)
    n_pixels, kind = sum(math.prod(each.match_scene.views[0].image.shape) for each in scene_tiles), kind_of(views)
    return Plan(
        n_tiles, slots, False, needs.n_bytes, fixed + kept + filled, allowed, held + kept, needs.seconds, None,
        len(scene_tiles), n_pixels * WRITE_PIXEL_S, rate_of(matching_of(request), kind), rate_of(WRITING_MAPS, kind),
    )  # fmt: skip


def needs_of_scenes(scene_tiles: Sequence[SceneTiles], config: RunConfig) -> TileNeeds:
    """Estimate what the tiles of several reference images need, from a sample spread over all of them."""
    n_tiles = sum(len(scene.tiles) for scene in scene_tiles)
    every, most, seconds, first, n_looked = -(-n_tiles // MAX_SAMPLED_TILES) or 1, 0, 0.0, 0, 0
    for scene in scene_tiles:
        looked = scene.tiles[-first % every :: every]
        first, n_looked = first + len(scene.tiles), n_looked + len(looked)
        if looked:
            needs = tile_needs(scene.match_scene, looked, config)
            most, seconds = max(most, needs.n_bytes), seconds + needs.seconds
    return TileNeeds(most, seconds * n_tiles / max(n_looked, 1))


def _too_little(memory_gb: float, tile_bytes: float, own_bytes: float) -> ConfigError:
    """The error of a limit of memory that one tile does not fit into."""
    return ConfigError(
        f"--memory {memory_gb:g} GB is too little for one tile, which needs about {tile_bytes / 1e9:.2g} GB beside the "
        f"{own_bytes / 1e9:.2g} GB of the command itself. Allow more, or set a smaller pyramid.tile in --config."
    )
