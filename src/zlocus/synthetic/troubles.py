"""Painted troubles: one thing that misleads matching, painted into a clean town whose truth stays exact.

Each trouble marks its cells, so that a surface can be judged there alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation

from zlocus.synthetic.objects import Footprint
from zlocus.synthetic.painting import (
    BoolArray,
    Painter,
    TruthArea,
    crops,
    glitter,
    plain_ground,
    plain_road,
    striped,
    water,
)
from zlocus.synthetic.terrain import BUILDING, GROUND, PATTERN_GRAIN, SyntheticGround, plain_material

TROUBLE_STREAM = 37
# Diameter of lakes and of snow, and sides of squares, m.
LAKE_M, SNOW_M, SIDE_M, TERRACE_SIDE_M = 68.0, 110.0, 96.0, 64.0
# Side of a field, m, by the distance of its rows, m.
ROWS_SIDE_M = {2.0: 62.0, 4.0: 110.0}
WAVE_CONTRAST, CALM_CONTRAST, SNOW_ALBEDO = 0.15, 0.06, 3.0
TOWER_M, N_TOWERS, TOWER_SIDE_M, FOOT_M = 130.0, 3, 16.0, 3.0
TERRACE_M = 12.0
ROAD_M = 10.0
BAY_M, AISLE_M = (2.6, 5.2), 7.0
# Albedo of what saturates sensors of 12 bits with the gain of the town's images.
BLINDING = 6.0
N_HALLS, HALL_M, HALL_HEIGHT_M = 3, (48.0, 40.0), 9.0


def with_trouble(ground: SyntheticGround, name: str, truth_area: TruthArea, seed: int) -> SyntheticGround:
    """The ground with one trouble of `TROUBLES` in the middle of the area; `marked` are its cells."""
    painter = Painter.on(ground)
    rng = np.random.default_rng([seed, TROUBLE_STREAM])
    marked = TROUBLES[name](painter, truth_area, rng)
    return replace(painter.painted(), marked=marked)


def _cleared_disc(painter: Painter, truth_area: TruthArea, diameter_m: float = LAKE_M) -> BoolArray:
    """A horizontal disc in the middle of the area, from which all objects were taken."""
    disc = painter.disc(*truth_area.middle, diameter_m / 2)
    painter.level(disc, float(np.percentile(painter.ground.heights[disc], 5.0)))
    return disc


def _cleared_rectangle(painter: Painter, truth_area: TruthArea, side_m: float = SIDE_M) -> tuple[Footprint, BoolArray]:
    """A horizontal square along the base line in the middle of the area, from which all objects were taken."""
    place = Footprint(*truth_area.middle, 0.0, side_m, side_m)
    where = painter.rectangle(place)
    painter.level(where, float(np.percentile(painter.ground.heights[where], 20.0)))
    return place, where


def _rough_lake(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    lake = _cleared_disc(painter, truth_area)
    painter.cover(lake, water(0.12, WAVE_CONTRAST))
    return lake


def _glittering_lake(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    lake = _cleared_disc(painter, truth_area)
    painter.cover(lake, glitter(0.06, 12.0))
    return lake


def _calm_lake(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    lake = _cleared_disc(painter, truth_area)
    painter.cover(lake, water(0.05, CALM_CONTRAST))
    return lake


def _snow(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    """An even field under snow that is brighter than the sensor can tell."""
    snow = _cleared_disc(painter, truth_area, SNOW_M)
    painter.cover(snow, plain_ground(SNOW_ALBEDO, 0.0))
    return snow


def _rows(period_m: float) -> Callable[[Painter, TruthArea, np.random.Generator], BoolArray]:
    """Crops in rows across the base line, so that they repeat along it."""

    def paint(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
        place, where = _cleared_rectangle(painter, truth_area, ROWS_SIDE_M[period_m])
        painter.cover(where, striped(crops(place, period_m, 0.4, 0.3)))
        return where

    return paint


def _greenhouses(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    place, _ = _cleared_rectangle(painter, truth_area)
    return painter.greenhouses(place)


def _plain_square(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    _, where = _cleared_rectangle(painter, truth_area)
    painter.cover(where, plain_ground(0.5, 0.0))
    return where


def _plain_terrace(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    """An even platform that stands above the town."""
    _, where = _cleared_rectangle(painter, truth_area, TERRACE_SIDE_M)
    painter.ground.heights[where] += TERRACE_M
    painter.cover(where, plain_material(GROUND, PATTERN_GRAIN, 0.5, 0.0))
    return where


def _saturated_road(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    """A road along the base line that is brighter than the sensor can tell."""
    middle = np.full(len(painter.y()), truth_area.middle[0])
    where = np.asarray(np.abs(painter.x() - middle[:, None]) < ROAD_M / 2)
    painter.clear(where)
    painter.road(middle, ROAD_M, plain_road(BLINDING, 0.0))
    return where


def _cars(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    """A car park along the base line whose bays are taken by other cars in each image."""
    place, where = _cleared_rectangle(painter, truth_area)
    painter.cover(where, plain_road(0.3, 0.03))
    x0, y0 = place.x - SIDE_M / 2, place.y - SIDE_M / 2
    bays = [
        (x0 + 3.0 + k * (BAY_M[1] + AISLE_M / 2), y0 + BAY_M[0] * (j + 1.0), 1.0, 0.0)
        for k in range(int((SIDE_M - 6.0) / (BAY_M[1] + AISLE_M / 2)))
        for j in range(int(SIDE_M / BAY_M[0]) - 2)
    ]
    painter.lanes.append(np.array(bays))
    return where


def _towers(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    """Towers that stand far above the town; they and the ground at their feet are marked."""
    marked = np.zeros(painter.ground.heights.shape, bool)
    for k in range(N_TOWERS):
        x = truth_area.middle[0] + (k - (N_TOWERS - 1) / 2) * 55.0
        marked |= painter.tower((x, truth_area.middle[1] + rng.uniform(-20.0, 20.0)), TOWER_SIDE_M, TOWER_M)
    return np.asarray(binary_dilation(marked, iterations=round(FOOT_M / painter.ground.step)))


def _saturated_roofs(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> BoolArray:
    """Halls among the houses of the town, and all roofs even and brighter than the sensor can tell."""
    for material in painter.materials:
        if material["kind"] == BUILDING:
            material["albedo"], material["contrast"], material["pattern"] = BLINDING, 0.0, PATTERN_GRAIN
    for k in range(N_HALLS):
        x = truth_area.middle[0] + (k - (N_HALLS - 1) / 2) * 1.6 * HALL_M[0]
        hall = painter.rectangle(
            Footprint(x, truth_area.middle[1] + rng.uniform(-40.0, 40.0), rng.uniform(0.0, np.pi), *HALL_M)
        )
        painter.clear(hall)
        painter.level(hall, float(painter.ground.heights[hall].max()) + HALL_HEIGHT_M)
        painter.cover(hall, plain_material(BUILDING, PATTERN_GRAIN, BLINDING, 0.0))
    kinds = np.array([int(material["kind"]) for material in painter.materials])
    return np.asarray(kinds[painter.ground.material] == BUILDING)


TROUBLES: dict[str, Callable[[Painter, TruthArea, np.random.Generator], BoolArray]] = {
    "lake": _rough_lake, "glitter": _glittering_lake, "calm-lake": _calm_lake, "snow": _snow,
    "rows-2m": _rows(2.0), "rows-4m": _rows(4.0), "greenhouses": _greenhouses, "square": _plain_square,
    "terrace": _plain_terrace, "road": _saturated_road, "cars": _cars, "towers": _towers, "roofs": _saturated_roofs,
}  # fmt: skip
