"""The views of a tile, ranked at the tie points in and around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.cells import CellWindow
from zlocus.matching.refine import smoothed
from zlocus.matching.selection import Ranking, rank_views
from zlocus.matching.setup import MatchScene
from zlocus.matching.views import ViewPixels, tile_views
from zlocus.options import RunConfig


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
