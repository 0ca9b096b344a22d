"""The ground of a rendered scene: a height field of small planes, the material of each cell, and analytic shapes.

Each cell is a plane through the height of its centre, and neighbouring cells are joined by vertical walls (of
millimetres on natural ground, of the full height at the side of a building). So the height at the centre of a cell is
exact by construction, roofs are planes, and walls are vertical. There is nothing outside the field.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from zlocus.core.errors import ConfigError
from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.textures import fractal_surface, natural_textures

GROUND, ROAD, BUILDING, TREE, WATER, FIELD = 0, 1, 2, 3, 4, 5
BLOCK = 16
TEXTURE_STREAM, TERRAIN_STREAM, OBJECT_STREAM = 1, 2, 3
ROWS_AT_ONCE = 512
ANALYTIC_KINDS = ("plane", "tilt", "step", "sphere", "sine")

MATERIAL = np.dtype(
    [
        ("kind", "i4"),  # class of the truth: GROUND, ROAD, BUILDING, TREE, WATER or FIELD
        ("pattern", "i4"),  # pattern of the top: one of the PATTERN_ constants
        ("albedo", "f8"),
        ("contrast", "f8"),  # contrast of the pattern, relative to the albedo
        ("period", "f8"),  # period of stripes and rows, m
        # m, centre of a building, corner of a crop, in field coordinates (east and south of the field's); texels, waves
        ("x", "f8"),
        ("y", "f8"),
        ("cos", "f8"),  # direction of a building's first axis, of rows
        ("sin", "f8"),
        ("half_length", "f8"),  # m, along the first axis
        ("half_width", "f8"),
        ("base", "f8"),  # m, ellipsoidal height of the lowest floor
        ("wall", "f8"),  # albedo of the walls
        ("floor", "f8"),  # m, height of a floor; 0: no windows
        ("window", "f8"),  # m, distance between windows
    ]
)
PATTERN_NATURAL, PATTERN_GRAIN, PATTERN_STRIPES, PATTERN_LEAVES, PATTERN_ROWS = 0, 1, 2, 3, 4
PATTERN_WAVES, PATTERN_GLITTER, PATTERN_FOLIAGE = 5, 6, 7
# Patterns that look different in every image.
MOVING_PATTERNS = (PATTERN_WAVES, PATTERN_GLITTER, PATTERN_FOLIAGE)
NO_LANES = np.zeros((0, 4))


@dataclass(frozen=True)
class SyntheticGround:
    """A height field and its materials.

    x0, y0 : easting and northing (m) of the upper left corner of cell [0, 0]; step : m.
    planes : (r, c, 3) float32: ellipsoidal height (m) at the cell's centre, slope towards the next column and towards
    the next row (m per cell). material : (r, c) uint16, index into materials : (m,) of dtype MATERIAL.
    textures : (3, t, t) float32, see `natural_textures`; texel_m : size of a texel.
    lanes : (n, 4) m, places on roads where cars can drive, east and south of the corner of cell [0, 0], and the unit
    vector along the road, east and south. marked : (r, c) bool, cells of a painted trouble, None where there is none.
    """

    x0: float
    y0: float
    step: float
    planes: NDArray[np.float32]
    material: NDArray[np.uint16]
    materials: NDArray[np.void]
    textures: NDArray[np.float32]
    texel_m: float
    lanes: NDArray[np.float64] = field(default_factory=NO_LANES.copy)
    marked: NDArray[np.bool_] | None = None

    @property
    def heights(self) -> NDArray[np.float32]:
        """(r, c) float32, ellipsoidal m, at the cells' centres."""
        return self.planes[..., 0]

    @property
    def slopes(self) -> NDArray[np.float32]:
        """(r, c, 2) float32, m per cell towards the next column and towards the next row."""
        return self.planes[..., 1:]

    @cached_property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest height of a cell centre, m."""
        return float(self.heights.min()), float(self.heights.max())

    @cached_property
    def classes(self) -> NDArray[np.uint8]:
        """(r, c) uint8: 0 ground, 1 road, 2 building, 3 tree, 4 water, 5 field."""
        return np.asarray(self.materials["kind"].astype(np.uint8)[self.material])

    @cached_property
    def block_tops(self) -> NDArray[np.float32]:
        """Upper bound (br, bc) float32 m of the planes in each block of BLOCK x BLOCK cells."""
        top = self.heights + 0.5 * (np.abs(self.slopes[..., 0]) + np.abs(self.slopes[..., 1]))
        rows, cols = (-(-n // BLOCK) for n in top.shape)
        padded = np.full((rows * BLOCK, cols * BLOCK), -np.inf, np.float32)
        padded[: top.shape[0], : top.shape[1]] = top
        return np.asarray(padded.reshape(rows, BLOCK, cols, BLOCK).max(axis=(1, 3)))

    def cells(self, west: float, north: float, shape: tuple[int, int]) -> tuple[slice, slice]:
        """The rows and columns of a part of `shape` whose upper left corner is at (west, north) m."""
        row, col = round((self.y0 - north) / self.step), round((west - self.x0) / self.step)
        return slice(row, row + shape[0]), slice(col, col + shape[1])


@dataclass(frozen=True)
class RoundHill:
    """A hill with the shape of a Gaussian. x, y : easting and northing of its top, m; radius_m : standard deviation."""

    x: float
    y: float
    radius_m: float
    height_m: float


@dataclass(frozen=True)
class Relief:
    """The shape of bare terrain.

    base_m : lowest height; relief_m : difference from the lowest to the highest, without the hill; longest_m : longest
    wavelength; roughness : exponent with which the amplitude falls for shorter wavelengths; hill : added on top.
    """

    base_m: float
    relief_m: float
    longest_m: float
    roughness: float
    hill: RoundHill | None = None


def natural_ground(
    seed: int, origin: tuple[float, float], step: float, shape: tuple[int, int], relief: Relief, texel_m: float
) -> SyntheticGround:
    """Bare terrain in which every cell has material 0. The same arguments give the same bytes.

    origin : easting and northing of the upper left corner, m; step : side of a cell, m; shape : rows and columns;
    texel_m : side of a texel of the natural textures.
    """
    node = 8 * step
    nodes = (-(-shape[0] // 8) + 4, -(-shape[1] // 8) + 4)
    rng = np.random.default_rng([seed, TERRAIN_STREAM])
    z = fractal_surface(rng, nodes, node, relief.longest_m, relief.roughness).astype(np.float64)
    z = relief.base_m + relief.relief_m * (z - z.min()) / (z.max() - z.min())
    at_row, at_col = ((np.arange(n) - 2 + 0.5) * 8 - 0.5 for n in nodes)
    if (hill := relief.hill) is not None:
        dx = origin[0] + (at_col + 0.5) * step - hill.x
        dy = origin[1] - (at_row + 0.5) * step - hill.y
        z += hill.height_m * np.exp(-0.5 * (dy[:, None] ** 2 + dx[None, :] ** 2) / hill.radius_m**2)
    spline = RectBivariateSpline(at_row, at_col, z)
    planes = np.empty((*shape, 3), np.float32)
    cols = np.arange(shape[1])
    for first in range(0, shape[0], ROWS_AT_ONCE):
        rows = np.arange(first, min(first + ROWS_AT_ONCE, shape[0]))
        for k, (by_row, by_col) in enumerate(((0, 0), (0, 1), (1, 0))):
            planes[rows, :, k] = spline(rows, cols, dx=by_row, dy=by_col)
    textures = natural_textures(np.random.default_rng([seed, TEXTURE_STREAM]))
    return SyntheticGround(
        *origin, step, planes, np.zeros(shape, np.uint16), np.array([bare_material()]), textures, texel_m
    )


def bare_material() -> NDArray[np.void]:
    """The material of natural ground, () of dtype MATERIAL."""
    return plain_material(GROUND, PATTERN_NATURAL, albedo=0.44, contrast=0.17)


def plain_material(kind: int, pattern: int, albedo: float, contrast: float) -> NDArray[np.void]:
    """A material whose walls look like its top, () of dtype MATERIAL."""
    material = np.zeros((), MATERIAL)
    material["kind"], material["pattern"], material["albedo"], material["contrast"] = kind, pattern, albedo, contrast
    material["cos"], material["wall"] = 1.0, albedo
    return material


def analytic_height(kind: str, x: FloatArray, y: FloatArray) -> FloatArray:
    """Heights (m) of an analytic shape at offsets x, y (m) east and north of its centre. All arrays have one shape.

    plane: 50. tilt: 50 + 0.20 x - 0.15 y. step: 65 where x >= 0, else 50. sphere: the cap of a sphere of radius 60
    that rises 20 above 50. sine: 50 + 3 sin(x / 8) cos(y / 11).
    """
    if kind == "plane":
        return np.full(np.shape(x), 50.0)
    if kind == "tilt":
        return np.asarray(50.0 + 0.20 * x - 0.15 * y)
    if kind == "step":
        return np.where(np.asarray(x) >= 0.0, 65.0, 50.0)
    if kind == "sphere":
        return np.asarray(np.maximum(np.sqrt(np.maximum(3600.0 - x**2 - y**2, 0.0)) + 10.0, 50.0))
    if kind == "sine":
        return np.asarray(50.0 + 3.0 * np.sin(x / 8.0) * np.cos(y / 11.0))
    raise ConfigError(f"There is no analytic ground {kind!r}: choose one of {', '.join(ANALYTIC_KINDS)}.")


def analytic_ground(
    kind: str, centre: tuple[float, float], step: float, shape: tuple[int, int], seed: int = 0
) -> SyntheticGround:
    """The height field of `analytic_height` with natural texture. centre : easting and northing of its middle, m.

    Cells hold the exact height of their centre. Slopes are central differences over one cell, and zero on the step,
    whose wall is in the right place if the number of columns is even.
    """
    x = (np.arange(shape[1]) + 0.5 - shape[1] / 2) * step
    y = (shape[0] / 2 - 0.5 - np.arange(shape[0])) * step
    xx, yy = np.meshgrid(x, y)
    half = 0.5 * step
    heights = analytic_height(kind, xx, yy)
    slope_col = analytic_height(kind, xx + half, yy) - analytic_height(kind, xx - half, yy)
    slope_row = analytic_height(kind, xx, yy - half) - analytic_height(kind, xx, yy + half)
    if kind == "step":
        slope_col = np.zeros_like(slope_col)
    origin = (centre[0] - step * shape[1] / 2, centre[1] + step * shape[0] / 2)
    planes = np.stack([heights, slope_col, slope_row], axis=-1).astype(np.float32)
    textures = natural_textures(np.random.default_rng([seed, TEXTURE_STREAM]), 256)
    return SyntheticGround(
        *origin, step, planes, np.zeros(shape, np.uint16), np.array([bare_material()]), textures, step
    )
