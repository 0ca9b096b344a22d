"""Objects on bare terrain: roads, buildings with roofs and roof furniture, trees, crops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.terrain import (
    BUILDING,
    GROUND,
    MATERIAL,
    OBJECT_STREAM,
    PATTERN_GRAIN,
    PATTERN_LEAVES,
    PATTERN_NATURAL,
    PATTERN_ROWS,
    PATTERN_STRIPES,
    ROAD,
    TREE,
    SyntheticGround,
    plain_material,
)

BARE, ASPHALT, PAINT, FIRST_TREE = 0, 1, 2, 3
TREE_ALBEDOS = (0.20, 0.26, 0.33)
FIRST_BUILDING = FIRST_TREE + len(TREE_ALBEDOS)
TRIES_PER_OBJECT = 25
GAP_M = 2.5
CLUMP_M = 0.3
BALK_M = 2.0  # width of bare ground between fields of crops
CROWN_RADIUS_M = (1.6, 4.8)
ROUGHEST_CROWN = 0.75
LEAF_CONTRAST = 0.08
ROOF_ALBEDOS = (0.20, 0.26, 0.30, 0.38, 0.46, 0.62)
EAVES_M = (4.5, 6.0, 7.5, 9.0, 10.5, 12.0)


@dataclass(frozen=True)
class Objects:
    """Number and kind of the objects. Densities are per hectare.

    plain_roofs : share of roofs without a pattern, whose texture is hardly above the noise; half of the others are
    striped, half look like gravel. tower_m : lowest and highest height of towers; up to 2 m are added. rough_m :
    standard deviation of the heights of single cells on bare ground (grass, stones). crop_side_m : side of square
    fields of crops in periodic rows, on bare ground; 0: no crops. roof_albedos : of roofs.
    """

    road_spacing_m: float
    buildings_per_ha: float
    towers_per_ha: float
    trees_per_ha: float
    plain_roofs: float = 0.5
    max_tree_m: float = 14.0
    tower_m: tuple[float, float] = (21.0, 32.0)
    rough_m: float = 0.0
    crop_side_m: float = 0.0
    roof_albedos: tuple[float, ...] = ROOF_ALBEDOS


@dataclass(frozen=True)
class Footprint:
    """The footprint of an object.

    x, y : its centre, m east and south of the corner of the height field; angle : of its length, rad; length, width :
    m.
    """

    x: float
    y: float
    angle: float
    length: float
    width: float

    def window(self, ground: SyntheticGround, margin_m: float) -> tuple[slice, slice] | None:
        """Rows and columns of the footprint with a margin; None where it leaves the height field."""
        radius = 0.5 * np.hypot(self.length, self.width) + margin_m
        first_row, first_col = (int((c - radius) // ground.step) for c in (self.y, self.x))
        last_row, last_col = (int((c + radius) // ground.step) + 1 for c in (self.y, self.x))
        if min(first_row, first_col) < 0 or last_row > ground.heights.shape[0] or last_col > ground.heights.shape[1]:
            return None
        return slice(first_row, last_row), slice(first_col, last_col)

    def axes(self, ground: SyntheticGround, window: tuple[slice, slice]) -> tuple[FloatArray, FloatArray]:
        """Distances (m) of the window's cells from the centre, along the length and along the width."""
        dy = (np.arange(window[0].start, window[0].stop) + 0.5)[:, None] * ground.step - self.y
        dx = (np.arange(window[1].start, window[1].stop) + 0.5)[None, :] * ground.step - self.x
        c, s = np.cos(self.angle), np.sin(self.angle)
        return c * dx + s * dy, c * dy - s * dx


def add_objects(ground: SyntheticGround, objects: Objects, seed: int) -> SyntheticGround:
    """The terrain with roads, towers, other buildings, trees and crops, in that order. Objects do not overlap."""
    rng = np.random.default_rng([seed, OBJECT_STREAM])
    painted = replace(ground, planes=ground.planes.copy(), material=ground.material.copy())
    materials = [ground.materials[0], plain_material(ROAD, PATTERN_GRAIN, 0.27, 0.03),
                 plain_material(ROAD, PATTERN_GRAIN, 0.62, 0.02)]  # fmt: skip
    materials += [plain_material(TREE, PATTERN_LEAVES, albedo, LEAF_CONTRAST) for albedo in TREE_ALBEDOS]
    hectares = ground.heights.size * ground.step**2 / 1e4
    if objects.road_spacing_m:
        _draw_roads(painted, objects.road_spacing_m, rng)
    for per_ha, is_tower in ((objects.towers_per_ha, True), (objects.buildings_per_ha, False)):
        for _ in range(round(per_ha * hectares)):
            materials += place_building(painted, is_tower, objects, len(materials), rng)
    for _ in range(round(objects.trees_per_ha * hectares)):
        place_tree(painted, objects.max_tree_m, rng)
    if objects.crop_side_m:
        materials += _plant_crops(painted, objects.crop_side_m, len(materials), rng)
    if objects.rough_m:
        bare = painted.material == BARE
        painted.heights[bare] += objects.rough_m * rng.standard_normal(int(bare.sum()), dtype=np.float32)
    return replace(painted, materials=np.array(materials, MATERIAL))


def _draw_roads(ground: SyntheticGround, spacing_m: float, rng: np.random.Generator) -> None:
    """Draw slightly bent roads in both directions, 6 to 9 m wide, with a dashed centre line."""
    for transposed in (False, True):
        material = ground.material.T if transposed else ground.material
        length, breadth = (n * ground.step for n in material.shape)
        for k in range(round(breadth / spacing_m)):
            along = (np.arange(material.shape[0]) + 0.5) * ground.step
            middle = (k + rng.uniform(0.25, 0.75)) * spacing_m + rng.normal(0.0, 0.10) * (along - length / 2)
            middle += rng.uniform(1.0, 5.0) * np.sin(along / rng.uniform(25.0, 60.0) + rng.uniform(0.0, 6.0))
            half = rng.uniform(3.0, 4.5)
            half_cells = int(half / ground.step) + 2
            col = np.floor(middle / ground.step).astype(int)[:, None] + np.arange(-half_cells, half_cells + 1)[None, :]
            off = np.abs((col + 0.5) * ground.step - middle[:, None])
            row = np.broadcast_to(np.arange(len(along))[:, None], col.shape)
            inside = (col >= 0) & (col < material.shape[1])
            asphalt = inside & (off < half)
            material[row[asphalt], col[asphalt]] = ASPHALT
            dashed = inside & (off < 0.2) & (np.remainder(along, 7.0) < 3.0)[:, None]
            material[row[dashed], col[dashed]] = PAINT


def place_building(
    ground: SyntheticGround, is_tower: bool, objects: Objects, index: int, rng: np.random.Generator
) -> list[NDArray[np.void]]:  # fmt: skip
    """Place a building where there is room for it, and return its materials; empty where no room was found."""
    for _ in range(TRIES_PER_OBJECT):
        rows, cols = ground.heights.shape
        length, width = rng.uniform(12.0, 27.0), rng.uniform(10.0, 17.0)
        if is_tower:
            length, width = rng.uniform(14.0, 22.0), rng.uniform(13.0, 18.0)
        footprint = Footprint(
            rng.uniform(0, cols * ground.step), rng.uniform(0, rows * ground.step), rng.uniform(0, np.pi), length, width
        )
        window = footprint.window(ground, GAP_M)
        if window is None:
            continue
        p, q = footprint.axes(ground, window)
        near = (np.abs(p) < length / 2 + GAP_M) & (np.abs(q) < width / 2 + GAP_M)
        if (ground.material[window][near] != BARE).any():
            continue
        storey_height = rng.uniform(*objects.tower_m) if is_tower else float(rng.choice(EAVES_M))
        return _build(ground, footprint, window, storey_height + rng.uniform(0.0, 2.0), is_tower, objects, index, rng)
    return []


def _build(
    ground: SyntheticGround, footprint: Footprint, window: tuple[slice, slice], height: float, is_tower: bool,
    objects: Objects, index: int, rng: np.random.Generator,
) -> list[NDArray[np.void]]:  # fmt: skip
    """Build roof and roof furniture of one building, and return its materials."""
    p, q = footprint.axes(ground, window)
    inside = (np.abs(p) <= footprint.length / 2) & (np.abs(q) <= footprint.width / 2)
    heights, slopes = ground.heights[window], ground.slopes[window]
    base = float(heights[inside].min())
    eave = float(heights[inside].max()) + height
    pitch = 0.0 if is_tower or rng.random() < 0.55 else rng.uniform(0.25, 0.85)
    heights[inside] = eave + pitch * (footprint.width / 2 - np.abs(q[inside]))
    towards = -pitch * np.sign(q[inside]) * ground.step
    slopes[inside] = towards[:, None] * (-np.sin(footprint.angle), np.cos(footprint.angle))
    material = _building_material(footprint, base, objects, rng)
    ground.material[window][inside] = index
    if pitch:
        return [material]
    furniture = material.copy()
    furniture["albedo"] = furniture["wall"] = rng.choice([0.10, 0.16, 0.70])
    furniture["pattern"], furniture["floor"] = PATTERN_GRAIN, 0.0
    for _ in range(rng.integers(1, 6)):
        size = rng.uniform(0.8, 2.6, 2)
        centre = rng.uniform(-0.42, 0.42, 2) * (footprint.length, footprint.width)
        box = inside & (np.abs(p - centre[0]) < size[0] / 2) & (np.abs(q - centre[1]) < size[1] / 2)
        heights[box] = eave + rng.uniform(0.6, 2.5)
        ground.material[window][box] = index + 1
    return [material, furniture]


def _building_material(
    footprint: Footprint, base: float, objects: Objects, rng: np.random.Generator
) -> NDArray[np.void]:
    """The material of a building: a plain, striped or textured roof, and walls with rows of windows."""
    plain_roofs = objects.plain_roofs
    patterned = (1.0 - plain_roofs) / 2
    pattern = int(rng.choice([PATTERN_GRAIN, PATTERN_STRIPES, PATTERN_NATURAL], p=[plain_roofs, patterned, patterned]))
    contrast = {PATTERN_GRAIN: 0.006, PATTERN_STRIPES: rng.uniform(0.05, 0.25), PATTERN_NATURAL: 0.03}[pattern]
    material = plain_material(BUILDING, pattern, float(rng.choice(objects.roof_albedos)), contrast)
    material["period"] = rng.uniform(0.7, 2.4)
    material["x"], material["y"] = footprint.x, footprint.y
    material["cos"], material["sin"] = np.cos(footprint.angle), np.sin(footprint.angle)
    material["half_length"], material["half_width"] = footprint.length / 2, footprint.width / 2
    material["base"], material["wall"] = base, rng.uniform(0.2, 0.55)
    material["floor"], material["window"] = rng.uniform(2.7, 3.4), rng.uniform(1.6, 3.2)
    return material


def place_tree(ground: SyntheticGround, max_tree_m: float, rng: np.random.Generator) -> None:
    """Place a tree on bare ground where there is room for it. Trees may touch."""
    for _ in range(TRIES_PER_OBJECT):
        rows, cols = ground.heights.shape
        radius = rng.uniform(*CROWN_RADIUS_M)
        height = min(max_tree_m, radius * rng.uniform(1.8, 3.2))
        x, y = rng.uniform(0, cols * ground.step), rng.uniform(0, rows * ground.step)
        if plant_tree(ground, Tree(x, y, radius, height), rng):
            return


@dataclass(frozen=True)
class Tree:
    """A tree. x, y : m east and south of the corner of the height field; radius_m : of the crown; height_m : of its
    top above its foot.

    sparse : the foliage is sparse: leaves of a cell lie `rough_m` (standard deviation) off the crown's ellipsoid, and a
    share `gaps` of the crown's cells shows the ground below; otherwise the crown is closed and broken up into clumps.
    """

    x: float
    y: float
    radius_m: float
    height_m: float
    sparse: bool = False
    rough_m: float = 0.7
    gaps: float = 0.07


def plant_tree(
    ground: SyntheticGround,
    tree: Tree,
    rng: np.random.Generator,
    bare_heights: NDArray[np.float32] | None = None,
    allowed: Sequence[int] = (BARE, *range(FIRST_TREE, FIRST_BUILDING)),
) -> bool:
    """Plant a tree, half an ellipsoid above the height of its trunk; whether there was room for it.

    bare_heights : (r, c) m that trunks stand on, None: those of the ground with what was planted before; allowed :
    materials that the crown may stand on.
    """
    footprint = Footprint(tree.x, tree.y, 0.0, 2 * tree.radius_m, 2 * tree.radius_m)
    window = footprint.window(ground, 0.0)
    if window is None:
        return False
    p, q = footprint.axes(ground, window)
    squared = (p * p + q * q) / tree.radius_m**2
    lobes = 1.0 + 0.16 * np.sin(5.0 * np.arctan2(q, p) + rng.uniform(0.0, 6.0))
    crown = squared < lobes**2
    if not np.isin(ground.material[window][crown], allowed).all():
        return False
    trunk = 0.35 * tree.height_m
    top = trunk + (tree.height_m - trunk) * np.sqrt(np.maximum(1.0 - squared, 0.02))
    if tree.sparse:
        rough = np.asarray(top + tree.rough_m * rng.standard_normal(top.shape), np.float64)
        crown &= rng.random(top.shape) >= tree.gaps
    else:
        clump = max(1, round(CLUMP_M / ground.step))
        clumps = np.kron(rng.uniform(ROUGHEST_CROWN, 1.0, [n // clump + 1 for n in top.shape]), np.ones((clump, clump)))
        rough = np.asarray(top * clumps[: top.shape[0], : top.shape[1]], np.float64)
    below = ground.heights if bare_heights is None else bare_heights
    foot = float(below[window][top.shape[0] // 2, top.shape[1] // 2])
    crown &= foot + rough > ground.heights[window] + 0.3
    ground.heights[window][crown] = (foot + rough)[crown]
    ground.slopes[window][crown] = 0.0
    ground.material[window][crown] = FIRST_TREE + rng.integers(len(TREE_ALBEDOS))
    return True


def _plant_crops(
    ground: SyntheticGround, side_m: float, index: int, rng: np.random.Generator
) -> list[NDArray[np.void]]:
    """Plant square fields of crops on bare ground, each with one direction and period, and return their materials."""
    side, balk = round(side_m / ground.step), round(BALK_M / ground.step)
    materials: list[NDArray[np.void]] = []
    for row in range(0, ground.heights.shape[0], side):
        for col in range(0, ground.heights.shape[1], side):
            crop = plain_material(GROUND, PATTERN_ROWS, rng.uniform(0.28, 0.5), rng.uniform(0.15, 0.3))
            angle = rng.uniform(0.0, np.pi)
            crop["cos"], crop["sin"], crop["period"] = np.cos(angle), np.sin(angle), rng.uniform(1.6, 4.0)
            crop["x"], crop["y"] = col * ground.step, row * ground.step
            part = ground.material[row : row + side - balk, col : col + side - balk]
            part[part == BARE] = index + len(materials)
            materials.append(crop)
    return materials
