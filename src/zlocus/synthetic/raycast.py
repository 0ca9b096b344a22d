"""Kernels that follow rays through a height field of small planes (see `terrain`) and compute their radiance.

Field coordinates: u (columns) and v (rows) in cells from the upper left corner of cell [0, 0], z in metres.
All records are read-only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.jit import kernel
from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.terrain import (
    BLOCK,
    BUILDING,
    PATTERN_FOLIAGE,
    PATTERN_GLITTER,
    PATTERN_LEAVES,
    PATTERN_NATURAL,
    PATTERN_ROWS,
    PATTERN_STRIPES,
    PATTERN_WAVES,
    TREE,
)
from zlocus.synthetic.textures import FRACTAL, GRASS, GRAVEL

MISS, TOP, WALL_U, WALL_V = 0, 1, 2, 3
SKY = 0.27
WEEDS = 0.15  # amplitude of natural texture in crops, where that of the rows is 1
# Amplitude of a texture finer than a pixel on natural ground, so that rays of different images meet different grains.
GRAIN = 0.5
# A crest of a wave reflects the sun where the texture is higher than this (standard deviations).
GLITTER_CREST = 1.3
# Amplitude of leaves that flutter and glint, where that of the leaves that stay is 1.
FLUTTER = 3.2
NEVER = 1e-30
OFF_SURFACE_M = 0.02
OFF_WALL_CELLS = 1.5


class HeightField(NamedTuple):
    """The surface of a `SyntheticGround`."""

    planes: NDArray[np.float32]  # (r,c,3) f4: height at the cell's centre, slopes per cell to the next column and row
    block_tops: NDArray[np.float32]  # (br,bc) f4: upper bound of the planes in each block, m


class Appearance(NamedTuple):
    """What the cells of a `SyntheticGround` look like."""

    material: NDArray[np.uint16]  # (r,c) u2: index into materials
    materials: NDArray[np.void]  # (m,) MATERIAL
    textures: NDArray[np.float32]  # (3,t,t) f4: see `natural_textures`
    lit: NDArray[np.bool_]  # (r,c) b1: whether the sun lights the centre of a cell, see `sunlit_cells`


class Light(NamedTuple):
    """The sun, and the units of the field."""

    sun_u: float  # f8: unit vector to the sun: east,
    sun_v: float  # f8: south
    sun_z: float  # f8: and up
    step: float  # f8: m per cell
    texel_m: float  # f8: m per texel
    highest: float  # f8: a height above all of the field, m


class Ray(NamedTuple):
    """The points start + t * step for t in [0, 1], in field coordinates."""

    u: float  # f8: start
    v: float  # f8
    z: float  # f8
    du: float  # f8: step
    dv: float  # f8
    dz: float  # f8


class Hit(NamedTuple):
    """The first surface that a ray meets."""

    kind: int  # i8: MISS, TOP of a cell, WALL_U or WALL_V: the side of a cell across u or v
    t: float  # f8: parameter of the ray
    i: int  # i8: row of the cell
    j: int  # i8: and column
    before_i: int  # i8: row of the cell before it on the ray
    before_j: int  # i8: and column


class Sampling(NamedTuple):
    """How rays are taken from a table; see `render_rows`."""

    spacing: float  # f8: px between nodes of the table
    upper: float  # f8: height of the starts of rays, m
    lower: float  # f8: height of their ends, m
    samples: int  # i8: rays per pixel and axis


# Ray, f8, i8, i8, i8 -> (i8, i8, i8, i8)
@kernel
def leave_block(ray, t, block_i, block_j, across):
    """The cell that a ray enters when it leaves a block, and the cell before: (i, j, before_i, before_j).

    t : parameter of the ray there; across : the side through which it leaves, across u or v (WALL_U, WALL_V).
    """
    u, v, du, dv = ray.u, ray.v, ray.du, ray.dv
    if across == WALL_U:
        before_i = min(max(int(np.floor(v + dv * t)), block_i * BLOCK), block_i * BLOCK + BLOCK - 1)
        before_j = block_j * BLOCK + (BLOCK - 1 if du > 0.0 else 0)
        return before_i, before_j + (1 if du > 0.0 else -1), before_i, before_j
    before_j = min(max(int(np.floor(u + du * t)), block_j * BLOCK), block_j * BLOCK + BLOCK - 1)
    before_i = block_i * BLOCK + (BLOCK - 1 if dv > 0.0 else 0)
    return before_i + (1 if dv > 0.0 else -1), before_j, before_i, before_j


# Ray, i8, i8, HeightField -> Hit
@kernel
def march(ray, i, j, field):
    """The first surface that a ray meets. It starts in cell [i, j], above the surface.

    Blocks whose tops are all below the ray are crossed in one step. In other blocks the ray goes from cell to cell
    (Amanatides & Woo, 1987).
    """
    u, v, z, du, dv, dz = ray.u, ray.v, ray.z, ray.du, ray.dv, ray.dz
    planes, block_tops = field.planes, field.block_tops
    rows, cols = planes.shape[0], planes.shape[1]
    step_j, ahead_j, per_u = (1, 1, 1.0 / du) if du > 0.0 else (-1, 0, 1.0 / min(du, -NEVER))
    step_i, ahead_i, per_v = (1, 1, 1.0 / dv) if dv > 0.0 else (-1, 0, 1.0 / min(dv, -NEVER))
    t = 0.0
    is_first = True
    entered = TOP
    before_i, before_j = i, j
    while 0 <= i < rows and 0 <= j < cols:
        block_i, block_j = i // BLOCK, j // BLOCK
        block_u = ((block_j + ahead_j) * BLOCK - u) * per_u
        block_v = ((block_i + ahead_i) * BLOCK - v) * per_v
        block_end = min(block_u, block_v, 1.0)
        if z + dz * (block_end if dz < 0.0 else t) > block_tops[block_i, block_j]:
            if block_end >= 1.0:
                return Hit(MISS, 1.0, i, j, i, j)
            t = block_end
            is_first = False
            entered = WALL_U if block_u <= block_v else WALL_V
            i, j, before_i, before_j = leave_block(ray, t, block_i, block_j, entered)
            continue
        while i // BLOCK == block_i and j // BLOCK == block_j and i < rows and j < cols:
            cell_u = (j + ahead_j - u) * per_u
            cell_v = (i + ahead_i - v) * per_v
            end = max(t, min(cell_u, cell_v, 1.0))
            by_col, by_row = planes[i, j, 1], planes[i, j, 2]
            above_0 = z - planes[i, j, 0] - by_col * (u - j - 0.5) - by_row * (v - i - 0.5)
            above_t = dz - by_col * du - by_row * dv
            above = above_0 + t * above_t
            if above <= 0.0 and not is_first:
                return Hit(entered, t, i, j, before_i, before_j)
            above_end = above_0 + end * above_t
            if above > 0.0 and above_end <= 0.0:
                return Hit(TOP, t + (end - t) * above / (above - above_end), i, j, i, j)
            if end >= 1.0:
                return Hit(MISS, 1.0, i, j, i, j)
            t = end
            is_first = False
            before_i, before_j = i, j
            if cell_u <= cell_v:
                j += step_j
                entered = WALL_U
            else:
                i += step_i
                entered = WALL_V
    return Hit(MISS, 1.0, i, j, before_i, before_j)


# (t,t) f4, f8, f8 -> f8
@kernel
def _texel(texture, u, v):
    """Bilinear value of a periodic texture whose size is a power of two, at texels (u, v)."""
    mask = texture.shape[0] - 1
    j, i = int(np.floor(u)), int(np.floor(v))
    a, b = u - j, v - i
    j0, j1, i0, i1 = j & mask, (j + 1) & mask, i & mask, (i + 1) & mask
    upper = (1.0 - a) * texture[i0, j0] + a * texture[i0, j1]
    lower = (1.0 - a) * texture[i1, j0] + a * texture[i1, j1]
    return (1.0 - b) * upper + b * lower


# f8, f8, f8, () MATERIAL, (3,t,t) f4 -> f8
@kernel
def top_albedo(x, y, texel_m, material, textures):
    """Albedo of the top of a material at field position (x, y) m."""
    a, b = x / texel_m, y / texel_m
    pattern = material.pattern
    if pattern in (PATTERN_STRIPES, PATTERN_ROWS):
        q = material.cos * (y - material.y) - material.sin * (x - material.x)
        value = 1.0 if q / material.period - np.floor(q / material.period) < 0.35 else -0.5
        if pattern == PATTERN_ROWS:
            value += WEEDS * _texel(textures[GRASS], a, b)
    elif pattern == PATTERN_NATURAL:
        mixed = 0.5 + 0.9 * _texel(textures[FRACTAL], 0.0131 * a + 0.0071 * b, 0.0131 * b - 0.0071 * a)
        mixed = min(max(mixed, 0.0), 1.0)
        value = mixed * _texel(textures[GRAVEL], a, b) if mixed > 0.0 else 0.0
        if mixed < 1.0:
            value += (1.0 - mixed) * _texel(textures[GRASS], 0.96 * a - 0.28 * b, 0.96 * b + 0.28 * a)
        value += GRAIN * _texel(textures[GRASS], 5.3 * a, 5.3 * b)
        value += 0.4 * _texel(textures[FRACTAL], 0.083 * a - 0.031 * b + 71.0, 0.083 * b + 0.031 * a)
    elif pattern == PATTERN_WAVES:
        value = 0.5 * _texel(textures[FRACTAL], 0.21 * a + material.x, 0.21 * b + material.y)
        value += _texel(textures[GRASS], 1.3 * a + material.x, 1.3 * b + material.y)
    elif pattern == PATTERN_GLITTER:
        crest = _texel(textures[GRASS], 1.3 * a + material.x, 1.3 * b + material.y)
        value = crest - GLITTER_CREST if crest > GLITTER_CREST else 0.0
    elif pattern == PATTERN_FOLIAGE:
        value = _texel(textures[GRAVEL], 1.7 * a, 1.7 * b)
        value += FLUTTER * _texel(textures[GRASS], 2.3 * a + material.x, 2.3 * b + material.y)
    elif pattern == PATTERN_LEAVES:
        value = _texel(textures[GRAVEL], 1.7 * a, 1.7 * b)
    else:
        value = _texel(textures[FRACTAL], 0.7 * a, 0.7 * b)
    return max(0.03, material.albedo * (1.0 + material.contrast * value))


# 4 x f8, () MATERIAL -> (f8, f8, f8)
@kernel
def wall_of_building(x, y, z, material):
    """Albedo of a building's wall at field position (x, y) m and height z, and its outward normal (east, south)."""
    dx, dy = x - material.x, y - material.y
    p = material.cos * dx + material.sin * dy
    q = material.cos * dy - material.sin * dx
    if abs(p) - material.half_length > abs(q) - material.half_width:
        side = 1.0 if p > 0.0 else -1.0
        along, east, south = q, side * material.cos, side * material.sin
    else:
        side = 1.0 if q > 0.0 else -1.0
        along, east, south = p, -side * material.sin, side * material.cos
    albedo = material.wall
    if material.floor > 0.0:
        storey = (z - material.base) / material.floor
        bay = along / material.window
        storey -= np.floor(storey)
        bay -= np.floor(bay)
        if 0.3 < storey < 0.8 and 0.25 < bay < 0.75:
            albedo = 0.25 * material.wall
        elif storey < 0.07:
            albedo = 1.15 * material.wall
    return albedo, east, south


# Hit, Ray, HeightField, Appearance, Light -> f8
@kernel
def radiance(hit, ray, field, appearance, light):
    """Radiance along a ray, about 0 to 1: albedo times sky light, plus sun light where the point is lit.

    Shadow is tested at the cell's centre for tops, and at the point itself for walls.
    """
    t, i, j, before_i, before_j = hit.t, hit.i, hit.j, hit.before_i, hit.before_j
    sun_u, sun_v, sun_z, step = light.sun_u, light.sun_v, light.sun_z, light.step
    material = appearance.materials[appearance.material[i, j]]
    u, v, z = ray.u + t * ray.du, ray.v + t * ray.dv, ray.z + t * ray.dz
    x, y = u * step, v * step
    is_side = hit.kind != TOP and (material.kind == BUILDING or material.kind == TREE)
    if is_side and material.kind == BUILDING:
        albedo, east, south = wall_of_building(x, y, z, material)
        cosine = sun_u * east + sun_v * south
        u += OFF_WALL_CELLS * east
        v += OFF_WALL_CELLS * south
        before_i, before_j = int(np.floor(v)), int(np.floor(u))
    else:
        albedo = top_albedo(x, y, light.texel_m, material, appearance.textures)
        if is_side:
            side = -sun_u * np.sign(ray.du) if hit.kind == WALL_U else -sun_v * np.sign(ray.dv)
            cosine = 0.5 * (side + sun_z)
        else:
            by_col, by_row = field.planes[i, j, 1] / step, field.planes[i, j, 2] / step
            cosine = (sun_z - sun_u * by_col - sun_v * by_row) / np.sqrt(1.0 + by_col**2 + by_row**2)
    if cosine <= 0.0:
        return SKY * albedo
    is_lit = not is_shaded(u, v, z, before_i, before_j, field, light) if is_side else appearance.lit[i, j]
    return albedo * (SKY + cosine) if is_lit else albedo * SKY


# f8, f8, f8, i8, i8, HeightField, Light -> b1
@kernel
def is_shaded(u, v, z, i, j, field, light):
    """Whether the field blocks the sun from a point above cell [i, j]."""
    climb = light.highest - z
    if climb <= 0.0:
        return False
    run = climb / light.sun_z / light.step
    return march(Ray(u, v, z, light.sun_u * run, light.sun_v * run, climb), i, j, field).kind != MISS


# i8, HeightField, Light, (r,c) b1 -> None
@kernel
def sunlit_cells(first_row: int, field: HeightField, light: Light, out: NDArray[np.bool_]) -> None:
    """Fill `out` (r, c) bool, rows of the field from `first_row` on: whether the sun lights the centre of a cell."""
    planes = field.planes
    for i in range(out.shape[0]):
        row = first_row + i
        for j in range(out.shape[1]):
            out[i, j] = not is_shaded(j + 0.5, row + 0.5, planes[row, j, 0] + OFF_SURFACE_M, row, j, field, light)


# (n,6) f8, HeightField -> (n,) i8, (n,3) f8
@kernel
def cast_rays(rays: FloatArray, field: HeightField) -> tuple[NDArray[np.int64], FloatArray]:
    """Kinds (n,) of surface that rays meet (MISS, TOP, WALL_U, WALL_V), and the points (n, 3) u, v, z; NaN for MISS.

    rays : (n, 6), see `march`; all start above the field.
    """
    kinds = np.zeros(len(rays), np.int64)
    places = np.full((len(rays), 3), np.nan)
    for n in range(len(rays)):
        ray = Ray(rays[n, 0], rays[n, 1], rays[n, 2], rays[n, 3], rays[n, 4], rays[n, 5])
        hit = march(ray, int(np.floor(ray.v)), int(np.floor(ray.u)), field)
        kinds[n] = hit.kind
        if hit.kind != MISS:
            t = hit.t
            places[n, 0], places[n, 1], places[n, 2] = ray.u + t * ray.du, ray.v + t * ray.dv, ray.z + t * ray.dz
    return kinds, places


# i8, (a,b,4) f8, Sampling, HeightField, Appearance, Light, (r,c) f4 -> None
@kernel
def render_rows(
    first_row: int,
    table: FloatArray,
    sampling: Sampling,
    field: HeightField,
    appearance: Appearance,
    light: Light,
    out: NDArray[np.float32],
) -> None:
    """Fill `out` (r, c) float32, rows of the image from `first_row` on, with the radiance of pixels.

    It is the mean of samples x samples rays per pixel; 0 where one of them leaves the field.

    table : (u, v) at the upper and at the lower height, at image positions (-1 + b * spacing, -1 + a * spacing).
    """
    spacing, upper, lower, samples = sampling.spacing, sampling.upper, sampling.lower, sampling.samples
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            total = 0.0
            is_whole = True
            for sample in range(samples * samples):
                at_row = (first_row + row + (sample // samples + 0.5) / samples + 0.5) / spacing
                at_col = (col + (sample % samples + 0.5) / samples + 0.5) / spacing
                a, b = int(at_row), int(at_col)
                p, q = at_row - a, at_col - b
                near, far, left, right = (1.0 - p), p, (1.0 - q), q
                u0 = near * (left * table[a, b, 0] + right * table[a, b + 1, 0])
                u0 += far * (left * table[a + 1, b, 0] + right * table[a + 1, b + 1, 0])
                v0 = near * (left * table[a, b, 1] + right * table[a, b + 1, 1])
                v0 += far * (left * table[a + 1, b, 1] + right * table[a + 1, b + 1, 1])
                u1 = near * (left * table[a, b, 2] + right * table[a, b + 1, 2])
                u1 += far * (left * table[a + 1, b, 2] + right * table[a + 1, b + 1, 2])
                v1 = near * (left * table[a, b, 3] + right * table[a, b + 1, 3])
                v1 += far * (left * table[a + 1, b, 3] + right * table[a + 1, b + 1, 3])
                ray = Ray(u0, v0, upper, u1 - u0, v1 - v0, lower - upper)
                hit = march(ray, int(np.floor(v0)), int(np.floor(u0)), field)
                if hit.kind == MISS:
                    is_whole = False
                    break
                total += radiance(hit, ray, field, appearance, light)
            out[row, col] = total / (samples * samples) if is_whole else 0.0
