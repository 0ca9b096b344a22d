"""The ground of a drone block: gardens, roads, houses, parked cars and trees, at a few centimetres.

A height field as of `terrain`, with objects that are finer than those of `objects`: at a ground pixel of three
centimetres a roof shows its tiles, a crown its branches and leaves, and a car its windows. Every material has a colour.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.drone_trees import Crown, crown_tops, drawn_crown
from zlocus.synthetic.objects import Footprint
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

# Class of cars in `truth_class.tif`, beside those of `terrain`.
CAR = 6
ROWS_AT_ONCE = 512
TRIES_PER_OBJECT = 40

Colour = tuple[float, float, float]
GREY, GREEN, BROWN = (1.00, 1.00, 1.00), (0.91, 1.08, 0.73), (1.11, 0.98, 0.81)


class Surfacing(NamedTuple):
    """A material of the ground. rough_m : standard deviation of the heights of single cells (grass, stones)."""

    kind: int
    pattern: int
    albedo: float
    contrast: float
    rough_m: float
    colour: Colour


# Materials of gardens and meadows, then of roads, hedges and trees, in the order of their indices.
GARDENS = (
    Surfacing(GROUND, PATTERN_NATURAL, 0.20, 0.20, 0.012, GREEN),
    Surfacing(GROUND, PATTERN_NATURAL, 0.25, 0.17, 0.012, (0.95, 1.06, 0.73)),
    Surfacing(GROUND, PATTERN_NATURAL, 0.31, 0.20, 0.02, (1.04, 1.03, 0.78)),
    Surfacing(GROUND, PATTERN_NATURAL, 0.23, 0.26, 0.05, (0.92, 1.06, 0.72)),
    Surfacing(GROUND, PATTERN_NATURAL, 0.19, 0.22, 0.025, BROWN),
    Surfacing(GROUND, PATTERN_NATURAL, 0.40, 0.14, 0.01, (1.03, 1.00, 0.94)),
)
SHARE_OF_GARDENS = (0.3, 0.22, 0.14, 0.2, 0.07, 0.07)
ROADS = (
    Surfacing(ROAD, PATTERN_LEAVES, 0.15, 0.045, 0.0, (0.99, 1.00, 1.02)),
    Surfacing(ROAD, PATTERN_LEAVES, 0.11, 0.04, 0.0, (0.99, 1.00, 1.02)),
    Surfacing(ROAD, PATTERN_LEAVES, 0.30, 0.05, 0.0, (1.02, 1.00, 0.96)),
    Surfacing(ROAD, PATTERN_GRAIN, 0.58, 0.03, 0.0, GREY),
)
LEAVES = tuple(
    Surfacing(TREE, PATTERN_LEAVES, albedo, 0.25, 0.0, colour)
    for albedo, colour in (
        (0.12, (0.89, 1.08, 0.72)),
        (0.17, (0.92, 1.08, 0.67)),
        (0.22, (0.97, 1.06, 0.68)),
        (0.13, (0.88, 1.06, 0.82)),
    )
)
N_GARDENS = len(GARDENS)
ASPHALT, REPAIRED, PAVEMENT, PAINT = range(N_GARDENS, N_GARDENS + len(ROADS))
FIRST_LEAVES = N_GARDENS + len(ROADS)
HEDGE = FIRST_LEAVES

ROAD_SPACING_M, ROAD_HALF_M, PAVEMENT_M, KERB_M = 105.0, (2.6, 3.1), 1.5, 0.12
PLOT_M = (24.0, 31.0)
HEDGE_HALF_M, HEDGE_M, SHARE_OF_HEDGES = 0.45, 1.6, 0.3
REPAIRS_PER_HA = 6.0
ROOM_M = 1.0
ROOF_COLOURS = ((1.27, 0.91, 0.73), (1.19, 0.93, 0.81), (1.00, 1.00, 1.01), (0.98, 1.00, 1.04))
WALL_COLOURS = (GREY, (1.06, 1.0, 0.88), (1.12, 0.98, 0.80), (0.98, 1.01, 1.0))
CAR_PAINTS = (
    (0.75, GREY), (0.45, GREY), (0.06, GREY),
    (0.12, (0.75, 1.0, 1.6)), (0.14, (2.0, 0.6, 0.5)), (0.25, (0.95, 1.0, 1.08)),
)  # fmt: skip
# Heights of a car along its length, as distance from its middle and height (m), and from where to where it is glass.
CAR_PROFILE = ((-2.2, 0.9), (-1.7, 0.95), (-1.1, 1.42), (0.45, 1.45), (1.15, 0.92), (2.2, 0.75))
CAR_GLASS = ((-1.7, -1.15), (0.5, 1.15))
CAR_WIDTH_M = 1.78
# Targets lie in the middle of the ground, between these shares of its sides, and this far from other objects.
TARGET_AREA, TARGET_ROOM_M = (0.3, 0.7), 3.0
# Radii of the white disc of a target and of the black disc around it, in ground pixels.
TARGET_WHITE_PX, TARGET_BLACK_PX = 4.0, 9.0


@dataclass(frozen=True)
class Settlement:
    """Number of objects per hectare, and of targets on the whole ground. target_px_m : ground pixel of the targets."""

    houses_per_ha: float
    trees_per_ha: float
    cars_per_ha: float
    n_targets: int
    target_px_m: float


@dataclass(frozen=True)
class ColouredGround:
    """A ground with colours, and its targets.

    top_colours, wall_colours : (m, 3) float32 by material, factors of red, green and blue whose luminance is 1.
    targets : (n, 3) float64 m, centres of the targets.
    """

    ground: SyntheticGround
    top_colours: NDArray[np.float32]
    wall_colours: NDArray[np.float32]
    targets: FloatArray


@dataclass
class _Site:
    """The ground while objects are put on it: its arrays are written, its materials are appended."""

    ground: SyntheticGround
    rng: np.random.Generator
    hectares: float
    materials: list[NDArray[np.void]] = field(default_factory=list)
    colours: list[tuple[Colour, Colour]] = field(default_factory=list)

    def add(self, material: NDArray[np.void], top: Colour, wall: Colour | None = None) -> int:
        """Append a material and return its index."""
        self.materials.append(material)
        self.colours.append((top, top if wall is None else wall))
        return len(self.materials) - 1

    def free(self, footprint: Footprint, room_m: float, allowed: int = N_GARDENS) -> tuple[slice, slice] | None:
        """The window of a footprint with room around it; None where it leaves the ground or something else is there.

        allowed : materials below this index are free.
        """
        window = footprint.window(self.ground, room_m)
        if window is None:
            return None
        p, q = footprint.axes(self.ground, window)
        near = (np.abs(p) < footprint.length / 2 + room_m) & (np.abs(q) < footprint.width / 2 + room_m)
        return window if (self.ground.material[window][near] < allowed).all() else None

    def somewhere(self) -> tuple[float, float]:
        """A random place, x and y in m."""
        rows, cols = self.ground.heights.shape
        x, y = self.rng.uniform(0.0, 1.0, 2) * (cols, rows) * self.ground.step
        return float(x), float(y)


class _Road(NamedTuple):
    """A slightly bent road along one axis: across = start + lean * along + bend * sin(along / length + phase), m."""

    is_north_south: bool
    start: float
    lean: float
    bend: float
    length: float
    phase: float
    half: float

    def middle(self, along: NDArray[np.floating]) -> FloatArray:
        """Position of the middle line across the road, m."""
        return np.asarray(self.start + self.lean * along + self.bend * np.sin(along / self.length + self.phase))

    def distance(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> FloatArray:
        """Distance (m) from the border of the road, negative on it; x : (c,), y : (r, 1) m."""
        across, along = (x, y) if self.is_north_south else (y, x)
        return np.asarray(np.abs(across - self.middle(along)) - self.half)

    def direction(self, along: float) -> float:
        """Direction of the road, rad from the x axis towards the y axis."""
        slope = self.lean + self.bend / self.length * np.cos(along / self.length + self.phase)
        return float(np.arctan2(1.0, slope) if self.is_north_south else np.arctan(slope))


def build_settlement(ground: SyntheticGround, settlement: Settlement, seed: int) -> ColouredGround:
    """Bare terrain with gardens, roads, houses, cars, trees and targets on it, in that order.

    The arrays of the bare `ground` are overwritten, to save memory.
    """
    rng = np.random.default_rng([seed, OBJECT_STREAM])
    site = _Site(ground, rng, ground.heights.size * ground.step**2 / 1e4)
    for surfacing in (*GARDENS, *ROADS, *LEAVES):
        site.add(plain_material(*surfacing[:4]), surfacing.colour)
    roads = _drawn_roads(site)
    angle = float(rng.uniform(-0.12, 0.12))
    _lay_out(site, roads, angle)
    _repair_roads(site)
    for _ in range(round(settlement.houses_per_ha * site.hectares)):
        _place_house(site, angle)
    for _ in range(round(settlement.cars_per_ha * site.hectares)):
        _park_car(site, roads)
    for _ in range(round(settlement.trees_per_ha * site.hectares)):
        _plant_tree(site)
    targets = _lay_targets(site, settlement)
    _roughen(site)
    colours = np.array(site.colours, np.float32)
    colours /= (colours * (0.299, 0.587, 0.114)).sum(axis=2, keepdims=True)
    painted = replace(ground, materials=np.array(site.materials, MATERIAL))
    return ColouredGround(painted, colours[:, 0].astype(np.float32), colours[:, 1].astype(np.float32), targets)


def _drawn_roads(site: _Site) -> list[_Road]:
    rows, cols = site.ground.heights.shape
    roads, rng = [], site.rng
    for is_north_south, across_m in ((True, cols * site.ground.step), (False, rows * site.ground.step)):
        n = max(1, round(across_m / ROAD_SPACING_M))
        for k in range(n):
            start = (k + rng.uniform(0.35, 0.65)) * across_m / n
            bend = (rng.uniform(1.0, 4.0), rng.uniform(30.0, 60.0), rng.uniform(0.0, 6.0))
            roads.append(_Road(is_north_south, start, rng.normal(0.0, 0.05), *bend, rng.uniform(*ROAD_HALF_M)))
    return roads


def n_plots(height_m: float, width_m: float, angle: float) -> int:
    """Number of plots along each side of a rotated raster of plots that covers the ground from its middle on."""
    usual = int(2 * max(height_m, width_m) / min(PLOT_M)) + 4
    corners = [(x, y) for x in (0.0, width_m) for y in (0.0, height_m)]
    across = max(abs(np.cos(angle) * x + np.sin(angle) * y) / PLOT_M[0] for x, y in corners)
    along = max(abs(np.cos(angle) * y - np.sin(angle) * x) / PLOT_M[1] for x, y in corners)
    return max(usual, 2 * int(np.ceil(max(across, along))))


def _lay_out(site: _Site, roads: list[_Road], angle: float) -> None:
    """Paint gardens in rotated rectangles with hedges between some of them, and roads with pavements over them."""
    ground, rng = site.ground, site.rng
    rows, cols = ground.heights.shape
    extent = n_plots(rows * ground.step, cols * ground.step, angle)
    plots = rng.choice(N_GARDENS, (extent, extent), p=SHARE_OF_GARDENS).astype(np.uint16)
    hedges = rng.random((2, extent, extent)) < SHARE_OF_HEDGES
    x = np.asarray((np.arange(cols) + 0.5) * ground.step)
    for first in range(0, rows, ROWS_AT_ONCE):
        part = slice(first, min(first + ROWS_AT_ONCE, rows))
        y = np.asarray((np.arange(part.start, part.stop) + 0.5)[:, None] * ground.step)
        u = (np.cos(angle) * x + np.sin(angle) * y) / PLOT_M[0] + extent / 2
        v = (np.cos(angle) * y - np.sin(angle) * x) / PLOT_M[1] + extent / 2
        i, j = v.astype(np.int64), u.astype(np.int64)
        material = plots[i, j]
        is_hedge = (hedges[0, i, j] & ((u - j) * PLOT_M[0] < 2 * HEDGE_HALF_M)) | (
            hedges[1, i, j] & ((v - i) * PLOT_M[1] < 2 * HEDGE_HALF_M)
        )
        offsets = [road.distance(x, y) for road in roads]
        off = np.minimum.reduce([np.broadcast_to(each, material.shape) for each in offsets])
        material[is_hedge & (off > PAVEMENT_M + 1.0)] = HEDGE
        material[off < PAVEMENT_M] = PAVEMENT
        material[off < 0.0] = ASPHALT
        for road, each in zip(roads, offsets, strict=True):
            along = np.broadcast_to(y if road.is_north_south else x, material.shape)
            material[(off < 0.0) & (each < 0.075 - road.half) & (np.remainder(along, 6.0) < 2.5)] = PAINT
        ground.material[part] = material
        heights = ground.heights[part]
        heights[material == PAVEMENT] += KERB_M
        hedge = material == HEDGE
        heights[hedge] += HEDGE_M * rng.uniform(0.75, 1.0, int(hedge.sum())).astype(np.float32)


def _repair_roads(site: _Site) -> None:
    """Paint rectangles of darker asphalt."""
    for _ in range(round(REPAIRS_PER_HA * site.hectares)):
        length, width = site.rng.uniform(1.0, 6.0), site.rng.uniform(0.6, 1.8)
        footprint = Footprint(*site.somewhere(), site.rng.uniform(0.0, np.pi), length, width)
        window = footprint.window(site.ground, 0.0)
        if window is not None:
            p, q = footprint.axes(site.ground, window)
            material = site.ground.material[window]
            material[(np.abs(p) < length / 2) & (np.abs(q) < width / 2) & (material == ASPHALT)] = REPAIRED


def _place_house(site: _Site, angle: float) -> None:
    """Place a house with a gabled, hipped or flat roof, where there is room for it."""
    rng = site.rng
    for _ in range(TRIES_PER_OBJECT):
        turned = angle + rng.normal(0.0, 0.08) + (np.pi / 2 if rng.random() < 0.5 else 0.0)
        footprint = Footprint(*site.somewhere(), turned, rng.uniform(9.0, 15.0), rng.uniform(7.0, 10.5))
        window = site.free(footprint, ROOM_M)
        if window is None:
            continue
        is_flat = rng.random() < 0.3
        eaves = rng.uniform(2.6, 6.2)
        pitch = 0.0 if is_flat else rng.uniform(0.55, 1.0)
        index = site.add(*_house_material(site, footprint, is_flat))
        eave = _raise_roof(site, footprint, window, eaves, pitch, index)
        furnish = _furnish_flat_roof if is_flat else _furnish_pitched_roof
        furnish(site, footprint, eave, pitch)
        return


def _house_material(
    site: _Site, footprint: Footprint, is_flat: bool
) -> tuple[NDArray[np.void], Colour, Colour]:  # fmt: skip
    """A material with rows of tiles, or of gravel or plain sheets on flat roofs; and the colours of roof and walls."""
    rng = site.rng
    if is_flat:
        is_plain = rng.random() < 0.35
        pattern, contrast = (PATTERN_GRAIN, 0.02) if is_plain else (PATTERN_NATURAL, 0.10)
        material = plain_material(BUILDING, pattern, rng.uniform(0.2, 0.5), contrast)
        colour: Colour = GREY
    else:
        material = plain_material(BUILDING, PATTERN_ROWS, rng.uniform(0.12, 0.3), rng.uniform(0.08, 0.16))
        material["period"] = rng.uniform(0.28, 0.36)
        colour = ROOF_COLOURS[rng.integers(len(ROOF_COLOURS))]
    _place_material(material, footprint)
    material["wall"], material["floor"], material["window"] = rng.uniform(0.3, 0.6), 2.8, rng.uniform(1.8, 3.2)
    return material, colour, WALL_COLOURS[rng.integers(len(WALL_COLOURS))]


def _place_material(material: NDArray[np.void], footprint: Footprint) -> None:
    """Give a material the place of its object, which its pattern and its walls follow."""
    material["x"], material["y"] = footprint.x, footprint.y
    material["cos"], material["sin"] = np.cos(footprint.angle), np.sin(footprint.angle)
    material["half_length"], material["half_width"] = footprint.length / 2, footprint.width / 2


def _raise_roof(
    site: _Site, footprint: Footprint, window: tuple[slice, slice], eaves: float, pitch: float, index: int
) -> float:
    """Raise walls and roof, and return the height of the eaves. A third of the pitched roofs are hipped."""
    ground = site.ground
    p, q = footprint.axes(ground, window)
    inside = (np.abs(p) <= footprint.length / 2) & (np.abs(q) <= footprint.width / 2)
    heights, slopes = ground.heights[window], ground.slopes[window]
    site.materials[index]["base"] = float(heights[inside].min())
    eave = float(heights[inside].max()) + eaves
    c, s = np.cos(footprint.angle), np.sin(footprint.angle)
    beside, before = footprint.width / 2 - np.abs(q), footprint.length / 2 - np.abs(p)
    is_hip = (before < beside) & (site.rng.random() < 0.35)
    heights[inside] = eave + pitch * np.where(is_hip, before, beside)[inside]
    across = np.stack([np.sign(q) * s, -np.sign(q) * c], axis=-1)
    along = np.stack([-np.sign(p) * c, -np.sign(p) * s], axis=-1)
    slopes[inside] = pitch * ground.step * np.where(is_hip[..., None], along, across)[inside]
    ground.material[window][inside] = index
    return eave


def _furnish_flat_roof(site: _Site, footprint: Footprint, eave: float, pitch: float) -> None:
    """Put a few boxes on a flat roof, and a parapet at its border."""
    rng = site.rng
    for _ in range(rng.integers(1, 5)):
        at = rng.uniform(-0.38, 0.38, 2) * (footprint.length, footprint.width)
        size = rng.uniform(0.6, 2.2, 2)
        _put_box(site, footprint, at, size, eave + rng.uniform(0.4, 1.6), float(rng.choice([0.12, 0.3, 0.6])))


def _furnish_pitched_roof(site: _Site, footprint: Footprint, eave: float, pitch: float) -> None:
    """Put a chimney and solar panels or skylights on a pitched roof. Panels and skylights lie in the roof's plane."""
    rng = site.rng
    at = np.array([rng.uniform(-0.35, 0.35) * footprint.length, rng.uniform(-0.15, 0.15) * footprint.width])
    ridge = eave + pitch * footprint.width / 2
    _put_box(site, footprint, at, rng.uniform(0.5, 0.9, 2), ridge + rng.uniform(0.3, 0.8), 0.25)
    side = 1.0 if rng.random() < 0.5 else -1.0
    is_solar = rng.random() < 0.35
    for _ in range(1 if is_solar else int(rng.integers(0, 4))):
        size = rng.uniform((3.0, 1.8), (6.0, 3.0)) if is_solar else np.array([0.8, 1.2])
        panel = plain_material(BUILDING, PATTERN_STRIPES if is_solar else PATTERN_GRAIN, 0.07, 0.15)
        _place_material(panel, footprint)
        panel["period"], panel["wall"] = 1.0, 0.1
        at = np.array([rng.uniform(-0.28, 0.28) * footprint.length, side * 0.25 * footprint.width])
        index = site.add(panel, (0.9, 1.0, 1.25))
        cells, inside = _box(site, footprint, at, size)
        site.ground.heights[cells][inside] += 0.12 if is_solar else 0.04
        site.ground.material[cells][inside] = index


def _put_box(
    site: _Site, footprint: Footprint, at: FloatArray, size: FloatArray, top: float, albedo: float
) -> None:  # fmt: skip
    """Put a box on a building. at : its centre along the length and the width of the building, m; top : its height."""
    cells, inside = _box(site, footprint, at, size)
    material = plain_material(BUILDING, PATTERN_LEAVES, albedo, 0.06)
    c, s = np.cos(footprint.angle), np.sin(footprint.angle)
    x, y = footprint.x + c * at[0] - s * at[1], footprint.y + s * at[0] + c * at[1]
    _place_material(material, Footprint(x, y, footprint.angle, *size))
    index = site.add(material, GREY)
    site.ground.heights[cells][inside] = top
    site.ground.slopes[cells][inside] = 0.0
    site.ground.material[cells][inside] = index


def _box(
    site: _Site, footprint: Footprint, at: FloatArray, size: FloatArray
) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:  # fmt: skip
    """The window of a building, and the cells of it in a rectangle."""
    window = footprint.window(site.ground, 0.0)
    assert window is not None, "the building itself lies on the ground"
    p, q = footprint.axes(site.ground, window)
    inside = (np.abs(p - at[0]) < size[0] / 2) & (np.abs(q - at[1]) < size[1] / 2)
    return window, inside & (np.abs(p) < footprint.length / 2) & (np.abs(q) < footprint.width / 2)


def _park_car(site: _Site, roads: list[_Road]) -> None:
    """Park a car at the side of a road, where there is room for it."""
    ground, rng = site.ground, site.rng
    rows, cols = ground.heights.shape
    for _ in range(TRIES_PER_OBJECT):
        road = roads[rng.integers(len(roads))]
        along = rng.uniform(0.0, (rows if road.is_north_south else cols) * ground.step)
        across = float(road.middle(np.array(along))) + rng.choice([-1.0, 1.0]) * (road.half - 1.15)
        x, y = (across, along) if road.is_north_south else (along, across)
        turned = road.direction(along) + (np.pi if rng.random() < 0.5 else 0.0)
        footprint = Footprint(x, y, turned, CAR_PROFILE[-1][0] - CAR_PROFILE[0][0], CAR_WIDTH_M)
        window = site.free(footprint, 0.3, PAINT + 1)
        if window is None:
            continue
        p, q = footprint.axes(ground, window)
        inside = (np.abs(p) < footprint.length / 2) & (np.abs(q) < footprint.width / 2)
        at, up = np.array(CAR_PROFILE).T
        foot = float(np.median(ground.heights[window][inside]))
        ground.heights[window][inside] = foot + np.interp(p, at, up)[inside]
        slope = (np.interp(p + 0.02, at, up) - np.interp(p - 0.02, at, up)) / 0.04 * ground.step
        direction = np.array([np.cos(turned), np.sin(turned)])
        ground.slopes[window][inside] = slope[inside][:, None] * direction
        albedo, colour = CAR_PAINTS[rng.integers(len(CAR_PAINTS))]
        ground.material[window][inside] = site.add(plain_material(CAR, PATTERN_GRAIN, albedo, 0.01), colour)
        glass = inside & np.logical_or.reduce([(p > low) & (p < high) for low, high in CAR_GLASS])
        glass &= np.abs(q) < CAR_WIDTH_M / 2 - 0.15
        ground.material[window][glass] = site.add(plain_material(CAR, PATTERN_GRAIN, 0.05, 0.01), (0.9, 1.0, 1.15))
        return


def _plant_tree(site: _Site) -> None:
    """Plant a tree or a bush, where its middle has room. Crowns may touch each other and overhang roads."""
    ground, rng = site.ground, site.rng
    for _ in range(TRIES_PER_OBJECT):
        crown: Crown = drawn_crown(rng)
        x, y = site.somewhere()
        footprint = Footprint(x, y, 0.0, 2 * crown.radius_m, 2 * crown.radius_m)
        window = footprint.window(ground, 0.0)
        stem = site.free(Footprint(x, y, 0.0, 0.6, 0.6), 0.0)
        if window is None or stem is None or (ground.material[window] >= FIRST_LEAVES + len(LEAVES)).any():
            continue
        p, q = footprint.axes(ground, window)
        foot = float(np.median(ground.heights[stem]))
        tops = foot + crown_tops(crown, p, q, ground.step, rng)
        higher = tops > ground.heights[window] + 0.2
        ground.heights[window][higher] = tops[higher]
        ground.slopes[window][higher] = 0.0
        ground.material[window][higher] = FIRST_LEAVES + rng.integers(len(LEAVES))
        return


def _lay_targets(site: _Site, settlement: Settlement) -> FloatArray:
    """Paint targets, white discs on black ones, on open gardens and roads, and return their centres (n, 3) m."""
    ground, px = site.ground, settlement.target_px_m
    white, black = (site.add(plain_material(ROAD, PATTERN_GRAIN, albedo, 0.0), GREY) for albedo in (0.62, 0.05))
    centres = []
    for _ in range(settlement.n_targets):
        for _ in range(10 * TRIES_PER_OBJECT):
            row, col = (int(n * site.rng.uniform(*TARGET_AREA)) for n in ground.heights.shape)
            x, y = (col + 0.5) * ground.step, (row + 0.5) * ground.step
            room = max(TARGET_ROOM_M, (TARGET_BLACK_PX + 1.0) * px)
            window = site.free(Footprint(x, y, 0.0, 0.0, 0.0), room, PAINT)
            if window is None:
                continue
            p, q = Footprint(x, y, 0.0, 0.0, 0.0).axes(ground, window)
            far = np.hypot(p, q)
            ground.material[window][far <= TARGET_BLACK_PX * px] = black
            ground.material[window][far <= TARGET_WHITE_PX * px] = white
            centres.append((ground.x0 + x, ground.y0 - y, float(ground.heights[row, col])))
            break
    return np.array(centres, float).reshape(-1, 3)


def _roughen(site: _Site) -> None:
    """Move the heights of cells of gardens at random, each by the roughness of its material."""
    ground = site.ground
    rough = np.zeros(len(site.materials), np.float32)
    rough[:N_GARDENS] = [garden.rough_m for garden in GARDENS]
    for first in range(0, len(ground.heights), ROWS_AT_ONCE):
        part = slice(first, first + ROWS_AT_ONCE)
        sigma = rough[ground.material[part]]
        ground.heights[part] += sigma * site.rng.standard_normal(sigma.shape, dtype=np.float32)
