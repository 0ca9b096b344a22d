"""Rolling ground as a surface, with a planted offset, and points of the same ground."""

from __future__ import annotations

import numpy as np

from evaluation_rasters import CELL_M, NORTH, WEST, moved, rolling
from point_files import csv

# Cells along a side, and its length.
N = 400
SIDE_M = N * CELL_M
PLANTED = (1.23, -2.68, 0.75)


def tilted(z, east_m, north_m):
    """Heights with a tilt: by so much at the eastern and the northern edge, and by as much less at the others."""
    across = (np.arange(N) + 0.5) / N * 2 - 1
    return z + east_m * across[None, :] - north_m * across[:, None]


def surface(folder, planted=PLANTED, change=lambda z: z, ground=rolling, name="dsm.tif"):
    return moved(folder / name, N, planted, ground, change)


def ground_points(n, seed=0, ground=rolling, rim_m=5.0):
    """True places and heights (n, 3)."""
    east, south = np.random.default_rng(seed).uniform(rim_m, SIDE_M - rim_m, (2, n))
    return np.column_stack([WEST + east, NORTH - south, ground(east, south)])


def table(folder, n=1500, seed=0, ground=rolling, name="points.csv", **columns):
    xyz = ground_points(n, seed, ground)
    return csv(folder / name, {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **columns})
