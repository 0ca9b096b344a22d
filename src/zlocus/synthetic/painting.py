"""Cover that is painted onto the ground of a rendered scene: water, roads, fields, greenhouses, snow, plain areas.

Positions are metres east (x) and south (y) of the upper left corner of the height field.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.objects import BARE, Footprint
from zlocus.synthetic.terrain import (
    BUILDING,
    FIELD,
    GROUND,
    MATERIAL,
    PATTERN_GLITTER,
    PATTERN_GRAIN,
    PATTERN_NATURAL,
    PATTERN_ROWS,
    PATTERN_STRIPES,
    PATTERN_WAVES,
    ROAD,
    WATER,
    SyntheticGround,
    plain_material,
)

BoolArray = NDArray[np.bool_]
# Heights within a lake are those of its rim at this percentile, less its bank.
RIM_PERCENTILE, BANK_M = 2.0, 0.3
LANE_SPACING_M = 2.0
GREENHOUSE_BAY_M, GREENHOUSE_EAVE_M, GREENHOUSE_RISE_M = 3.7, 3.0, 1.2


@dataclass(frozen=True)
class TruthArea:
    """The area with truth. x, y : of its corner, m from the corner of the height field; side_m : its side."""

    x: float
    y: float
    side_m: float

    @property
    def middle(self) -> tuple[float, float]:
        """The middle of the area, m."""
        return self.x + self.side_m / 2, self.y + self.side_m / 2

    def place(self, rng: np.random.Generator, margin_m: float) -> tuple[float, float]:
        """A random place inside, away from its border, m."""
        x, y = rng.uniform(margin_m, self.side_m - margin_m, 2)
        return self.x + float(x), self.y + float(y)


@dataclass
class Painter:
    """A ground that is painted in place, and the materials that it has by now."""

    ground: SyntheticGround
    materials: list[NDArray[np.void]]
    lanes: list[FloatArray] = field(default_factory=list)

    @classmethod
    def on(cls, ground: SyntheticGround) -> Painter:
        """A painter of a copy of the ground."""
        copied = replace(ground, planes=ground.planes.copy(), material=ground.material.copy())
        return cls(copied, list(ground.materials), [ground.lanes])

    def painted(self) -> SyntheticGround:
        """The ground with all that was painted."""
        return replace(self.ground, materials=np.array(self.materials, MATERIAL), lanes=np.concatenate(self.lanes))

    def add(self, material: NDArray[np.void]) -> int:
        """Index of a new material."""
        self.materials.append(material)
        return len(self.materials) - 1

    def cover(self, where: BoolArray, material: NDArray[np.void]) -> None:
        """Give cells a new material. where : (r, c) bool."""
        self.ground.material[where] = self.add(material)

    def x(self) -> FloatArray:
        """Eastings (1, c) of the cells, m from the corner."""
        return np.asarray((np.arange(self.ground.heights.shape[1]) + 0.5)[None, :] * self.ground.step, np.float64)

    def y(self) -> FloatArray:
        """Southings (r, 1) of the cells, m from the corner."""
        return np.asarray((np.arange(self.ground.heights.shape[0]) + 0.5)[:, None] * self.ground.step, np.float64)

    def disc(self, x: float, y: float, radius_m: float) -> BoolArray:
        """Cells of a disc, (r, c) bool."""
        return np.asarray((self.x() - x) ** 2 + (self.y() - y) ** 2 < radius_m**2)

    def axes(self, footprint: Footprint) -> tuple[FloatArray, FloatArray]:
        """Distances (r, c) m of all cells from the centre of a footprint, along its length and along its width."""
        rows, cols = self.ground.heights.shape
        return footprint.axes(self.ground, (slice(0, rows), slice(0, cols)))

    def rectangle(self, footprint: Footprint) -> BoolArray:
        """Cells of a footprint, (r, c) bool."""
        p, q = self.axes(footprint)
        return np.asarray((np.abs(p) < footprint.length / 2) & (np.abs(q) < footprint.width / 2))

    def level(self, where: BoolArray, height_m: float) -> None:
        """Make cells horizontal at one height."""
        self.ground.heights[where] = height_m
        self.ground.slopes[where] = 0.0

    def clear(self, where: BoolArray) -> None:
        """Take all objects from cells: what is not bare gets the height of the nearest bare cell."""
        bare = self.ground.material == BARE
        nearest = distance_transform_edt(~bare, return_distances=False, return_indices=True)
        planes = self.ground.planes[tuple(nearest)]
        self.ground.planes[where] = planes[where]
        self.ground.material[where] = BARE

    def is_bare(self, where: BoolArray) -> BoolArray:
        """Those of the cells that are bare, (r, c) bool."""
        return np.asarray(where & (self.ground.material == BARE))

    def lake(self, where: BoolArray, material: NDArray[np.void]) -> None:
        """Turn cells into a horizontal lake below its rim."""
        self.level(where, float(np.percentile(self.ground.heights[where], RIM_PERCENTILE)) - BANK_M)
        self.cover(where, material)

    def road(self, middle_x: FloatArray, width_m: float, material: NDArray[np.void]) -> None:
        """Paint a road that runs from north to south on bare ground, and record its two lanes.

        middle_x : (r,) easting of its middle line in each row, m.
        """
        where = self.is_bare(np.abs(self.x() - middle_x[:, None]) < width_m / 2)
        self.cover(where, material)
        every = max(1, round(LANE_SPACING_M / self.ground.step))
        bend = np.gradient(middle_x, self.ground.step)[::every]
        along = np.column_stack([bend, np.ones_like(bend)]) / np.hypot(bend, 1.0)[:, None]
        for side in (-0.25, 0.25):
            place = np.column_stack([middle_x[::every] + side * width_m, self.y()[::every, 0]])
            self.lanes.append(np.column_stack([place, side / abs(side) * along]))

    def road_across(self, middle_y: FloatArray, width_m: float, material: NDArray[np.void]) -> None:
        """Paint a road that runs from west to east on bare ground. middle_y : (c,) southing of its middle line, m."""
        self.cover(self.is_bare(np.abs(self.y() - middle_y[None, :]) < width_m / 2), material)

    def greenhouses(self, footprint: Footprint) -> BoolArray:
        """Build rows of joined greenhouses with glossy, even roofs, and return their cells (r, c) bool.

        The width of the footprint is divided into bays, each with a low gable.
        """
        p, q = self.axes(footprint)
        where = (np.abs(p) < footprint.length / 2) & (np.abs(q) < footprint.width / 2)
        foot = float(np.median(self.ground.heights[where]))
        across = (q + footprint.width / 2) / GREENHOUSE_BAY_M
        gable = 1.0 - np.abs(2.0 * (across - np.floor(across)) - 1.0)
        self.level(where, foot)
        self.ground.heights[where] = (foot + GREENHOUSE_EAVE_M + GREENHOUSE_RISE_M * gable)[where]
        rise = 2.0 * GREENHOUSE_RISE_M / GREENHOUSE_BAY_M * np.where(across - np.floor(across) < 0.5, 1.0, -1.0)
        by_step = rise[..., None] * (-np.sin(footprint.angle), np.cos(footprint.angle)) * self.ground.step
        self.ground.slopes[where] = by_step[where]
        glass = plain_material(BUILDING, PATTERN_GRAIN, 0.8, 0.004)
        frame = plain_material(BUILDING, PATTERN_GRAIN, 0.55, 0.004)
        for material in (glass, frame):
            material["x"], material["y"] = footprint.x, footprint.y
            material["cos"], material["sin"] = np.cos(footprint.angle), np.sin(footprint.angle)
            material["half_length"], material["half_width"] = footprint.length / 2, footprint.width / 2
            material["base"] = foot
        self.cover(where, glass)
        self.cover(where & (np.abs(across - np.rint(across)) * GREENHOUSE_BAY_M < 0.45), frame)
        return where

    def tower(self, xy: tuple[float, float], side_m: float, height_m: float) -> BoolArray:
        """Build a square tower whose flat roof is `height_m` above its foot, and return its cells (r, c) bool."""
        footprint = Footprint(*xy, 0.3, side_m, side_m)
        where = self.rectangle(footprint)
        foot = float(self.ground.heights[where].min())
        material = plain_material(BUILDING, PATTERN_NATURAL, 0.3, 0.1)
        material["x"], material["y"] = xy
        material["cos"], material["sin"] = np.cos(footprint.angle), np.sin(footprint.angle)
        material["half_length"] = material["half_width"] = side_m / 2
        material["base"], material["floor"], material["window"], material["wall"] = foot, 3.0, 2.4, 0.35
        self.level(where, foot + height_m)
        self.cover(where, material)
        return where


def water(albedo: float, contrast: float) -> NDArray[np.void]:
    """Water whose small waves look different in every image (see `appearance`)."""
    return plain_material(WATER, PATTERN_WAVES, albedo, contrast)


def glitter(albedo: float, contrast: float) -> NDArray[np.void]:
    """Water on which the sun is reflected by crests of waves, elsewhere in every image."""
    return plain_material(WATER, PATTERN_GLITTER, albedo, contrast)


def plain_road(albedo: float, contrast: float = 0.004) -> NDArray[np.void]:
    """A road whose texture is below the noise of usual images."""
    return plain_material(ROAD, PATTERN_GRAIN, albedo, contrast)


def plain_ground(albedo: float, contrast: float = 0.003) -> NDArray[np.void]:
    """Ground without texture: concrete, sand or snow."""
    return plain_material(GROUND, PATTERN_GRAIN, albedo, contrast)


def crops(footprint: Footprint, period_m: float, albedo: float, contrast: float) -> NDArray[np.void]:
    """Crops in rows along the length of a footprint, `period_m` apart."""
    material = plain_material(FIELD, PATTERN_ROWS, albedo, contrast)
    material["cos"], material["sin"], material["period"] = np.cos(footprint.angle), np.sin(footprint.angle), period_m
    material["x"], material["y"] = footprint.x, footprint.y
    return material


def striped(material: NDArray[np.void]) -> NDArray[np.void]:
    """The material with even stripes in place of its pattern, so that nothing tells one period from the next."""
    changed = material.copy()
    changed["pattern"] = PATTERN_STRIPES
    return changed
