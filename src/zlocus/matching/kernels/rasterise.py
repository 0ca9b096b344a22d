"""Drawing the heights of the pixels of images on a ground grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

# Rounding by which a point may lie outside a triangle, as a share of the triangle.
ON_EDGE = 1e-9


class SurfaceLimits(NamedTuple):
    """When neighbouring pixels show one surface."""

    max_distance_cells: float  # f8: largest distance on the ground
    max_height_difference_m: float  # f8: largest difference in height of pixels that are close together
    max_slope_m: float  # f8: largest difference in height per cell of distance


# (r,c,3) f8, i8, i8, i8, SurfaceLimits -> b1
@kernel
def is_connected(ground, a, b, c, limits):
    """Whether three pixels (flat indices) show one surface: each two are close enough in place and in height."""
    n_cols = ground.shape[1]
    for i, j in ((a, b), (b, c), (c, a)):
        p, q = ground[i // n_cols, i % n_cols], ground[j // n_cols, j % n_cols]
        away = np.hypot(p[0] - q[0], p[1] - q[1])
        max_difference = max(limits.max_height_difference_m, limits.max_slope_m * away)
        if not away <= limits.max_distance_cells or abs(p[2] - q[2]) > max_difference:
            return False
    return True


# (r,c,3) f8, i8, i8, i8, (r,c) f4, (r,c) i4 -> None
@kernel
def draw_triangle(ground, a, b, c, height, pixel):
    """Draw the plane through three pixels on the cells whose centres it covers, where nothing higher was drawn."""
    n_cols = ground.shape[1]
    p, q, s = ground[a // n_cols, a % n_cols], ground[b // n_cols, b % n_cols], ground[c // n_cols, c % n_cols]
    area = (q[0] - p[0]) * (s[1] - p[1]) - (q[1] - p[1]) * (s[0] - p[0])
    if area == 0.0:
        return
    first_row, last_row = np.ceil(min(p[1], q[1], s[1]) - 0.5), np.floor(max(p[1], q[1], s[1]) - 0.5)
    first_col, last_col = np.ceil(min(p[0], q[0], s[0]) - 0.5), np.floor(max(p[0], q[0], s[0]) - 0.5)
    for row in range(max(int(first_row), 0), min(int(last_row) + 1, height.shape[0])):
        for col in range(max(int(first_col), 0), min(int(last_col) + 1, height.shape[1])):
            x, y = col + 0.5, row + 0.5
            v = ((x - p[0]) * (s[1] - p[1]) - (y - p[1]) * (s[0] - p[0])) / area
            w = ((q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])) / area
            u = 1.0 - v - w
            if u < -ON_EDGE or v < -ON_EDGE or w < -ON_EDGE:
                continue
            z = np.float32(u * p[2] + v * q[2] + w * s[2])
            if not z <= height[row, col]:
                height[row, col] = z
                pixel[row, col] = a if u >= max(v, w) else (b if v >= w else c)


# (r,c,3) f8, SurfaceLimits, (r,c) f4, (r,c) i4 -> None
@kernel
def draw_image(ground, limits, height, pixel):
    """Draw the pixels of an image on a grid. Where they overlap the highest is kept, so roofs cover the walls below.

    ground : (r, c, 3) float64, column and row in cells (corners of cells are whole numbers) and height of the ground
    point of each pixel, NaN where not known; height : (r, c) float32, NaN, and pixel : (r, c) int32, -1, both written:
    the highest height at the centre of each cell, and the flat index of the pixel that is nearest to it.

    Triangles of neighbouring pixels are drawn where they show one surface. So no cell between two pixels stays empty,
    and a height is that at the centre of the cell, not at the place of a pixel. A pixel is also drawn on the cell that
    it falls into where no triangle covers that cell, or only one that is lower by more than the limit.
    """
    n_rows, n_cols = ground.shape[0], ground.shape[1]
    jump = np.float32(limits.max_height_difference_m)
    for r in range(n_rows - 1):
        for c in range(n_cols - 1):
            a = r * n_cols + c
            b, d, e = a + 1, a + n_cols, a + n_cols + 1
            # The square is divided along the diagonal whose ends differ less in height, or whose ends are both known.
            falling = abs(ground[r, c, 2] - ground[r + 1, c + 1, 2])
            rising = abs(ground[r, c + 1, 2] - ground[r + 1, c, 2])
            if np.isnan(rising) or falling <= rising:
                first, second, left, right = a, e, d, b
            else:
                first, second, left, right = b, d, a, e
            if is_connected(ground, first, second, left, limits):
                draw_triangle(ground, first, second, left, height, pixel)
            if is_connected(ground, first, second, right, limits):
                draw_triangle(ground, first, second, right, height, pixel)
    for r in range(n_rows):
        for c in range(n_cols):
            x, y, z = ground[r, c, 0], ground[r, c, 1], np.float32(ground[r, c, 2])
            if np.isnan(z) or x < 0.0 or y < 0.0 or x >= height.shape[1] or y >= height.shape[0]:
                continue
            row, col = int(y), int(x)
            if not z <= height[row, col] + jump:
                height[row, col], pixel[row, col] = z, r * n_cols + c


# (i,r,c) f4, f4, (r,c) f4, (i,r,c) b1 -> None
@kernel
def agreed_heights(heights, tolerance, height, agrees):
    """Write the height on which most images agree in each cell (of equal numbers the higher): the median of theirs.

    heights : (i, r, c) float32 m, one surface for each image, NaN where it has no height; tolerance : m, largest
    difference between the highest and the lowest height that agree; height : (r, c) float32, written, NaN where no
    image has one; agrees : (i, r, c) bool, written, images that agree.
    """
    n_images, n_rows, n_cols = heights.shape
    agrees[:] = False
    for r in range(n_rows):
        for c in range(n_cols):
            top, most = np.float32(np.nan), 0
            for i in range(n_images):
                highest, count = heights[i, r, c], 0
                for j in range(n_images):
                    z = heights[j, r, c]
                    count += z <= highest and z >= highest - tolerance
                if count > most or (count == most and highest > top):
                    top, most = highest, count
            height[r, c] = top
            if most == 0:
                continue
            chosen = np.empty(most, np.float32)
            n = 0
            for j in range(n_images):
                z = heights[j, r, c]
                if z <= top and z >= top - tolerance:
                    agrees[j, r, c] = True
                    chosen[n] = z
                    n += 1
            height[r, c] = np.median(chosen)
