"""Correlation close to a surface, with windows that follow it: for heights finer than the steps of the lattice.

The cells of a block are stored flat (see `cost_volume.py`), so that passes over them are long loops, which vectorise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.cost_volume import empty_visibility, flat_visibility, views_of_block, visible_in
from zlocus.matching.kernels.ncc import SLACK, WindowMoments, add_pairs, window_moments
from zlocus.matching.kernels.resample import RUN, block_grid, flat_cells, gather, image_of, resample_scratch
from zlocus.matching.kernels.shared_records import NEVER_COVERED, BlockGrid, CellBox, VisibleHeights

LINEAR, CUBIC = 1, 3
# Least half range of the heights of a block, normalised: a flat block has none.
MIN_SPAN = 1e-9


class ProfileSampling(NamedTuple):
    """How the correlation is sampled around a surface."""

    degree: int  # i8: LINEAR for grey values, CUBIC for spline coefficients
    offsets: np.ndarray  # (j,) f4: heights of the samples above the surface, in steps
    windows: np.ndarray  # (w,) i8: half widths of the windows, ascending
    noise_variance: np.float32  # f4: grey values squared, added to the variance of every window


class LevelGrids(NamedTuple):
    """Image positions of the cells of a block in one view at three heights: u = -1, 0 and 1."""

    low: BlockGrid  # BlockGrid: at u = -1
    middle: BlockGrid  # BlockGrid: at u = 0
    high: BlockGrid  # BlockGrid: at u = 1


# ViewArrays, i8, f8, f8, i8 -> LevelGrids
@kernel
def level_grids(views, view, middle, span, half):
    """Image positions of the cells of a block, and of `half` cells around it, at t = middle - span, middle and middle +
    span."""
    return LevelGrids(
        block_grid(views, view, middle - span, half), block_grid(views, view, middle, half),
        block_grid(views, view, middle + span, half),
    )  # fmt: skip


# AxisGrid, AxisGrid, AxisGrid, i8, i8, (20,) f4 -> i8
@kernel
def axis_path(low, middle, high, n, degree, path):
    """Write the path of one axis, see `surface_path`; returns the whole pixel. n : size of the image along the axis."""
    before, after = (1, 3.01) if degree == CUBIC else (0, 1.01)
    origin = min(max(int(middle.origin), before), n - int(after) - 1)
    path[0], path[1], path[2], path[3] = middle.origin - origin, middle.by_col, middle.by_row, middle.mixed
    path[4], path[5] = middle.bend_row, middle.bend_col
    path[6], path[7] = 0.5 * (high.origin - low.origin), 0.5 * (high.by_col - low.by_col)
    path[8], path[9] = 0.5 * (high.by_row - low.by_row), 0.5 * (high.mixed - low.mixed)
    path[10], path[11] = 0.5 * (high.bend_row - low.bend_row), 0.5 * (high.bend_col - low.bend_col)
    path[12] = 0.5 * (high.origin + low.origin) - middle.origin
    path[13] = 0.5 * (high.by_col + low.by_col) - middle.by_col
    path[14] = 0.5 * (high.by_row + low.by_row) - middle.by_row
    path[15] = 0.5 * (high.mixed + low.mixed) - middle.mixed
    path[16] = 0.5 * (high.bend_row + low.bend_row) - middle.bend_row
    path[17] = 0.5 * (high.bend_col + low.bend_col) - middle.bend_col
    path[18], path[19] = before - origin, n - after - origin
    return origin


# LevelGrids, ViewImage, i8, (2,20) f4 -> (2,) i8
@kernel
def surface_path(grids, image, degree, path):
    """Write where one view shows a block of cells, as polynomials in the height u.

    path : (2, 20), written, for x and y: the coefficients (1, column, row, both, squares of row and column) of 1, u and
    u^2, then the lowest and the highest position. Positions are px from a whole pixel (column, row), which is returned.
    degree : of the interpolation, whose pixels have to lie inside the image.
    """
    low, middle, high, origin = grids.low, grids.middle, grids.high, np.empty(2, np.int64)
    origin[0] = axis_path(low.x, middle.x, high.x, image.n_cols, degree, path[0])
    origin[1] = axis_path(low.y, middle.y, high.y, image.n_rows, degree, path[1])
    return origin


# (20,) f4, FlatCells, (p,) f4, i8, i8, (n,) f4 -> None
@kernel
def positions_along(path, cells, level, first, end, out):
    """Write the positions of a run of cells on one axis. path : see `surface_path`; level : heights u."""
    a, b, c, d, e, f = path[0], path[1], path[2], path[3], path[4], path[5]
    by_a, by_b, by_c, by_d, by_e, by_f = path[6], path[7], path[8], path[9], path[10], path[11]
    bend_a, bend_b, bend_c, bend_d, bend_e, bend_f = path[12], path[13], path[14], path[15], path[16], path[17]
    low, high = path[18], path[19]
    rows, cols, levels = cells.rows[first:end], cells.cols[first:end], level[first:end]
    for j in range(end - first):
        row, col, u = rows[j], cols[j], levels[j]
        at = (a + row * (c + row * e)) + col * (b + row * d + col * f)
        by_level = (by_a + row * (by_c + row * by_e)) + col * (by_b + row * by_d + col * by_f)
        bend = (bend_a + row * (bend_c + row * bend_e)) + col * (bend_b + row * bend_d + col * bend_f)
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


# ViewImage, LevelGrids, FlatCells, (p,) f4, i8, (p,) f4 -> None
@kernel
def resample_surface(image, grids, cells, level, degree, out):
    """Write the image values on cells at individual heights: bilinear, or cubic B-spline from coefficients.

    image : pixels or B-spline coefficients; level : (p,) float32 in [-1, 1], heights, in which positions are quadratic;
    degree : LINEAR or CUBIC; out : (p,) or longer. Positions are float32, counted from a whole pixel near the grid;
    those outside the image are moved to its edge.
    """
    path, n_cols, pixels = np.empty((2, 20), np.float32), image.n_cols, image.pixels
    origin = surface_path(grids, image, degree, path)
    before = 1 if degree == CUBIC else 0
    start = np.int32((origin[1] - before) * n_cols + origin[0] - before)
    position, whole, scratch = np.empty((2, RUN), np.float32), np.empty((2, RUN), np.float32), resample_scratch(RUN)
    across, down = np.empty((4, RUN), np.float32), np.empty((4, RUN), np.float32)
    index = scratch.pixel_index
    for first in range(0, level.shape[0], RUN):
        end = min(first + RUN, level.shape[0])
        n = end - first
        positions_along(path[0], cells, level, first, end, position[0])
        positions_along(path[1], cells, level, first, end, position[1])
        if degree == CUBIC:
            spline_weights(position[0], n, whole[0], across)
            spline_weights(position[1], n, whole[1], down)
            pixel_indices(whole, n, start, np.int32(n_cols), index)
            spline_gather(pixels, n_cols, index, across, down, n, out[first:end])
        else:
            fractions(position, n, whole, scratch.fraction)
            pixel_indices(whole, n, start, np.int32(n_cols), index)
            gather(image, scratch, out[first:end])


# ViewArrays, (r,c) f4, ProfileSampling, VisibleHeights, (w,g,j,r,c) f4 -> None
@kernel
def block_profile(views, surface, sampling, visible, out):
    """Write the mean NCC over all pairs of the views that see the surface, at the offsets of the sampling from it.

    The windows follow the surface. surface : (r + 2 half, c + 2 half) float32 height indices, with the cells around the
    block that its windows need (half is the last half width); out : (w, g, j, r, c) float32, 0 where fewer than two
    views see the cell. The pairs are divided into g groups (see `add_pairs`); the sum over the groups is the mean over
    all pairs.
    """
    offsets, windows, degree, variance = sampling.offsets, sampling.windows, sampling.degree, sampling.noise_variance
    n_windows, n_groups, rows, cols = out.shape[0], out.shape[1], out.shape[3], out.shape[4]
    n_views, half, heights = views.layout.shape[0], windows[-1], views.heights
    width = cols + 2 * half
    n, size = rows * width, surface.size + SLACK
    planes = np.zeros((n_views, size), np.float32)
    mean, scale = np.zeros((n_views, n_windows, size), np.float32), np.zeros((n_views, n_windows, size), np.float32)
    flat, shape = empty_visibility(n_views, size), (n_views, rows, cols)
    pairs, agreed = np.empty(size, np.float32), np.empty((n_windows, n_groups, size), np.float32)
    work = np.empty((4, size), np.float32)
    level, cells = np.empty(surface.size, np.float32), flat_cells(surface.shape[0], width)
    at_surface = VisibleHeights(np.zeros(shape, np.int32), np.zeros(shape, np.int32), np.zeros(shape, np.int32))
    for i in range(n_views):
        for r in range(rows):
            for c in range(cols):
                z = surface[r + half, c + half]
                lowest = max(visible.lowest_covered[i, r, c], visible.lowest_unoccluded[i, r, c])
                if not (lowest <= z <= visible.highest_covered[i, r, c]):
                    at_surface.lowest_covered[i, r, c] = NEVER_COVERED
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
            if flat.lowest_covered[i].min() == NEVER_COVERED:
                continue
            grids = level_grids(views, i, heights[0] + centre * heights[1], span * heights[1], half)
            resample_surface(image_of(views, i), grids, cells, level, degree, planes[i])
            planes[i] -= planes[i, half * width + half]
            window_moments(planes[i], windows, width, n, variance, work, mean[i], scale[i])
            for w in range(n_windows):
                for p in range(n):
                    scale[i, w, p] *= np.float32(flat.lowest_covered[i, p] < NEVER_COVERED)
        agreed[:] = 0.0
        add_pairs(planes, windows, WindowMoments(mean, scale), width, n, work, agreed)
        for w in range(n_windows):
            for g in range(n_groups):
                for r in range(rows):
                    for c in range(cols):
                        p = r * width + c
                        out[w, g, j, r, c] = agreed[w, g, p] * pairs[p]


# ViewArrays, (r,c) f4, ProfileSampling, VisibleHeights, (w,g,j,r,c) f4 -> None
@kernel
def tile_profile(views, surface, sampling, visible, out):
    """`block_profile` of every block of a tile; out : (w, g, j, r, c)."""
    n_rows, n_cols, half, block = out.shape[3], out.shape[4], sampling.windows[-1], views.block
    for br in range((n_rows + block - 1) // block):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range((n_cols + block - 1) // block):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            block_profile(
                views_of_block(views, br, bc), surface[r0 : r1 + 2 * half, c0 : c1 + 2 * half], sampling,
                visible_in(visible, CellBox(r0, r1, c0, c1)), out[:, :, :, r0:r1, c0:c1],
            )  # fmt: skip


# ViewArrays, (r,c) f4, i8, (b,d) b1, (r,c) f4 -> None
@kernel
def tile_ortho(views, surface, view, is_wanted, out):
    """Write the image of one view on a surface, bilinear.

    surface : (r, c) float32 height indices; is_wanted : (b, d), blocks whose image is wanted; out : (r, c), 0 in the
    other blocks.
    """
    (n_rows, n_cols), heights, block, image = surface.shape, views.heights, views.block, image_of(views, view)
    level, grey = np.empty(block * block, np.float32), np.empty(block * block, np.float32)
    cells, last_width = flat_cells(block, block), block
    for br in range((n_rows + block - 1) // block):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range((n_cols + block - 1) // block):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            if not is_wanted[br, bc]:
                out[r0:r1, c0:c1] = 0.0
                continue
            of_block = surface[r0:r1, c0:c1]
            low, high = heights[0] + of_block.min() * heights[1], heights[0] + of_block.max() * heights[1]
            middle, span = 0.5 * (low + high), max(0.5 * abs(high - low), MIN_SPAN)
            grids = level_grids(views_of_block(views, br, bc), view, middle, span, 0)
            width, n = c1 - c0, (r1 - r0) * (c1 - c0)
            if cells.rows.shape[0] != n or last_width != width:
                cells, last_width = flat_cells(r1 - r0, width), width
            for r in range(r0, r1):
                for c in range(width):
                    index = heights[0] + of_block[r - r0, c] * heights[1]
                    level[(r - r0) * width + c] = (index - middle) / span
            resample_surface(image, grids, cells, level[:n], LINEAR, grey[:n])
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
