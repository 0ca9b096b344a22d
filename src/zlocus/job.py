"""One tile as any worker makes it: matched, cut to what was asked for, gaps filled from a terrain model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.execution.plan import Tile
from zlocus.grid import Grid
from zlocus.io.reference import cells_inside, read_dem
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.ranking import RankedPoints
from zlocus.matching.setup import MatchScene
from zlocus.options import RunConfig
from zlocus.surface.fill import filled_from
from zlocus.surface.surface import Surface
from zlocus.tile import TileResult, match_tile

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Polygons:
    """Of the area asked for, (n,) of shapely's in the grid's CRS: cells outside `inside`, or inside `outside`, are not
    asked for."""

    inside: NDArray[Any] | None = None
    outside: NDArray[Any] | None = None

    def cut(self, surface: Surface, geobox: GeoBox) -> Surface:
        """A surface on a grid with cells that are not asked for emptied."""
        beyond = np.zeros(surface.height.shape, bool)
        if self.inside is not None:
            beyond |= ~cells_inside(self.inside, geobox)
        if self.outside is not None:
            beyond |= cells_inside(self.outside, geobox)
        return surface.without(beyond) if beyond.any() else surface


@dataclass(frozen=True)
class Terrain:
    """A terrain model whose heights fill what is empty. datum : what they are above."""

    path: Path
    datum: VerticalDatum


@dataclass(frozen=True)
class TileProduct:
    """What a run keeps of a tile. surface : of its kept cells; evaluations, all_images : see `TileResult`; ranked : tie
    points with their labels, None where there was nothing to choose."""

    surface: Surface
    evaluations: int = 0
    all_images: int = 0
    ranked: RankedPoints | None = None

    def arrays(self) -> Arrays:
        """All of it as arrays."""
        surface = self.surface
        found: Arrays = {
            "height": surface.height, "sigma": surface.sigma, "quality": surface.quality, "views": surface.views,
            "ortho": surface.ortho, "evaluations": np.array([self.evaluations, self.all_images], np.int64),
        }  # fmt: skip
        if self.ranked is not None:
            found |= {"xyz": self.ranked.xyz, "labels": self.ranked.labels, "which": self.ranked.views}
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> TileProduct:
        """From what `arrays` gave."""
        surface = Surface(*(arrays[name] for name in ("height", "sigma", "quality", "views", "ortho")))
        done, every = (int(n) for n in arrays["evaluations"])
        ranked = RankedPoints(*(arrays[name] for name in ("xyz", "labels", "which"))) if "xyz" in arrays else None
        return cls(surface, done, every, ranked)


@dataclass(frozen=True)
class TileJob:
    """Makes tiles of a settled scene; what it holds reaches each worker once.

    method, use_visibility, fill : see `match_tile`; terrain : fills what is still empty, None does not.
    """

    settled: MatchScene
    grid: Grid
    config: RunConfig
    method: str
    use_visibility: bool
    fill: str
    area: Polygons = Polygons()
    terrain: Terrain | None = None

    def __call__(self, tile: Tile) -> TileProduct:
        """The product of a tile."""
        result = match_tile(self.settled, tile.core, self.config, self.method, self.use_visibility, self.fill)
        return self.product(tile, result)

    def product(self, tile: Tile, result: TileResult) -> TileProduct:
        """What is kept of a tile that was matched."""
        row, col = tile.kept.row - self.grid.window.row, tile.kept.col - self.grid.window.col
        geobox = self.grid.geobox[row : row + tile.kept.rows, col : col + tile.kept.cols]
        surface = self.area.cut(result.surface.part(tile.kept, tile.core), geobox)
        if self.terrain is not None:
            surface = filled_from(surface, read_dem(self.terrain.path, geobox, self.terrain.datum, may_miss=True))
        ranked = None
        if result.ranking is not None:
            ranked = RankedPoints.of(*result.ranking, self.settled.ties, tile.core)
        return TileProduct(surface, result.evaluations, result.all_images, ranked)
