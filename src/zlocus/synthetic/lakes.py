"""Lakes with exact levels and different shores, dug into a clean town. Their cells are marked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.objects import BARE, FIRST_BUILDING, FIRST_TREE, Tree, plant_tree
from zlocus.synthetic.painting import BoolArray, Painter, TruthArea, glitter, water
from zlocus.synthetic.terrain import SyntheticGround

LAKE_STREAM = 41
RADIUS_M, BULGE = 32.0, 0.15
# Width of the ground around a lake that is bare and rises from its shore; farther away it is that of the town.
SHORE_M, FREE_M = 30.0, 4.0
# Trees on a wooded shore: metres of shore for each, how far they stand from the water, and radius and height.
M_PER_TREE, TREE_DISTANCE_M, TREE_M = 4.0, (0.5, 3.0), (3.0, 9.0)


@dataclass(frozen=True)
class Shore:
    """The ground around a lake.

    slope : ratio by which it rises from the water up to `bank_m`, and gently beyond; wall_m : height of a vertical wall
    at the water; is_wooded : trees hang over the water; material : of the water; is_cut : the lake lies across the
    western border of the area with truth.
    """

    slope: float
    bank_m: float
    material: NDArray[np.void]
    wall_m: float = 0.0
    is_wooded: bool = False
    is_cut: bool = False


WAVES, CALM, GLITTER = water(0.06, 0.15), water(0.05, 0.06), glitter(0.06, 12.0)
GENTLE = 0.05
LAKES = {
    "lake-beach": Shore(0.08, 1.0, WAVES),
    "lake-bank": Shore(1.0, 2.0, WAVES),
    "lake-wooded": Shore(0.25, 1.0, CALM, is_wooded=True),
    "lake-glitter": Shore(0.12, 1.0, GLITTER),
    "lake-cut": Shore(0.08, 1.0, CALM, is_cut=True),
    "lake-quay": Shore(GENTLE, 1.0, WAVES, wall_m=1.5),
}  # fmt: skip


def with_lake(ground: SyntheticGround, name: str, truth_area: TruthArea, seed: int) -> SyntheticGround:
    """The ground with one lake of `LAKES`; `marked` are the cells of its water, also below trees.

    All ground around is higher than the lake.
    """
    shore, painter = LAKES[name], Painter.on(ground)
    rng = np.random.default_rng([seed, LAKE_STREAM])
    x, y = truth_area.middle
    middle = (truth_area.x if shore.is_cut else x, y)
    lake = _outline(painter, middle, rng)
    away_m = distance_transform_edt(~lake) * ground.step
    near = np.asarray(away_m < SHORE_M)
    painter.clear(near)
    painter.level(lake, float(painter.ground.heights[near].min()))
    _raise_shore(painter, lake, away_m, shore)
    painter.cover(lake, shore.material)
    if shore.is_wooded:
        _plant(painter, lake, away_m, rng)
    return replace(painter.painted(), marked=lake)


def _outline(painter: Painter, middle: tuple[float, float], rng: np.random.Generator) -> BoolArray:
    """Cells of a lake with three bays."""
    dx, dy = painter.x() - middle[0], painter.y() - middle[1]
    radius = RADIUS_M * (1.0 + BULGE * np.sin(3.0 * np.arctan2(dy, dx) + rng.uniform(0.0, 6.0)))
    return np.asarray(np.hypot(dx, dy) < radius)


def _raise_shore(painter: Painter, lake: BoolArray, away_m: FloatArray, shore: Shore) -> None:
    """Give the ground around a lake the shape of its shore, which becomes that of the town at `SHORE_M`."""
    heights = painter.ground.heights
    steep = np.minimum(shore.slope * away_m, shore.bank_m)
    rise = shore.wall_m + steep + GENTLE * np.maximum(away_m - shore.bank_m / shore.slope, 0.0)
    formed = float(heights[lake][0]) + rise
    part = np.clip((away_m - FREE_M) / (SHORE_M - FREE_M), 0.0, 1.0)
    part = part * part * (3.0 - 2.0 * part)
    near = ~lake & (away_m < SHORE_M)
    mixed = formed * (1.0 - part) + np.maximum(heights, formed) * part
    heights[near] = mixed[near]
    slope_row, slope_col = np.gradient(heights)
    painter.ground.slopes[near] = np.stack([slope_col, slope_row], axis=-1)[near] if not shore.wall_m else 0.0


def _plant(painter: Painter, lake: BoolArray, away_m: FloatArray, rng: np.random.Generator) -> None:
    """Plant trees along the shore, whose crowns hang over the water."""
    ground, bare_heights = painter.ground, painter.ground.heights.copy()
    rows, cols = np.nonzero((away_m > TREE_DISTANCE_M[0]) & (away_m < TREE_DISTANCE_M[1]))
    n_trees = round(2.0 * np.pi * RADIUS_M / M_PER_TREE)
    allowed = (BARE, *range(FIRST_TREE, FIRST_BUILDING), int(ground.material[lake][0]))
    for k in rng.integers(len(rows), size=n_trees) if len(rows) else ():
        x, y = (cols[k] + 0.5) * ground.step, (rows[k] + 0.5) * ground.step
        plant_tree(ground, Tree(float(x), float(y), *TREE_M), rng, bare_heights, allowed)
