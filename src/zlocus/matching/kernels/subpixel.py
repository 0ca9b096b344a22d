"""Correlation close to a surface, with windows that follow it: for heights finer than the steps of the lattice.

The cells of a block are stored flat (see `cost_volume.py`), so that passes over them are long loops, which vectorise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.cost_volume import HIDDEN, flat_cells, flat_visibility, plane_grid
from zlocus.matching.kernels.ncc import SLACK, add_pairs, window_moments
from zlocus.matching.kernels.resample import RUN, gather
from zlocus.matching.kernels.shared_records import ViewArrays

LINEAR, CUBIC = 1, 3


class ProfileSampling(NamedTuple):
    """How the correlation is sampled around a surface."""

    degree: int  # i8: LINEAR for grey values, CUBIC for spline coefficients
    offsets: np.ndarray  # (j,) f4: heights of the samples above the surface, in steps
    windows: np.ndarray  # (w,) i8: half widths of the windows, ascending
    noise_variance: np.float32  # f4: grey values squared, added to the variance of every window


# (3,8) f8, (3,) i8, i8, (2,14) f4 -> (2,) i8
@kernel
def surface_path(grids, layout, degree, path):
    """Write where one view shows a block of cells, as polynomials in the height u.

    path : (2, 14), written, for x and y: the bilinear coefficients (1, column, row, both) of 1, u and u^2, then the
    lowest and the highest position. Positions are px from a whole pixel (column, row), which is returned. grids :
    (3, 8), positions at u = -1, 0 and 1, see `plane_grid`; degree : of the interpolation, whose pixels have to lie
    inside the image.
    """
    before, after = (1, 3.01) if degree == CUBIC else (0, 1.01)
    origin = np.empty(2, np.int64)
    for axis in range(2):
        n = layout[2 - axis]
        origin[axis] = min(max(int(grids[1, axis]), before), n - int(after) - 1)
        for part in range(4):
            k = axis + 2 * part
            low, middle, high = grids[0, k], grids[1, k], grids[2, k]
            path[axis, part] = middle - (origin[axis] if part == 0 else 0.0)
            path[axis, 4 + part] = 0.5 * (high - low)
            path[axis, 8 + part] = 0.5 * (high + low) - middle
        path[axis, 12], path[axis, 13] = before - origin[axis], n - after - origin[axis]
    return origin


# (14,) f4, (2,p) f4, (p,) f4, i8, i8, (n,) f4 -> None
@kernel
def positions_along(path, cells, level, first, end, out):
    """Write the positions of a run of cells on one axis. path : see `surface_path`; cells : (2, p), rows and columns;
    level : heights u."""
    a, b, c, d = path[0], path[1], path[2], path[3]
    by_a, by_b, by_c, by_d = path[4], path[5], path[6], path[7]
    bend_a, bend_b, bend_c, bend_d = path[8], path[9], path[10], path[11]
    low, high = path[12], path[13]
    rows, cols, levels = cells[0][first:end], cells[1][first:end], level[first:end]
    for j in range(end - first):
        row, col, u = rows[j], cols[j], levels[j]
        at = (a + row * c) + col * (b + row * d)
        by_level = (by_a + row * by_c) + col * (by_b + row * by_d)
        bend = (bend_a + row * bend_c) + col * (bend_b + row * bend_d)
        out[j] = min(max(at + u * (by_level + u * bend), low), high)


# (n,) f4, i8, (n,) f4, (4,n) f4 -> None
@kernel
def spline_weights(position, n, whole, weights):
    """Write the whole pixel and the four cubic B-spline weights of each of a run of positions."""
    one, half, sixth = np.float32(1.0), np.float32(0.5), np.float32(1.0 / 6.0)
    two_thirds = np.float32(2.0 / 3.0)
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    for j in range(n):
        pixel = np.floor(position[j])
        whole[j] = pixel
        f = position[j] - pixel
        g = one - f
        w0[j] = g * g * g * sixth
        w1[j] = two_thirds - f * f * (one - half * f)
        w2[j] = two_thirds - g * g * (one - half * g)
        w3[j] = f * f * f * sixth


# (2,n) f4, i8, i4, i4, (n,) u4 -> None
@kernel
def pixel_indices(whole, n, origin, n_cols, index):
    """Write the index in an image, counted from `origin`, of whole pixels (columns, rows)."""
    cols, rows = whole[0], whole[1]
    for j in range(n):
        index[j] = np.uint32(np.int32(np.int32(rows[j]) * n_cols) + np.int32(cols[j]) + origin)


# (p,) f4, i8, (n,) u4, (4,n) f4, (4,n) f4, i8, (n,) f4 -> None
@kernel
def spline_gather(image, n_cols, index, across, down, n, out):
    """Write the weighted sum of the 4 x 4 pixels that begin at each index."""
    one, two, three, stride = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(n_cols)
    for j in range(n):
        p = np.uint64(index[j])
        q = p + stride
        r = q + stride
        s = r + stride
        w0, w1, w2, w3 = across[0, j], across[1, j], across[2, j], across[3, j]
        top = (w0 * image[p] + w1 * image[p + one]) + (w2 * image[p + two] + w3 * image[p + three])
        high = (w0 * image[q] + w1 * image[q + one]) + (w2 * image[q + two] + w3 * image[q + three])
        low = (w0 * image[r] + w1 * image[r + one]) + (w2 * image[r + two] + w3 * image[r + three])
        end = (w0 * image[s] + w1 * image[s + one]) + (w2 * image[s + two] + w3 * image[s + three])
        out[j] = (down[0, j] * top + down[1, j] * high) + (down[2, j] * low + down[3, j] * end)


# (2,n) f4, i8, (2,n) f4, (2,n) f4 -> None
@kernel
def fractions(position, n, whole, fraction):
    """Write the whole pixels and the fractions of a run of positions (x, y)."""
    for axis in range(2):
        at, pixel, beyond = position[axis], whole[axis], fraction[axis]
        for j in range(n):
            pixel[j] = np.floor(at[j])
            beyond[j] = at[j] - pixel[j]


# (p,) f4, (3,) i8, (3,8) f8, (2,p) f4, (p,) f4, i8, (p,) f4 -> None
@kernel
def resample_surface(pixels, layout, grids, cells, level, degree, out):
    """Write the image values on cells at individual heights: bilinear, or cubic B-spline from coefficients.

    pixels : (p,) float32, pixels or B-spline coefficients of all images; layout : see `resample_plane`; grids : (3, 8)
    positions at levels -1, 0 and 1 (see `plane_grid`); cells : (2, p) float32, rows and columns; level : (p,) float32
    in [-1, 1], heights, in which positions are quadratic; degree : LINEAR or CUBIC; out : (p,) or longer. Positions are
    float32, counted from a whole pixel near the grid; those outside the image are moved to its edge.
    """
    path, n_cols = np.empty((2, 14), np.float32), layout[2]
    origin = surface_path(grids, layout, degree, path)
    before = 1 if degree == CUBIC else 0
    start = np.int32((origin[1] - before) * n_cols + origin[0] - before)
    image = pixels[layout[0] : layout[0] + layout[1] * n_cols]
    position, whole, index = np.empty((2, RUN), np.float32), np.empty((2, RUN), np.float32), np.empty(RUN, np.uint32)
    across, down = np.empty((4, RUN), np.float32), np.empty((4, RUN), np.float32)
    pairs = np.empty((2, RUN), np.complex64)
    for first in range(0, level.shape[0], RUN):
        end = min(first + RUN, level.shape[0])
        n = end - first
        positions_along(path[0], cells, level, first, end, position[0])
        positions_along(path[1], cells, level, first, end, position[1])
        if degree == CUBIC:
            spline_weights(position[0], n, whole[0], across)
            spline_weights(position[1], n, whole[1], down)
            pixel_indices(whole, n, start, np.int32(n_cols), index)
            spline_gather(image, n_cols, index, across, down, n, out[first:end])
        else:
            fractions(position, n, whole, across)
            pixel_indices(whole, n, start, np.int32(n_cols), index)
            gather(pixels, layout, index, across, pairs, out[first:end])


# ViewArrays, (r,c) f4, ProfileSampling, (3,i,r,c) i4, (w,g,j,r,c) f4 -> None
@kernel
def block_profile(views, surface, sampling, visible, out):
    """Write the mean NCC over all pairs of the views that see the surface, at the offsets of the sampling from it.

    The windows follow the surface. surface : (r + 2 half, c + 2 half) float32 height indices, with the cells around the
    block that its windows need (half is the last half width); visible : (3, i, r, c) int32, see `block_costs`; out :
    (w, g, j, r, c) float32, 0 where fewer than two views see the cell. The pairs are divided into g groups (see
    `add_pairs`); the sum over the groups is the mean over all pairs.
    """
    pixels, layout, nodes, heights, block = views.pixels, views.layout, views.nodes, views.heights, views.block
    offsets, windows, degree, floor = sampling.offsets, sampling.windows, sampling.degree, sampling.noise_variance
    n_windows, n_groups, rows, cols = out.shape[0], out.shape[1], out.shape[3], out.shape[4]
    n_views, half = layout.shape[0], windows[-1]
    width = cols + 2 * half
    n, size = rows * width, surface.size + SLACK
    planes = np.zeros((n_views, size), np.float32)
    mean, scale = np.zeros((n_views, n_windows, size), np.float32), np.zeros((n_views, n_windows, size), np.float32)
    flat = np.empty((n_views, 3, size), np.int32)
    pairs, agreed = np.empty(size, np.float32), np.empty((n_windows, n_groups, size), np.float32)
    work = np.empty((4, size), np.float32)
    grids, level, cells = np.empty((3, 8)), np.empty(surface.size, np.float32), flat_cells(surface.shape)
    at_surface = np.zeros((3, n_views, rows, cols), np.int32)
    for i in range(n_views):
        for r in range(rows):
            for c in range(cols):
                z = surface[r + half, c + half]
                if not (max(visible[0, i, r, c], visible[2, i, r, c]) <= z <= visible[1, i, r, c]):
                    at_surface[0, i, r, c] = HIDDEN
    flat_visibility(at_surface, half, flat, pairs)
    if pairs.max() == 0.0:
        out[:] = 0.0
        return
    centre = np.float64(0.5) * (surface.min() + offsets.min() + surface.max() + offsets.max())
    span = max(np.float64(0.5) * (surface.max() + offsets.max() - surface.min() - offsets.min()), 0.01)
    for j in range(offsets.shape[0]):
        for r in range(surface.shape[0]):
            for c in range(width):
                level[r * width + c] = (surface[r, c] + offsets[j] - np.float32(centre)) / np.float32(span)
        for i in range(n_views):
            if flat[i, 0].min() == HIDDEN:
                continue
            for m in range(3):
                t = heights[0] + (centre + (m - 1) * span) * heights[1]
                plane_grid(nodes, i, t, block, half, grids[m])
            resample_surface(pixels, layout[i], grids, cells, level, degree, planes[i])
            planes[i] -= planes[i, half * width + half]
            window_moments(planes[i], windows, width, n, floor, work, mean[i], scale[i])
            for w in range(n_windows):
                for p in range(n):
                    scale[i, w, p] *= np.float32(flat[i, 0, p] < HIDDEN)
        agreed[:] = 0.0
        add_pairs(planes, windows, mean, scale, width, n, work, agreed)
        for w in range(n_windows):
            for g in range(n_groups):
                for r in range(rows):
                    for c in range(cols):
                        p = r * width + c
                        out[w, g, j, r, c] = agreed[w, g, p] * pairs[p]


# as block_profile, over every block of a tile
@kernel
def tile_profile(views, surface, sampling, visible, out):
    """`block_profile` of every block of a tile; out : (w, g, j, r, c)."""
    n_rows, n_cols, half, block, nodes = out.shape[3], out.shape[4], sampling.windows[-1], views.block, views.nodes
    for br in range((n_rows + block - 1) // block):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range((n_cols + block - 1) // block):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            of_block = ViewArrays(
                views.pixels, views.layout, nodes[:, br : br + 2, bc : bc + 2], views.heights, block
            )  # fmt: skip
            block_profile(
                of_block, surface[r0 : r1 + 2 * half, c0 : c1 + 2 * half], sampling, visible[:, :, r0:r1, c0:c1],
                out[:, :, :, r0:r1, c0:c1],
            )  # fmt: skip


# ViewArrays, (r,c) f4, i8, (r,c) f4 -> None
@kernel
def tile_ortho(views, surface, view, out):
    """Write the image of one view on a surface, bilinear. surface : (r, c) float32 height indices; out : (r, c)."""
    pixels, layout, nodes, heights, block = views.pixels, views.layout, views.nodes, views.heights, views.block
    n_rows, n_cols = surface.shape
    low, high = heights[0] + surface.min() * heights[1], heights[0] + surface.max() * heights[1]
    middle, span = 0.5 * (low + high), max(0.5 * abs(high - low), 1e-9)
    grids, level, grey = np.empty((3, 8)), np.empty(block * block, np.float32), np.empty(block * block, np.float32)
    cells, last_width = flat_cells((block, block)), block
    for br in range((n_rows + block - 1) // block):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range((n_cols + block - 1) // block):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            for m in range(3):
                plane_grid(nodes[:, br : br + 2, bc : bc + 2], view, middle + (m - 1) * span, block, 0, grids[m])
            width, n = c1 - c0, (r1 - r0) * (c1 - c0)
            if cells.shape[1] != n or last_width != width:
                cells, last_width = flat_cells((r1 - r0, width)), width
            for r in range(r0, r1):
                for c in range(width):
                    index = heights[0] + surface[r, c0 + c] * heights[1]
                    level[(r - r0) * width + c] = (index - middle) / span
            resample_surface(pixels, layout[view], grids, cells, level[:n], LINEAR, grey[:n])
            out[r0:r1, c0:c1] = grey[:n].reshape((r1 - r0, width))


# (j,n) f4, (j,) f4, (n,) f4, (3,n) f4 -> None
@kernel
def around_largest(profile, offsets, position, three):
    """Write the three samples around the largest one of each cell (at an end, the three there) and the middle offset.

    See `profile_peaks`; three : (3, n).
    """
    for p in range(position.shape[0]):
        best = 0
        for j in range(1, profile.shape[0]):
            best = j if profile[j, p] > profile[best, p] else best
        at = min(max(best, 1), profile.shape[0] - 2)
        three[0, p], three[1, p], three[2, p] = profile[at - 1, p], profile[at, p], profile[at + 1, p]
        position[p] = offsets[at]


# (j,n) f4, (j,) f4, (n,) f4, (n,) f4, (n,) b1 -> None
@kernel
def profile_peaks(profile, offsets, position, value, is_inside):
    """Write position and value of the maximum of equally spaced samples, and whether it lies between first and last.

    The maximum is that of the parabola through the three samples around the largest one (at an end, the three there).
    profile : (j, n), a column for each cell, j >= 3.
    """
    three, spacing = profile, offsets[1] - offsets[0]
    if profile.shape[0] == 3:
        position[:] = offsets[1]
    else:
        three = np.empty((3, position.shape[0]), np.float32)
        around_largest(profile, offsets, position, three)
    left, here, right = three[0], three[1], three[2]
    for p in range(position.shape[0]):
        bend = min(left[p] - np.float32(2.0) * here[p] + right[p], np.float32(-1e-6))
        shift = np.float32(0.5) * (left[p] - right[p]) / bend
        is_inside[p] = (bend < np.float32(-1e-6)) & (abs(shift) < np.float32(1.0))
        shift = min(max(shift, np.float32(-1.0)), np.float32(1.0))
        value[p] = here[p] - np.float32(0.25) * (left[p] - right[p]) * shift
        position[p] += shift * spacing


# f4, f4, f4, f4 -> f4
@kernel
def vertex_of(left, here, right, min_curvature):
    """Vertex of the parabola through three samples, in spacings from the middle one; NaN where its curvature towards a
    maximum is not larger than `min_curvature`."""
    curvature = np.float32(2.0) * here - left - right
    return (right - left) / (np.float32(2.0) * curvature) if curvature > min_curvature else np.float32(np.nan)


# (2,3,n) f4, f4, f4, f4, (n,) f4 -> None
@kernel
def vertex_distances(profiles, spacing, min_curvature, max_difference, out):
    """Write the distance between the vertices of two groups' parabolas through three samples; NaN where one has none.

    profiles : (2, 3, n), a column for each cell; min_curvature : see `vertex_of`; max_difference : larger distances are
    set to it; out : (n,).
    """
    a, b, c, d, e, f = profiles[0, 0], profiles[0, 1], profiles[0, 2], profiles[1, 0], profiles[1, 1], profiles[1, 2]
    for p in range(out.shape[0]):
        vertex_a, vertex_b = vertex_of(a[p], b[p], c[p], min_curvature), vertex_of(d[p], e[p], f[p], min_curvature)
        difference = abs(vertex_a - vertex_b) * spacing
        out[p] = max_difference if difference > max_difference else difference
