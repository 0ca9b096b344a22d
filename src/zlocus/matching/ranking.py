"""The views of a tile, ranked at the tie points in and around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.cells import CellWindow
from zlocus.matching.curve import GOOD
from zlocus.matching.refine import smoothed
from zlocus.matching.selection import Ranking, rank_views
from zlocus.matching.setup import MatchScene
from zlocus.matching.views import ViewPixels, tile_views
from zlocus.options import RunConfig
from zlocus.sensors.model import FloatArray

# In place of a label that there is not; becomes NULL.
NOT_RANKED = -128


@dataclass(frozen=True)
class KnownGround:
    """A surface found at a level: (r, c) float32 height indices of that level, of the cells `window`."""

    surface: NDArray[np.float32]
    level: int
    window: CellWindow


def ranked_at_ties(
    scene: MatchScene, pixels: list[ViewPixels], core: CellWindow, ground: KnownGround | None, config: RunConfig
) -> Ranking:
    """Labels of the views at the tie points in and around a tile's core; windows follow the slope of the ground, where
    that is known."""
    around = math.ceil(config.selection.radius_px)
    window = core.at_level(0, around).within(scene.seen)
    side = config.measure.large_window
    reach = config.selection.reach_steps * scene.step_m
    z = (scene.origin_m - reach, scene.origin_m + scene.n_steps * scene.step_m + reach)
    transform, shape = scene.transform(window, 0), (window.rows, window.cols)
    xy = (scene.ties[:, :2] - scene.anchor) * (1.0, -1.0) / scene.cell_m
    index = (scene.ties[:, 2] - scene.origin_m) / scene.step_m
    lattice, needed = (scene.origin_m, scene.step_m), _heights_of_ties(scene, xy, window, reach)
    views = tile_views(pixels, 0, transform, shape, config.pyramid.block, lattice, z, side // 2, needed)
    steps_per_cell = scene.cell_m / scene.step_m
    slope = np.zeros((len(xy), 2)) if ground is None else _slopes(ground, xy, config)
    return rank_views(views, window, xy, index, slope, side, steps_per_cell, config.selection)


def _slopes(ground: KnownGround, xy: NDArray[np.float64], config: RunConfig) -> NDArray[np.float64]:
    """Steps a cell down and across (n, 2), which are the same at every level. xy : (n, 2) finest cells."""
    surface = smoothed(ground.surface, config.refine.jump_steps)
    cell = np.floor(xy[:, ::-1] / 2**ground.level).astype(np.int64)
    at = tuple(np.clip(cell - (ground.window.row, ground.window.col), 1, np.subtract(surface.shape, 2)).T)
    return np.stack(
        [(surface[at[0] + i, at[1] + j] - surface[at[0] - i, at[1] - j]) / 2 for i, j in ((1, 0), (0, 1))], axis=1
    )


def _heights_of_ties(
    scene: MatchScene, xy: NDArray[np.float64], window: CellWindow, reach: float
) -> tuple[float, float] | None:
    """Heights (m) of the ties within a window, widened by `reach`; None where there are none. xy : (n, 2) cells."""
    first, last = (window.col, window.row), (window.col + window.cols, window.row + window.rows)
    z = scene.ties[((xy >= first) & (xy < last)).all(axis=1), 2]
    z = z[np.isfinite(z)]
    return (float(z.min()) - reach, float(z.max()) + reach) if len(z) else None


@dataclass(frozen=True)
class RankedPoints:
    """Tie points of one tile with the labels of its images.

    xyz : (n, 3) m; labels : (n, k, k) int8, of search image (last axis) against reference; views : (k,) int64, which of
    the scene's images they are.
    """

    xyz: FloatArray
    labels: NDArray[np.int8]
    views: NDArray[np.int64]

    @classmethod
    def of(cls, ranking: Ranking, views: Sequence[int], ties: FloatArray, kept: CellWindow) -> RankedPoints:
        """Those in a window of finest cells, so that no point of two tiles counts twice. ties : (n, 3) m, all."""
        first, size = np.array([kept.col, kept.row]), np.array([kept.cols, kept.rows])
        inside = ((ranking.xy >= first) & (ranking.xy < first + size)).all(axis=1)
        return cls(ties[ranking.tie[inside]], ranking.labels[inside], np.array(views, np.int64))

    def rows(self, n_views: int) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int32], NDArray[np.int16]]:
        """A row per point and reference: its xyz (m, 3) m, reference (m,), how many labels are good (m,), labels
        (m, n_views), `NOT_RANKED` where the image is the reference or was not compared."""
        n, k = self.labels.shape[:2]
        labels = np.full((n, k, n_views), NOT_RANKED, np.int16)
        labels[:, :, self.views] = self._of_others()
        return *self._references(), labels.reshape(n * k, n_views)

    def texts(
        self, names: Sequence[str]
    ) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int32], NDArray[np.object_]]:
        """The same for scenes of very many images: labels as NAME=LABEL of those that were compared, with commas
        between, (m,). names : of the scene's images; a comma in one becomes a blank."""
        mine = [names[number].replace(",", " ") for number in self.views]
        rows = self._of_others().reshape(-1, len(mine)).tolist()
        texts = [
            ",".join(f"{name}={label}" for name, label in zip(mine, row, strict=True) if label != NOT_RANKED)
            for row in rows
        ]
        return *self._references(), np.array(texts, dtype=object)

    def _of_others(self) -> NDArray[np.int8]:
        """Labels (n, k, k), none of an image against itself."""
        labels, itself = self.labels.copy(), np.arange(len(self.views))
        labels[:, itself, itself] = NOT_RANKED
        return labels

    def _references(self) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int32]]:
        """Of every point and reference its xyz, the reference, and how many labels are good."""
        n, k = self.labels.shape[:2]
        n_good = (self._of_others() == GOOD).sum(axis=2).astype(np.int32)
        return np.repeat(self.xyz, k, axis=0), np.tile(self.views, n), n_good.reshape(n * k)
