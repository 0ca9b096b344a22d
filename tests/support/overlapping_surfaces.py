"""Surfaces of one analytic town with made-up errors: runs that overlap, and two dates with planted change."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from scipy.ndimage import gaussian_filter

from zlocus.io.vertical import ELLIPSOIDAL_DESCRIPTION

CRS = "EPSG:32632"
CELL_M = 0.5
CORNER = Affine(CELL_M, 0.0, 4e5, 0.0, -CELL_M, 5e6)


def town(rows: int, cols: int) -> np.ndarray:
    """Rolling ground with flat roofs, (r, c) m."""
    r, c = np.mgrid[:rows, :cols].astype(float)
    z = 50.0 + 4.0 * np.sin(r / 60.0) + 3.0 * np.cos(c / 45.0)
    for down, across, height in ((0.2, 0.45, 8.0), (0.5, 0.55, 12.0), (0.7, 0.3, 6.0), (0.35, 0.15, 9.0)):
        top, left = round(down * rows), round(across * cols)
        z[top : top + rows // 10, left : left + cols // 10] += height
    return z


def noise(rng: np.random.Generator, shape: tuple[int, int], reach_cells: float) -> np.ndarray:
    """Errors (r, c) of standard deviation 1 that are alike within `reach_cells`; 0: independent ones."""
    errors = rng.normal(size=shape)
    if reach_cells:
        errors = gaussian_filter(errors, reach_cells, mode="wrap")
    return errors / errors.std()


def stated_sigma(rng: np.random.Generator, shape: tuple[int, int], usual_m: float) -> np.ndarray:
    """Standard deviations (r, c) m that differ from place to place."""
    return usual_m * np.exp(0.4 * noise(rng, shape, 12.0))


def write_raster(path: Path, values: np.ndarray, transform: Affine = CORNER, crs: str | None = CRS, **more) -> Path:
    """A raster of one band. more : `description`, or entries of rasterio's profile."""
    path.parent.mkdir(parents=True, exist_ok=True)
    description = more.pop("description", None)
    profile = {"driver": "GTiff", "count": 1, "dtype": values.dtype.name, "crs": crs, "transform": transform} | more
    with rasterio.open(path, "w", width=values.shape[1], height=values.shape[0], **profile) as file:
        file.write(values, 1)
        if description:
            file.set_band_description(1, description)
    return path


def write_run(folder: Path, z: np.ndarray, sigma: np.ndarray, transform: Affine = CORNER, **layers) -> Path:
    """The folder of a run. layers : further rasters, by their name without its ending."""
    nan = float("nan")
    heights = z.astype(np.float32)
    write_raster(folder / "dsm.tif", heights, transform, nodata=nan, description=ELLIPSOIDAL_DESCRIPTION)
    known = np.where(np.isfinite(z), sigma, np.nan).astype(np.float32)
    write_raster(folder / "sigma.tif", known, transform, nodata=nan)
    for name, values in layers.items():
        write_raster(folder / f"{name}.tif", values, transform)
    return folder


@dataclass(frozen=True)
class TwoRuns:
    """Runs that overlap. folders : of both; z : (2, r, c) m, on the whole grid; truth : (r, c) m; offset_m : of the
    second."""

    folders: tuple[Path, Path]
    z: np.ndarray
    truth: np.ndarray
    offset_m: float


def two_runs(out: Path, seed: int, offset_m: float = 0.6, shape: tuple[int, int] = (180, 240)) -> TwoRuns:
    """Two runs with ragged ends, a hole in each, and a truck that only the second has seen."""
    rng = np.random.default_rng(seed)
    rows, cols = shape
    truth, folders, heights = town(*shape), [], []
    spans = (slice(0, round(0.68 * cols)), slice(round(0.32 * cols), cols))
    for number, (name, span) in enumerate(zip(("west", "east"), spans, strict=True)):
        sigma = stated_sigma(rng, shape, 0.25 + 0.1 * number)
        z = truth + noise(rng, shape, 2.0) * sigma + number * offset_m
        ragged = (6 + 4 * np.sin(np.arange(rows) / 7.0) + rng.integers(0, 5, rows)).astype(int)
        inside = np.zeros(shape, bool)
        inside[:, span] = True
        for row, n in enumerate(ragged):
            end = slice(span.stop - n, span.stop) if number == 0 else slice(span.start, span.start + n)
            inside[row, end] = False
        hole = slice(70 + 60 * number, 86 + 60 * number)
        inside[hole, cols // 2 - 12 : cols // 2 + 6] = False
        z[~inside] = np.nan
        if number:
            z[20:30, cols // 2 : cols // 2 + 12] += 4.0
        moved = CORNER * Affine.translation(span.start, 0)
        folders.append(write_run(out / name, z[:, span], sigma[:, span], moved))
        heights.append(z)
    return TwoRuns((folders[0], folders[1]), np.stack(heights), truth, offset_m)
