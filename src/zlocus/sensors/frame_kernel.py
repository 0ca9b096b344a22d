"""The image of a frame camera, ray by ray, and the way back through its lens.

Projection tables of close cameras take hundreds of millions of rays. In plain NumPy each takes ten times as long.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.jit import kernel

MAX_ITERATIONS = 50
# Relative size of the last Newton step, and largest remaining error of a position that counts as found.
CONVERGED_STEP = 1e-14
MAX_ERROR = 1e-11
MIN_RADIUS = 1e-300


class CameraNumbers(NamedTuple):
    """A frame camera at rest, see `zlocus.sensors.frame.FrameModel`."""

    rotation: NDArray[np.float64]  # (3,3) f8: rows are the axes of the camera
    focal: float  # f8: px, along rows
    aspect: float  # f8: focal length down the columns over `focal`
    column: float  # f8: of the principal point, px
    row: float  # f8: of the principal point, px
    skew: float  # f8: px


class LensNumbers(NamedTuple):
    """Distortion of a lens, see `zlocus.sensors.distortion.BrownDistortion`; an ideal lens has only zeros."""

    k1: float  # f8: radial
    k2: float  # f8: radial
    p1: float  # f8: tangential
    p2: float  # f8: tangential
    k3: float  # f8: radial
    k4: float  # f8: radial, below the line
    k5: float  # f8: radial, below the line
    k6: float  # f8: radial, below the line
    radius_squared: float  # f8: of the disc that is mapped one to one; infinite for an ideal lens


# (n,3) f8, CameraNumbers, LensNumbers, (n,2) f8 -> None
@kernel
def image_of_rays(rays, camera, lens, out):
    """Write the image position (column, row) px of each ray from the projection centre, of any length.

    NaN behind the camera, and outside of the disc that the lens maps one to one. Source: as for `BrownDistortion`.
    """
    axes = camera.rotation
    for n in range(rays.shape[0]):
        a, b, c = rays[n, 0], rays[n, 1], rays[n, 2]
        depth = axes[2, 0] * a + axes[2, 1] * b + axes[2, 2] * c
        x = (axes[0, 0] * a + axes[0, 1] * b + axes[0, 2] * c) / depth
        y = (axes[1, 0] * a + axes[1, 1] * b + axes[1, 2] * c) / depth
        r2 = x * x + y * y
        if not (depth > 0.0 and r2 <= lens.radius_squared):
            out[n, 0], out[n, 1] = np.nan, np.nan
            continue
        above = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
        factor = above / (1.0 + r2 * (lens.k4 + r2 * (lens.k5 + r2 * lens.k6)))
        real_x = x * factor + 2.0 * lens.p1 * x * y + lens.p2 * (r2 + 2.0 * x * x)
        real_y = y * factor + lens.p1 * (r2 + 2.0 * y * y) + 2.0 * lens.p2 * x * y
        out[n, 0] = real_x * camera.focal + camera.skew * real_y + camera.column
        out[n, 1] = real_y * camera.focal * camera.aspect + camera.row


# (n,2) f8, LensNumbers, (n,2) f8 -> None
@kernel
def ideal_positions(real, lens, ideal):
    """Write the ideal position of each real one, NaN where no position of the disc is mapped.

    ideal : first guesses, inside of the disc. Newton's method, whose positions are kept in the disc.
    """
    rim, p1, p2 = np.sqrt(lens.radius_squared), lens.p1, lens.p2
    for n in range(real.shape[0]):
        x, y, is_last = ideal[n, 0], ideal[n, 1], False
        for _ in range(MAX_ITERATIONS + 1):
            r2 = x * x + y * y
            above = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
            below = 1.0 + r2 * (lens.k4 + r2 * (lens.k5 + r2 * lens.k6))
            # The radial factor and its derivative by the squared radius.
            factor, rise = above / below, lens.k1 + r2 * (2.0 * lens.k2 + r2 * 3.0 * lens.k3)
            fall = lens.k4 + r2 * (2.0 * lens.k5 + r2 * 3.0 * lens.k6)
            slope = (rise * below - above * fall) / (below * below)
            dx = real[n, 0] - (x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
            dy = real[n, 1] - (y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
            if is_last:
                break
            xx = factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            yy = factor + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            xy = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            determinant = xx * yy - xy * xy
            by_x, by_y = (yy * dx - xy * dy) / determinant, (xx * dy - xy * dx) / determinant
            x, y = x + by_x, y + by_y
            radius = np.hypot(x, y)
            kept = min(1.0, rim / max(radius, MIN_RADIUS))
            x, y, largest = x * kept, y * kept, CONVERGED_STEP * (1.0 + radius)
            is_last = not (abs(by_x) > largest or abs(by_y) > largest)
        largest = MAX_ERROR * (1.0 + np.hypot(real[n, 0], real[n, 1]))
        is_found = abs(dx) <= largest and abs(dy) <= largest
        ideal[n, 0], ideal[n, 1] = (x, y) if is_found else (np.nan, np.nan)
