"""Time, memory and size of clouds of points as LAZ and as COPC.

    python benchmarks/cloud_files.py [--million N ...] [-o FOLDER]

The points are those of a hilly surface, row after row, with a little noise. COPC is made of the LAZ file, as
`zlocus cloud --copc` makes it. Each file is written by a process of its own, whose memory is told.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
from pyproj import CRS

from zlocus.products.point_cloud import PointCloud, write_cloud_copc

CELL_M, ROWS_AT_A_TIME, NOISE_M, SEED = 0.5, 100, 0.1, 5
MILLION = 1e6


def write_laz(folder: Path, million: float) -> None:
    """cloud.laz, and cloud.ply beside it, of a surface of about so many cells."""
    side = round((million * MILLION) ** 0.5)
    rng, col = np.random.default_rng(SEED), np.arange(side)
    with PointCloud(folder, CRS.from_epsg(32632)) as cloud:
        for first in range(0, side, ROWS_AT_A_TIME):
            x, y = (each.ravel() for each in np.meshgrid(col, np.arange(first, min(first + ROWS_AT_A_TIME, side))))
            z = 300 + 20 * np.sin(x / 90) + 20 * np.cos(y / 70) + rng.normal(0, NOISE_M, len(x))
            xyz = np.column_stack([500_000 + CELL_M * x, 5_000_000 - CELL_M * y, z])
            grey = (30_000 + 300 * z + rng.normal(0, 500, len(x))).clip(0, 65535).astype(np.uint16)
            sigma = np.full(len(x), 0.2) + 0.1 * rng.random(len(x))
            cloud.write(1, xyz, np.column_stack([grey] * 3), sigma, rng.integers(2, 9, len(x)).astype(np.uint8))


def write_copc(folder: Path, million: float) -> None:
    """cloud.copc.laz of the points of cloud.laz."""
    write_cloud_copc(folder)


WRITERS = {"cloud.laz": write_laz, "cloud.copc.laz": write_copc}


def timed(name: str, folder: Path, million: float) -> tuple[float, float]:
    """Wall time, s, and peak memory, MB, of a process that writes a file."""
    start = time.perf_counter()
    WRITERS[name](folder, million)
    return time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def main() -> None:
    """Write the files, and print a table."""
    parser = argparse.ArgumentParser(description="Time, memory and size of clouds of points as LAZ and as COPC.")
    parser.add_argument("--million", type=float, nargs="+", default=[1, 10], help="points, in millions")
    parser.add_argument("-o", "--out", type=Path, help="where the files are written, and left")
    options = parser.parse_args()
    print("| million points | file | s | s per million | MB of memory | bytes per point |\n|---|---|---|---|---|---|")
    for million in options.million:
        with tempfile.TemporaryDirectory() as scratch:
            folder = options.out or Path(scratch)
            folder.mkdir(parents=True, exist_ok=True)
            for name in WRITERS:
                with multiprocessing.get_context("spawn").Pool(1) as pool:
                    seconds, memory_mb = pool.apply(timed, (name, folder, million))
                size = (folder / name).stat().st_size / (million * MILLION)
                figures = f"{seconds:.1f} | {seconds / million:.2f} | {memory_mb:.0f} | {size:.1f}"
                print(f"| {million:g} | `{name}` | {figures} |")


if __name__ == "__main__":
    main()
