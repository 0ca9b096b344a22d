"""The ground of realistic scenes: hills, rock terraces, forest, fields, water, plain and saturated roads.

What makes real images hard is here in the proportions that they have: even surfaces whose texture is below the noise,
surfaces brighter than the sensor can tell, periodic rows, rough crowns. Rarer things stand in a share of the scenes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zlocus.core.options.option_fields import Checked, option
from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.objects import Footprint, Objects, Tree, place_building, plant_tree
from zlocus.synthetic.painting import BoolArray, Painter, TruthArea, crops, glitter, plain_ground, plain_road, water
from zlocus.synthetic.terrain import (
    FIELD,
    GROUND,
    PATTERN_FOLIAGE,
    PATTERN_NATURAL,
    ROAD,
    TREE,
    SyntheticGround,
    plain_material,
)
from zlocus.synthetic.textures import fractal_surface

COVER_STREAM = 31
GROUND_ALBEDO, GROUND_CONTRAST = 0.25, 0.17
TREE_ALBEDOS, LEAF_CONTRAST = (0.15, 0.19, 0.24), 0.3
ROOFS = (0.18, 0.22, 0.27, 0.33, 0.42, 0.75, 0.95)
WOOD_M, WOOD_EXPONENT = 90.0, 2.2
CROWN_RADIUS_M, SLENDERNESS = (1.8, 4.2), (2.1, 3.4)
ROAD_CONTRAST = 0.014
CROWN_ROUGH_M = 0.45
MAX_TREE_M, MAX_STANDS_PER_TREE = 15.0, 3
ROUGH_M = 0.08
# Things that a scene may hold beside what all of them have; each occurs in a share of the scenes.
RARE = ("greenhouses", "snow", "tower", "masts", "glitter", "square")


@dataclass(frozen=True)
class Cover(Checked):
    """What a realistic ground is covered with; the ranges that are drawn from lie around these values."""

    houses_per_ha: float = option(0.8, "Houses on open ground, per hectare.", low=0.0, high=50.0)
    plain_roofs: float = option(0.5, "Share of the roofs without texture.", low=0.0, high=1.0)
    forest_share: float = option(0.27, "Share of the ground that is forest.", low=0.0, high=0.9)
    trees_per_forest_ha: float = option(330.0, "Trees in a hectare of forest.", low=0.0, high=2000.0)
    single_trees_per_ha: float = option(7.0, "Single trees on open ground, per hectare.", low=0.0, high=200.0)
    roads_along: int = option(3, "Roads along the base line.", low=0, high=20)
    roads_across: int = option(1, "Roads across it.", low=0, high=20)
    road_albedo: tuple[float, float] = (0.75, 1.15)
    n_fields: int = option(3, "Fields with rows of crops.", low=0, high=50)
    n_lakes: int = option(2, "Lakes.", low=0, high=20)
    n_terraces: int = option(1, "Hills with steps of rock.", low=0, high=20)
    rare_share: float = option(0.2, "Share of the scenes in which each of the rare things stands.", low=0.0, high=1.0)
    rare_objects: tuple[str, ...] | None = None  # None: drawn; else these


def realistic_ground(bare_ground: SyntheticGround, cover: Cover, truth_area: TruthArea, seed: int) -> SyntheticGround:
    """The bare terrain with all cover. Equal arguments give equal bytes.

    Whatever is drawn later gives way to what was drawn before: objects do not overlap, but trees hang over roads.
    """
    rng = np.random.default_rng([seed, COVER_STREAM])
    painter = Painter.on(bare_ground)
    painter.materials = [
        plain_material(GROUND, PATTERN_NATURAL, GROUND_ALBEDO, GROUND_CONTRAST),
        plain_road(0.2), plain_road(0.5),
        *(plain_material(TREE, PATTERN_FOLIAGE, albedo, LEAF_CONTRAST) for albedo in TREE_ALBEDOS),
    ]  # fmt: skip
    for _ in range(cover.n_terraces):
        _raise_terraces(painter, truth_area, rng)
    for _ in range(cover.n_lakes):
        _dig_lake(painter, truth_area, rng)
    _build_roads(painter, cover, truth_area, rng)
    rare = tuple(name for name in RARE if rng.random() < cover.rare_share)
    for name in rare if cover.rare_objects is None else cover.rare_objects:
        _add_rare(painter, name, truth_area, rng)
    _build_houses(painter, cover, rng)
    for _ in range(cover.n_fields):
        _sow_field(painter, truth_area, rng)
    _roughen(painter, rng)
    _plant_trees(painter, cover, rng)
    return painter.painted()


def _raise_terraces(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> None:
    """Raise a hill in steps with walls of rock, as vineyards and quarries have them."""
    x, y = truth_area.place(rng, 0.1 * truth_area.side_m)
    radius, n_steps = rng.uniform(60.0, 100.0), int(rng.integers(3, 6))
    dx, dy = painter.x() - x, painter.y() - y
    angle = np.arctan2(dy, dx)
    bent = np.hypot(dx, dy) * (1.0 + 0.06 * np.sin(3.0 * angle + rng.uniform(0.0, 6.0)))
    for k in range(n_steps):
        painter.ground.heights[bent < radius * (1.0 - k / n_steps)] += rng.uniform(2.5, 5.0)


def _dig_lake(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> None:
    x, y = truth_area.place(rng, 40.0)
    radius = rng.uniform(16.0, 26.0)
    flat = painter.disc(x, y, radius)
    painter.lake(flat, water(rng.uniform(0.03, 0.06), rng.uniform(0.1, 0.3)))


def _build_roads(painter: Painter, cover: Cover, truth_area: TruthArea, rng: np.random.Generator) -> None:
    """Build roads with even surfaces, some of them brighter than the sensor can tell."""
    y, x = painter.y()[:, 0], painter.x()[0]
    for k in range(cover.roads_along):
        start = truth_area.x + (k + rng.uniform(0.2, 0.8)) / max(cover.roads_along, 1) * truth_area.side_m
        middle = start + rng.normal(0.0, 0.08) * (y - truth_area.y - truth_area.side_m / 2) + _bend(y, rng)
        painter.road(middle, rng.uniform(6.0, 10.0), plain_road(rng.uniform(*cover.road_albedo), ROAD_CONTRAST))
    for _ in range(cover.roads_across):
        start = truth_area.y + rng.uniform(0.1, 0.9) * truth_area.side_m
        middle = start + rng.normal(0.0, 0.08) * (x - truth_area.x - truth_area.side_m / 2) + _bend(x, rng)
        painter.road_across(middle, rng.uniform(5.0, 9.0), plain_road(rng.uniform(*cover.road_albedo), ROAD_CONTRAST))


def _bend(along: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.asarray(rng.uniform(1.0, 6.0) * np.sin(along / rng.uniform(35.0, 80.0) + rng.uniform(0.0, 6.0)))


def _build_houses(painter: Painter, cover: Cover, rng: np.random.Generator) -> None:
    objects = Objects(0.0, 0.0, 0.0, 0.0, plain_roofs=cover.plain_roofs, roof_albedos=ROOFS)
    hectares = painter.ground.heights.size * painter.ground.step**2 / 1e4
    for _ in range(round(cover.houses_per_ha * hectares)):
        painter.materials += place_building(painter.ground, False, objects, len(painter.materials), rng)


def _sow_field(painter: Painter, truth_area: TruthArea, rng: np.random.Generator) -> None:
    """Sow a field of crops in rows 1.5 to 3 m apart, along or across the base line."""
    x, y = truth_area.place(rng, 0.0)
    angle = rng.normal(0.0, 0.08) + (0.0 if rng.random() < 0.5 else np.pi / 2)
    place = Footprint(x, y, angle, rng.uniform(50.0, 95.0), rng.uniform(40.0, 85.0))
    row = crops(place, rng.uniform(1.5, 3.0), rng.uniform(0.16, 0.3), rng.uniform(0.1, 0.3))
    painter.cover(painter.is_bare(painter.rectangle(place)), row)


def _roughen(painter: Painter, rng: np.random.Generator) -> None:
    bare = painter.is_bare(np.ones(painter.ground.heights.shape, bool))
    painter.ground.heights[bare] += ROUGH_M * rng.standard_normal(int(bare.sum()), dtype=np.float32)


def _plant_trees(painter: Painter, cover: Cover, rng: np.random.Generator) -> None:
    """Plant forest where a fractal field is high, and single trees elsewhere; crowns hang over roads and fields."""
    ground = painter.ground
    rows, cols = ground.heights.shape
    nodes = fractal_surface(rng, (rows // 4 + 1, cols // 4 + 1), 4 * ground.step, WOOD_M, WOOD_EXPONENT)
    is_forest = np.kron(nodes > np.quantile(nodes, 1.0 - cover.forest_share), np.ones((4, 4), bool))[:rows, :cols]
    hectares = ground.heights.size * ground.step**2 / 1e4
    kinds = np.array([int(material["kind"]) for material in painter.materials])
    allowed = np.flatnonzero(np.isin(kinds, (GROUND, TREE, ROAD, FIELD))).tolist()
    bare_heights = ground.heights.copy()
    wanted = {True: round(cover.trees_per_forest_ha * cover.forest_share * hectares),
              False: round(cover.single_trees_per_ha * (1.0 - cover.forest_share) * hectares)}  # fmt: skip
    for in_forest, number in wanted.items():
        cells = np.flatnonzero(_may_stand(ground, kinds) & (is_forest == in_forest))
        for _ in range(number if len(cells) else 0):
            for _ in range(MAX_STANDS_PER_TREE):
                row, col = divmod(int(cells[rng.integers(len(cells))]), cols)
                radius = rng.uniform(*CROWN_RADIUS_M)
                height = min(MAX_TREE_M, radius * rng.uniform(*SLENDERNESS))
                x, y = (col + 0.5) * ground.step, (row + 0.5) * ground.step
                tree = Tree(x, y, radius, height, sparse=True, rough_m=CROWN_ROUGH_M)
                if plant_tree(ground, tree, rng, bare_heights, allowed):
                    break


def _may_stand(ground: SyntheticGround, kinds: np.ndarray) -> BoolArray:
    """Cells on which a trunk may stand: ground and fields, not roads."""
    kind = kinds[ground.material]
    return np.isin(kind, (GROUND, FIELD))


def _add_rare(painter: Painter, name: str, truth_area: TruthArea, rng: np.random.Generator) -> None:
    """Add one of the rare things of `RARE` at a random place."""
    x, y = truth_area.place(rng, 0.15 * truth_area.side_m)
    ground = painter.ground
    if name == "greenhouses":
        painter.greenhouses(Footprint(x, y, rng.uniform(0.0, np.pi), rng.uniform(25.0, 45.0), 24.0))
    elif name == "snow":
        where = painter.is_bare(painter.disc(x, y, rng.uniform(20.0, 35.0)))
        painter.cover(where, plain_ground(1.1))
    elif name == "glitter":
        painter.lake(painter.disc(x, y, rng.uniform(14.0, 22.0)), glitter(0.05, rng.uniform(8.0, 20.0)))
    elif name == "square":
        where = painter.is_bare(painter.rectangle(Footprint(x, y, rng.uniform(0.0, np.pi), 40.0, 30.0)))
        painter.cover(where, plain_ground(rng.uniform(0.3, 0.5)))
    elif name == "tower":
        painter.tower((x, y), rng.uniform(16.0, 24.0), rng.uniform(60.0, 130.0))
    elif name == "masts":
        step = rng.uniform(25.0, 40.0)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        for k in range(4):
            at = x + k * step * np.cos(angle), y + k * step * np.sin(angle)
            if 2.0 < at[0] < painter.x()[0, -1] - 2.0 and 2.0 < at[1] < painter.y()[-1, 0] - 2.0:
                painter.tower(at, max(2 * ground.step, 0.6), rng.uniform(20.0, 40.0))
