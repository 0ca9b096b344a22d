"""The measure close to a surface, with windows that follow it: for heights finer than the lattice."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel
from zlocus.kernels.agreement import SLACK, add_pairs, window_moments
from zlocus.kernels.volume import HIDDEN, flat_visibility, plane_grid


# (3,8) f8, i8, i8, f8, (6,) f4 -> None
@kernel
def row_positions(grids, axis, row, origin, out):
    """x (axis 0) or y of a row of cells, px from `origin`: coefficients of 1, u, u^2 at column 0, then per column.

    grids : (3, 8), positions at u = -1, 0 and 1, see `plane_grid`.
    """
    for part in range(2):
        k = axis + 2 * part
        low = grids[0, k] + row * grids[0, k + 4]
        mid = grids[1, k] + row * grids[1, k + 4]
        high = grids[2, k] + row * grids[2, k + 4]
        out[3 * part] = mid - (origin if part == 0 else 0.0)
        out[3 * part + 1] = 0.5 * (high - low)
        out[3 * part + 2] = 0.5 * (high + low) - mid


# (c,) f4, (6,) f4, f4, f4, (c,) i4, (4,c) f4 -> None
@kernel
def spline_weights(level, line, low, high, whole, weights):
    """Whole pixel and the four cubic B-spline weights around every cell of a row, along one axis.

    level : (c,) float32, u; line : (6,), see `row_positions`; low, high : bounds of the position, px from its origin.
    """
    one, half, sixth = np.float32(1.0), np.float32(0.5), np.float32(1.0 / 6.0)
    two_thirds = np.float32(2.0 / 3.0)
    for c in range(level.shape[0]):
        u, t = level[c], np.float32(np.int32(c))
        x = (line[0] + t * line[3]) + u * ((line[1] + t * line[4]) + u * (line[2] + t * line[5]))
        x = min(max(x, low), high)
        pixel = np.floor(x)
        whole[c] = np.int32(pixel)
        f = x - pixel
        g = one - f
        weights[0, c] = g * g * g * sixth
        weights[1, c] = two_thirds - f * f * (one - half * f)
        weights[2, c] = two_thirds - g * g * (one - half * g)
        weights[3, c] = f * f * f * sixth


# (p,) f4, i4, i4, (2,c) i4, (4,c) f4, (4,c) f4, (c,) f4 -> None
@kernel
def spline_gather(image, origin, n_cols, whole, across, down, out):
    """Weighted sums of 4 x 4 pixels for every cell of a row.

    origin : index in `image` of the first of the sixteen where `whole`, (2, c) columns and rows, is zero.
    """
    stride, one, two, three = np.uint32(n_cols), np.uint32(1), np.uint32(2), np.uint32(3)
    for c in range(out.shape[0]):
        p = np.uint32(np.int32(whole[1, c] * n_cols) + whole[0, c] + origin)
        q = np.uint32(p + stride)
        r = np.uint32(q + stride)
        s = np.uint32(r + stride)
        w0, w1, w2, w3 = across[0, c], across[1, c], across[2, c], across[3, c]
        top = (w0 * image[p] + w1 * image[p + one]) + (w2 * image[p + two] + w3 * image[p + three])
        high = (w0 * image[q] + w1 * image[q + one]) + (w2 * image[q + two] + w3 * image[q + three])
        low = (w0 * image[r] + w1 * image[r + one]) + (w2 * image[r + two] + w3 * image[r + three])
        end = (w0 * image[s] + w1 * image[s + one]) + (w2 * image[s + two] + w3 * image[s + three])
        out[c] = (down[0, c] * top + down[1, c] * high) + (down[2, c] * low + down[3, c] * end)


# (p,) f4, (3,) i8, (3,8) f8, (r,c) f4, (r,c) f4 -> None
@kernel
def resample_surface(pixels, layout, grids, level, out):
    """Cubic B-spline image values on a grid of cells, each at a height of its own.

    pixels : (p,) float32 B-spline coefficients; grids : (3, 8) positions at levels -1, 0 and 1 (see `plane_grid`);
    level : (r, c) float32 in [-1, 1]: positions are quadratic in it; out : (r, c). Positions are float32 from a
    whole-pixel origin near the grid; the passes of a row that find them vectorise.
    """
    base, n_rows, n_cols = layout[0], layout[1], layout[2]
    image = pixels[base : base + n_rows * n_cols]
    width = out.shape[1]
    x0 = min(max(int(grids[1, 0]), 1), n_cols - 4)
    y0 = min(max(int(grids[1, 1]), 1), n_rows - 4)
    x_low, x_high = np.float32(1 - x0), np.float32(n_cols - 3.01 - x0)
    y_low, y_high = np.float32(1 - y0), np.float32(n_rows - 3.01 - y0)
    origin = np.int32((y0 - 1) * n_cols + x0 - 1)
    line, whole = np.empty(6, np.float32), np.empty((2, width), np.int32)
    across, down = np.empty((4, width), np.float32), np.empty((4, width), np.float32)
    for r in range(out.shape[0]):
        row_positions(grids, 0, r, float(x0), line)
        spline_weights(level[r], line, x_low, x_high, whole[0], across)
        row_positions(grids, 1, r, float(y0), line)
        spline_weights(level[r], line, y_low, y_high, whole[1], down)
        spline_gather(image, origin, np.int32(n_cols), whole, across, down, out[r])


# (p,) f4, (i,3) i8, (i,2,2,2,4) f8, (2,) f8, (r,c) f4, (j,) f4, i8, i8, (3,i,r,c) i4, f4, (g,j,r,c) f4 -> None
@kernel
def block_profile(pixels, layout, nodes, heights, surface, offsets, block, half, seen, floor, out):
    """Mean NCC over all pairs of the views that see the surface, at `surface` + `offsets`; windows follow the surface.

    surface : (r + 2 half, c + 2 half) float32 height indices, border included; offsets : (j,) float32, in steps;
    seen : (3, i, r, c) int32, see `block_costs`; out : (g, j, r, c) float32, written; 0 where fewer than two views see
    the cell. The pairs are dealt to g groups (see `add_pairs`); their sum is the mean over all.
    """
    rows, cols = out.shape[2], out.shape[3]
    n_views = layout.shape[0]
    width = cols + 2 * half
    n, size = rows * width, surface.size + SLACK
    planes, windows = np.zeros((n_views, size), np.float32), np.full(1, half)
    mean, scale = np.zeros((n_views, 1, size), np.float32), np.zeros((n_views, 1, size), np.float32)
    flat = np.empty((n_views, 3, size), np.int32)
    pairs, agreed = np.empty(size, np.float32), np.empty((out.shape[0], size), np.float32)
    work = np.empty((4, size), np.float32)
    grids, level = np.empty((3, 8)), np.empty(surface.shape, np.float32)
    at_surface = np.zeros((3, n_views, rows, cols), np.int32)
    for i in range(n_views):
        for r in range(rows):
            for c in range(cols):
                z = surface[r + half, c + half]
                if not (max(seen[0, i, r, c], seen[2, i, r, c]) <= z <= seen[1, i, r, c]):
                    at_surface[0, i, r, c] = HIDDEN
    flat_visibility(at_surface, half, flat, pairs)
    if pairs.max() == 0.0:
        out[:] = 0.0
        return
    centre = np.float64(0.5) * (surface.min() + offsets.min() + surface.max() + offsets.max())
    reach = max(np.float64(0.5) * (surface.max() + offsets.max() - surface.min() - offsets.min()), 0.01)
    for j in range(offsets.shape[0]):
        for r in range(surface.shape[0]):
            for c in range(width):
                level[r, c] = (surface[r, c] + offsets[j] - np.float32(centre)) / np.float32(reach)
        for i in range(n_views):
            if flat[i, 0].min() == HIDDEN:
                continue
            for m in range(3):
                t = heights[0] + (centre + (m - 1) * reach) * heights[1]
                plane_grid(nodes, i, t, block, half, grids[m])
            resample_surface(pixels, layout[i], grids, level, planes[i, : surface.size].reshape(surface.shape))
            planes[i] -= planes[i, half * width + half]
            window_moments(planes[i], windows, width, n, floor, work, mean[i], scale[i])
            for p in range(n):
                scale[i, 0, p] *= np.float32(flat[i, 0, p] < HIDDEN)
        agreed[:] = 0.0
        add_pairs(planes, windows, mean, scale, width, n, work, agreed)
        for g in range(out.shape[0]):
            for r in range(rows):
                for c in range(cols):
                    p = r * width + c
                    out[g, j, r, c] = agreed[g, p] * pairs[p]


# as block_profile, over every block of a tile; surface : (r + 2 half, c + 2 half)
@kernel
def tile_profile(pixels, layout, nodes, heights, surface, offsets, block, half, seen, floor, out):
    """`block_profile` of every block of a tile; out : (g, j, r, c)."""
    n_rows, n_cols = out.shape[2], out.shape[3]
    for br in range((n_rows + block - 1) // block):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range((n_cols + block - 1) // block):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            block_profile(
                pixels, layout, nodes[:, br : br + 2, bc : bc + 2], heights,
                surface[r0 : r1 + 2 * half, c0 : c1 + 2 * half], offsets, block, half, seen[:, :, r0:r1, c0:c1],
                floor, out[:, :, r0:r1, c0:c1],
            )  # fmt: skip


# (p,) f4, i4, i4, i4, (c,) f4, (2,6) f4, (2,2) f4, (c,) f4 -> None
@kernel
def ortho_row(image, origin, n_cols, n_cells, level, lines, bounds, out):
    """Bilinear values of a row of cells. origin : index in `image` that positions count from; level : (c,) float32, u;
    lines : (2, 6), columns and rows, see `row_positions`; bounds : (2, 2), lowest and highest position of each."""
    line, across = lines[0], lines[1]
    for c in range(n_cells):
        u, t = level[c], np.float32(np.int32(c))
        x = (line[0] + t * line[3]) + u * ((line[1] + t * line[4]) + u * (line[2] + t * line[5]))
        y = (across[0] + t * across[3]) + u * ((across[1] + t * across[4]) + u * (across[2] + t * across[5]))
        x, y = min(max(x, bounds[0, 0]), bounds[0, 1]), min(max(y, bounds[1, 0]), bounds[1, 1])
        left, top = np.floor(x), np.floor(y)
        fx, fy = x - left, y - top
        p = np.uint32(np.int32(np.int32(top) * n_cols) + np.int32(left) + origin)
        q = np.uint32(p + np.uint32(n_cols))
        high = image[p] + fx * (image[p + np.uint32(1)] - image[p])
        low = image[q] + fx * (image[q + np.uint32(1)] - image[q])
        out[c] = high + fy * (low - high)


# (p,) f4, (i,3) i8, (i,b,d,2,4) f8, (2,) f8, (r,c) f4, i8, i8, (r,c) f4 -> None
@kernel
def tile_ortho(pixels, layout, nodes, heights, surface, view, block, out):
    """Image of one view on a surface, bilinear. surface : (r, c) float32 height indices; out : (r, c), written."""
    n_rows, n_cols = surface.shape
    low, high = heights[0] + surface.min() * heights[1], heights[0] + surface.max() * heights[1]
    middle, reach = 0.5 * (low + high), max(0.5 * abs(high - low), 1e-9)
    base, rows, cols = layout[view, 0], layout[view, 1], layout[view, 2]
    image, grids = pixels[base : base + rows * cols], np.empty((3, 8))
    lines, bounds, level = np.empty((2, 6), np.float32), np.empty((2, 2), np.float32), np.empty(block, np.float32)
    for br in range((n_rows + block - 1) // block):
        for bc in range((n_cols + block - 1) // block):
            for m in range(3):
                plane_grid(nodes[:, br : br + 2, bc : bc + 2], view, middle + (m - 1) * reach, block, 0, grids[m])
            x0, y0 = min(max(int(grids[1, 0]), 0), cols - 2), min(max(int(grids[1, 1]), 0), rows - 2)
            bounds[0, 0], bounds[0, 1] = -x0, cols - 1.01 - x0
            bounds[1, 0], bounds[1, 1] = -y0, rows - 1.01 - y0
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            for r in range(br * block, min((br + 1) * block, n_rows)):
                row_positions(grids, 0, r - br * block, float(x0), lines[0])
                row_positions(grids, 1, r - br * block, float(y0), lines[1])
                for c in range(c1 - c0):
                    level[c] = (heights[0] + surface[r, c0 + c] * heights[1] - middle) / reach
                origin = np.int32(y0 * cols + x0)
                ortho_row(image, origin, np.int32(cols), np.int32(c1 - c0), level, lines, bounds, out[r, c0:c1])
