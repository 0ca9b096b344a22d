"""The measure close to a surface, with windows that follow it: for heights finer than the lattice."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel
from zlocus.kernels.agreement import pair_sum, window_moments
from zlocus.kernels.volume import HIDDEN, flat_visibility, plane_grid


# (p,) f4, (3,) i8, (3,8) f8, (r,c) f4, (r,c) f4 -> None
@kernel
def resample_surface(pixels, layout, grids, level, out):
    """Cubic B-spline image values on a grid of cells, each at a height of its own.

    pixels : (p,) float32 B-spline coefficients; grids : (3, 8) positions at levels -1, 0 and 1 (see `plane_grid`);
    level : (r, c) float32 in [-1, 1]: positions are quadratic in it; out : (r, c).
    """
    base, n_rows, n_cols = layout[0], layout[1], layout[2]
    image = pixels[base : base + n_rows * n_cols]
    stride = np.uint32(n_cols)
    one = np.uint32(1)
    sixth = np.float32(1.0 / 6.0)
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            u = np.float64(level[r, c])
            w0, w1, w2 = 0.5 * u * (u - 1.0), 1.0 - u * u, 0.5 * u * (u + 1.0)
            x = y = 0.0
            for j in range(3):
                w = w0 if j == 0 else (w1 if j == 1 else w2)
                x += w * (grids[j, 0] + r * grids[j, 4] + c * (grids[j, 2] + r * grids[j, 6]))
                y += w * (grids[j, 1] + r * grids[j, 5] + c * (grids[j, 3] + r * grids[j, 7]))
            x = min(max(x, 1.0), n_cols - 3.01)
            y = min(max(y, 1.0), n_rows - 3.01)
            col, row = int(x), int(y)
            fx, fy = np.float32(x - col), np.float32(y - row)
            gx, gy = np.float32(1.0) - fx, np.float32(1.0) - fy
            ax, dx = gx * gx * gx * sixth, fx * fx * fx * sixth
            bx = np.float32(2.0 / 3.0) - fx * fx * (np.float32(1.0) - np.float32(0.5) * fx)
            cx = np.float32(1.0) - ax - bx - dx
            ay, dy = gy * gy * gy * sixth, fy * fy * fy * sixth
            by = np.float32(2.0 / 3.0) - fy * fy * (np.float32(1.0) - np.float32(0.5) * fy)
            cy = np.float32(1.0) - ay - by - dy
            p = np.uint32((row - 1) * n_cols + col - 1)
            total = np.float32(0.0)
            for j in range(4):
                w_row = ay if j == 0 else (by if j == 1 else (cy if j == 2 else dy))
                q = np.uint32(p + np.uint32(j) * stride)
                total += w_row * (
                    ax * image[q] + bx * image[q + one] + cx * image[q + np.uint32(2)] + dx * image[q + np.uint32(3)]
                )
            out[r, c] = total


# (p,) f4, (i,3) i8, (i,2,2,2,4) f8, (2,) f8, (r,c) f4, (j,) f4, i8, i8, (2,i,r,c) i4, f4, (j,r,c) f4 -> None
@kernel
def block_profile(pixels, layout, nodes, heights, surface, offsets, block, half, seen, floor, out):
    """Mean NCC over all pairs of the views that see the surface, at `surface` + `offsets`; windows follow the surface.

    surface : (r + 2 half, c + 2 half) float32 height indices, border included; offsets : (j,) float32, in steps;
    seen : (2, i, r, c) int32, see `block_costs`; out : (j, r, c) float32, written; 0 where
    fewer than two views see the cell.
    """
    rows, cols = out.shape[1], out.shape[2]
    n_views = layout.shape[0]
    width = cols + 2 * half
    size = (rows + 2 * half) * width
    planes = np.zeros((n_views, size), np.float32)
    mean, scale = np.zeros_like(planes), np.zeros_like(planes)
    flat = np.empty((2, n_views, size), np.int32)
    pairs, agreed = np.empty(size, np.float32), np.empty(size, np.float32)
    scratch = np.empty((2, size), np.float32)
    grids, level = np.empty((3, 8)), np.empty(surface.shape, np.float32)
    at_surface = np.zeros((2, n_views, rows, cols), np.int32)
    for i in range(n_views):
        for r in range(rows):
            for c in range(cols):
                z = surface[r + half, c + half]
                if not (seen[0, i, r, c] <= z <= seen[1, i, r, c]):
                    at_surface[0, i, r, c] = HIDDEN
    n = flat_visibility(at_surface, half, flat, pairs)
    centre = np.float64(0.5) * (surface.min() + offsets.min() + surface.max() + offsets.max())
    reach = max(np.float64(0.5) * (surface.max() + offsets.max() - surface.min() - offsets.min()), 0.01)
    for j in range(offsets.shape[0]):
        level[:] = (surface + offsets[j] - np.float32(centre)) / np.float32(reach)
        for i in range(n_views):
            if flat[0, i].min() == HIDDEN:
                continue
            for m in range(3):
                t = heights[0] + (centre + (m - 1) * reach) * heights[1]
                plane_grid(nodes, i, t, block, half, grids[m])
            resample_surface(pixels, layout[i], grids, level, planes[i].reshape(surface.shape))
            planes[i] -= planes[i, half * width + half]
            window_moments(planes[i], 0, half, width, n, floor, scratch[0], mean[i], scale[i])
            for p in range(n):
                scale[i, p] *= np.float32(flat[0, i, p] < HIDDEN)
        pair_sum(planes, 0, mean, scale, half, width, n, scratch, agreed)
        for r in range(rows):
            for c in range(cols):
                p = r * width + c
                out[j, r, c] = agreed[p] * pairs[p]


# as block_profile, over every block of a tile; surface : (r + 2 half, c + 2 half)
@kernel
def tile_profile(pixels, layout, nodes, heights, surface, offsets, block, half, seen, floor, out):
    """`block_profile` of every block of a tile; out : (j, r, c)."""
    n_rows, n_cols = out.shape[1], out.shape[2]
    for br in range((n_rows + block - 1) // block):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range((n_cols + block - 1) // block):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            block_profile(
                pixels, layout, nodes[:, br : br + 2, bc : bc + 2], heights,
                surface[r0 : r1 + 2 * half, c0 : c1 + 2 * half], offsets, block, half, seen[:, :, r0:r1, c0:c1],
                floor, out[:, r0:r1, c0:c1],
            )  # fmt: skip


# (p,) f4, (i,3) i8, (i,b,d,2,4) f8, (2,) f8, (r,c) f4, i8, i8, (r,c) f4 -> None
@kernel
def tile_ortho(pixels, layout, nodes, heights, surface, view, block, out):
    """Image of one view on a surface, bilinear. surface : (r, c) float32 height indices; out : (r, c), written."""
    n_rows, n_cols = surface.shape
    low, high = heights[0] + surface.min() * heights[1], heights[0] + surface.max() * heights[1]
    middle, reach = 0.5 * (low + high), max(0.5 * abs(high - low), 1e-9)
    grids = np.empty((3, 8))
    base, rows, cols = layout[view, 0], layout[view, 1], layout[view, 2]
    for br in range((n_rows + block - 1) // block):
        for bc in range((n_cols + block - 1) // block):
            for m in range(3):
                plane_grid(nodes[:, br : br + 2, bc : bc + 2], view, middle + (m - 1) * reach, block, 0, grids[m])
            for r in range(min(block, n_rows - br * block)):
                for c in range(min(block, n_cols - bc * block)):
                    u = (heights[0] + surface[br * block + r, bc * block + c] * heights[1] - middle) / reach
                    x = y = 0.0
                    for j in range(3):
                        w = 0.5 * u * (u - 1.0) if j == 0 else (1.0 - u * u if j == 1 else 0.5 * u * (u + 1.0))
                        x += w * (grids[j, 0] + r * grids[j, 4] + c * (grids[j, 2] + r * grids[j, 6]))
                        y += w * (grids[j, 1] + r * grids[j, 5] + c * (grids[j, 3] + r * grids[j, 7]))
                    x, y = min(max(x, 0.0), cols - 1.001), min(max(y, 0.0), rows - 1.001)
                    fx, fy = x - int(x), y - int(y)
                    p = base + int(y) * cols + int(x)
                    top = pixels[p] * (1.0 - fx) + pixels[p + 1] * fx
                    low_row = pixels[p + cols] * (1.0 - fx) + pixels[p + cols + 1] * fx
                    out[br * block + r, bc * block + c] = top * (1.0 - fy) + low_row * fy
