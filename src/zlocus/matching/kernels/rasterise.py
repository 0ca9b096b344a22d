"""The heights of an image's pixels drawn on a ground grid."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

ON_EDGE = 1e-9


# (r,c,3) f8, i8, i8, i8, (3,) f8 -> b1
@kernel
def is_connected(ground, a, b, c, limits):
    """Whether three pixels (flat indices) show one surface: no two are far apart in place, or in height and steeply."""
    n_cols = ground.shape[1]
    for i, j in ((a, b), (b, c), (c, a)):
        p, q = ground[i // n_cols, i % n_cols], ground[j // n_cols, j % n_cols]
        away = np.hypot(p[0] - q[0], p[1] - q[1])
        if not away <= limits[0] or abs(p[2] - q[2]) > max(limits[1], limits[2] * away):
            return False
    return True


# (r,c,3) f8, i8, i8, i8, (r,c) f4, (r,c) i4 -> None
@kernel
def draw_triangle(ground, a, b, c, height, pixel):
    """Draw the plane through three pixels on the cells whose centres it covers, over what lies lower there."""
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


# (r,c,3) f8, (3,) f8, (r,c) f4, (r,c) i4 -> None
@kernel
def draw_image(ground, limits, height, pixel):
    """Draw an image's pixels on a grid; where they overlap, the highest wins, so that roofs hide the walls below them.

    ground : (r, c, 3) float64, column and row in cells (a cell's corner is whole) and height of what each pixel shows,
    NaN where not known; limits : (3,), cells that neighbouring pixels of one surface are apart at most, m that they may
    differ in height, and m per cell that they may differ beyond that; height : (r, c) float32, NaN, and pixel : (r, c)
    int32, -1, both written: highest height at the cell's centre, and flat index of the pixel that is nearest to it.

    Triangles of neighbouring pixels are drawn where they show one surface: so no cell between two pixels stays empty,
    and a height is that at the cell's centre, not that at the place where a point fell. A pixel counts for
    the cell it falls into where no triangle covers that, or only one that lies more than the limit lower.
    """
    n_rows, n_cols = ground.shape[0], ground.shape[1]
    jump = np.float32(limits[1])
    for r in range(n_rows - 1):
        for c in range(n_cols - 1):
            a = r * n_cols + c
            b, d, e = a + 1, a + n_cols, a + n_cols + 1
            # Along the diagonal whose ends differ less, or that has both of its ends.
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
    """The height on which most images agree in each cell, of equal numbers the higher: the median of theirs.

    heights : (i, r, c) float32 m, one surface an image, NaN where it shows none; tolerance : m from the highest to the
    lowest of those that agree; height : (r, c) float32, written, NaN where no image shows the cell; agrees : (i, r, c)
    bool, written, the images that do.
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
