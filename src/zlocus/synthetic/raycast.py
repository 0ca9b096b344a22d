"""Kernels that follow rays through a height field of small planes (see `terrain`) and say what they see.

Field coordinates: u (columns) and v (rows) in cells from the upper left corner of cell [0, 0], z in metres.
`field` is the tuple (planes, block_tops) of a `SyntheticGround`; `look` is (material, materials, textures, lit), with
lit from `sunlit_cells`. Both are read-only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.jit import kernel
from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.terrain import (
    BLOCK,
    BUILDING,
    PATTERN_LEAVES,
    PATTERN_NATURAL,
    PATTERN_ROWS,
    PATTERN_STRIPES,
    TREE,
)
from zlocus.synthetic.textures import FRACTAL, GRASS, GRAVEL

Field = tuple[NDArray[np.float32], NDArray[np.float32]]
Look = tuple[NDArray[np.uint16], NDArray[np.void], NDArray[np.float32], NDArray[np.bool_]]
MISS, TOP, WALL_U, WALL_V = 0, 1, 2, 3
SKY = 0.27
WEEDS = 0.15  # of natural texture in crops, beside rows of amplitude 1
# Of natural ground, finer than a pixel: the rays of another view meet other grains.
GRAIN = 0.5
NEVER = 1e-30
OFF_SURFACE_M = 0.02
OFF_WALL_CELLS = 1.5


# (6 x f8), f8, i8, i8, i8 -> (i8, i8, i8, i8)
@kernel
def leave_block(ray, t, block_i, block_j, across):
    """The cell that a ray enters where it leaves a block at t, across u or v (WALL_U, WALL_V), and the one before."""
    u, v, _, du, dv, _ = ray
    if across == WALL_U:
        before_i = min(max(int(np.floor(v + dv * t)), block_i * BLOCK), block_i * BLOCK + BLOCK - 1)
        before_j = block_j * BLOCK + (BLOCK - 1 if du > 0.0 else 0)
        return before_i, before_j + (1 if du > 0.0 else -1), before_i, before_j
    before_j = min(max(int(np.floor(u + du * t)), block_j * BLOCK), block_j * BLOCK + BLOCK - 1)
    before_i = block_i * BLOCK + (BLOCK - 1 if dv > 0.0 else 0)
    return before_i + (1 if dv > 0.0 else -1), before_j, before_i, before_j


# (6 x f8), i8, i8, field -> (i8, f8, i8, i8, i8, i8)
@kernel
def march(ray, i, j, field):
    """First surface that a ray meets, from cell [i, j] where it starts above the surface.

    ray : (u, v, z, du, dv, dz); the ray is start + t * step for t in [0, 1]. Returns what is met (MISS, TOP of a cell,
    WALL_U or WALL_V: the side of a cell across u or v), t, the cell [i, j], and the cell before it.

    Blocks whose tops are all below the ray are stepped over at once; in the others the ray goes from cell to cell
    (Amanatides & Woo, 1987).
    """
    u, v, z, du, dv, dz = ray
    planes, block_tops = field
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
                return MISS, 1.0, i, j, i, j
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
                return entered, t, i, j, before_i, before_j
            above_end = above_0 + end * above_t
            if above > 0.0 and above_end <= 0.0:
                return TOP, t + (end - t) * above / (above - above_end), i, j, i, j
            if end >= 1.0:
                return MISS, 1.0, i, j, i, j
            t = end
            is_first = False
            before_i, before_j = i, j
            if cell_u <= cell_v:
                j += step_j
                entered = WALL_U
            else:
                i += step_i
                entered = WALL_V
    return MISS, 1.0, i, j, before_i, before_j


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


# (i8, f8, i8, i8, i8, i8), (6 x f8), field, look, (6 x f8) -> f8
@kernel
def radiance(hit, ray, field, look, light):
    """What a ray sees where it hit, in [0, 1] or so: albedo times sky light plus, where the sun reaches, sun light.

    Shadows on tops are those of the cell's middle; on walls they are followed from the very point.

    light : (sun_u, sun_v, sun_z, step, texel, highest): unit vector to the sun (east, south, up), m per cell, m per
    texel, and a height above everything.
    """
    kind, t, i, j, before_i, before_j = hit
    sun_u, sun_v, sun_z, step, texel_m, _ = light
    material = look[1][look[0][i, j]]
    u, v, z = ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5]
    x, y = u * step, v * step
    is_side = kind != TOP and (material.kind == BUILDING or material.kind == TREE)
    if is_side and material.kind == BUILDING:
        albedo, east, south = wall_of_building(x, y, z, material)
        cosine = sun_u * east + sun_v * south
        u += OFF_WALL_CELLS * east
        v += OFF_WALL_CELLS * south
        before_i, before_j = int(np.floor(v)), int(np.floor(u))
    else:
        albedo = top_albedo(x, y, texel_m, material, look[2])
        if is_side:
            side = -sun_u * np.sign(ray[3]) if kind == WALL_U else -sun_v * np.sign(ray[4])
            cosine = 0.5 * (side + sun_z)
        else:
            by_col, by_row = field[0][i, j, 1] / step, field[0][i, j, 2] / step
            cosine = (sun_z - sun_u * by_col - sun_v * by_row) / np.sqrt(1.0 + by_col**2 + by_row**2)
    if cosine <= 0.0:
        return SKY * albedo
    is_lit = not is_shaded(u, v, z, before_i, before_j, field, light) if is_side else look[3][i, j]
    return albedo * (SKY + cosine) if is_lit else albedo * SKY


# 3 x f8, i8, i8, field, (6 x f8) -> b1
@kernel
def is_shaded(u, v, z, i, j, field, light):
    """Whether anything stands between a point, above cell [i, j], and the sun."""
    sun_u, sun_v, sun_z, step, _, highest = light
    reach = highest - z
    if reach <= 0.0:
        return False
    run = reach / sun_z / step
    return march((u, v, z, sun_u * run, sun_v * run, reach), i, j, field)[0] != MISS


# i8, field, (6 x f8), (r,c) b1 -> none
@kernel
def sunlit_cells(first_row: int, field: Field, light: tuple[float, ...], out: NDArray[np.bool_]) -> None:
    """Fills `out` (r, c) bool, the field's rows from `first_row` on: whether nothing stands between the middle of a
    cell and the sun."""
    planes = field[0]
    for i in range(out.shape[0]):
        row = first_row + i
        for j in range(out.shape[1]):
            out[i, j] = not is_shaded(j + 0.5, row + 0.5, planes[row, j, 0] + OFF_SURFACE_M, row, j, field, light)


# (n,6) f8, field -> (n,) i8, (n,3) f8
@kernel
def cast_rays(rays: FloatArray, field: Field) -> tuple[NDArray[np.int64], FloatArray]:
    """What rays meet (MISS, TOP, WALL_U, WALL_V) and where: (u, v, z).

    rays : see `march`; all start above the field.
    """
    kinds = np.zeros(len(rays), np.int64)
    places = np.full((len(rays), 3), np.nan)
    for n in range(len(rays)):
        ray = (rays[n, 0], rays[n, 1], rays[n, 2], rays[n, 3], rays[n, 4], rays[n, 5])
        kind, t, _, _, _, _ = march(ray, int(np.floor(ray[1])), int(np.floor(ray[0])), field)
        kinds[n] = kind
        if kind != MISS:
            places[n, 0], places[n, 1], places[n, 2] = ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5]
    return kinds, places


# i8, (a,b,4) f8, (f8, f8, f8, i8), field, look, (6 x f8), (r,c) f4 -> none
@kernel
def render_rows(
    first_row: int,
    table: FloatArray,
    sampling: tuple[float, float, float, int],
    field: Field,
    look: Look,
    light: tuple[float, ...],
    out: NDArray[np.float32],
) -> None:
    """Fills `out` (r, c) float32, the image's rows from `first_row` on, with the mean radiance of samples x samples
    rays per pixel; 0 where one of them leaves the field.

    table : (u, v) at the upper and at the lower height, at image positions (-1 + b * spacing, -1 + a * spacing).
    sampling : (spacing px, upper m, lower m, samples).
    """
    spacing, upper, lower, samples = sampling
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
                ray = (u0, v0, upper, u1 - u0, v1 - v0, lower - upper)
                hit = march(ray, int(np.floor(v0)), int(np.floor(u0)), field)
                if hit[0] == MISS:
                    is_whole = False
                    break
                total += radiance(hit, ray, field, look, light)
            out[row, col] = total / (samples * samples) if is_whole else 0.0
