"""Rows of the acceptance table on finished surfaces: runs joined by `zlocus mosaic`, and `zlocus change` between them.

Two surfaces of each of ten rendered towns are made from three images each, none of them in both. The mosaic joins the
western part of one and the eastern part of the other. For the change, hills and pits are planted into the second.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pyogrio.raw
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.windows import Window

from seeds import fresh_seeds, over_seeds
from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, rendered_images, run

VIEWS = {"first": ("n1", "f1", "b1"), "second": ("n2", "f2", "b2")}
TOWN_CELLS, CELL_M = 300, 0.5
# Parts of the columns that the western and the eastern surface have.
WEST, EAST = (0.0, 0.64), (0.36, 1.0)
# An offset that the eastern surface gets.
OFFSET_M = 0.4
# Planted changes: place as shares of rows and columns, half the side of the polygon in cells, and height, m.
PLANTED = ((0.25, 0.25, 24, 2.0), (0.7, 0.3, 18, -0.8), (0.3, 0.75, 30, 0.3), (0.75, 0.75, 12, 1.0))
RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")


def mosaic(workplace: Workplace) -> list[Figure]:
    """The step along the seam of two overlapping runs, and what joining does to the heights of the overlap."""
    seeds = fresh_seeds()
    workplace.inputs["seeds"] = seeds
    return over_seeds(seeds, lambda seed: _mosaic_of_town(workplace.out, seed), ("within",))


def change(workplace: Workplace) -> list[Figure]:
    """How often a planted volume lies in its interval, and how often unchanged cells are called changed."""
    seeds = fresh_seeds()
    workplace.inputs["seeds"] = seeds
    found = [_change_of_town(workplace.out, seed) for seed in seeds]
    errors = np.array([each[0] for each in found])
    share = float(np.mean(np.abs(errors) < 1.0))
    return [
        Figure(
            "planted volumes inside their 68 % interval", share, at_least=0.55, at_most=0.80,
            fails_when="errors that many cells share are taken as independent, or the other way round",
        ),
        Figure("errors of volumes in standard deviations, median size", float(np.median(np.abs(errors)))),
        Figure("errors of volumes in standard deviations, largest: a mismatch", float(np.abs(errors).max())),
        Figure(
            "unchanged cells called changed at 5 %, worst town", max(each[1] for each in found), at_most=0.06,
            fails_when="stated standard deviations are believed without a look at unchanged ground",
        ),
        Figure("the same, mean", float(np.mean([each[1] for each in found])), is_detail=True),
    ]  # fmt: skip


def towns(out: Path, seed: int) -> dict[str, Path]:
    """Two surfaces of a rendered town."""
    scene = out / f"town{seed}"
    if not (scene / "scene.json").exists():
        command = [sys.executable, "-m", "zlocus.synthetic", "-o", scene, "--kind", "city", "--size", TOWN_CELLS]
        run([*command, "--views", 6, "--seed", seed])
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        area = ["--resolution", CELL_M, "--crs", truth.crs.to_string(), "--bounds", *truth.bounds]
    folders = {}
    for name, views in VIEWS.items():
        folders[name] = scene / name
        if not (scene / name / "run.json").exists():
            images = rendered_images(scene, views)
            run([ZLOCUS, "dsm", *images, "-o", scene / name, *area, "--no-report"], accept=(0, COVERAGE_SHORT))
    return folders


def _mosaic_of_town(out: Path, seed: int) -> list[Figure]:
    folders = towns(out, seed)
    scene = folders["first"].parent
    west, east = (
        cropped(folders[name], scene / part, *columns, add_m)
        for name, part, columns, add_m in (("first", "west", WEST, 0.0), ("second", "east", EAST, OFFSET_M))
    )
    joined = scene / "joined"
    run([ZLOCUS, "mosaic", west, east, "-o", joined, "--overwrite"])
    record = json.loads((joined / "run.json").read_text())
    removed = [each["offset_removed_m"] for each in record["runs"]]
    heights, sigma, source = (read(joined / name) for name in ("dsm.tif", "sigma.tif", "source.tif"))
    runs = np.stack([
        on_grid(folder / "dsm.tif", joined / "dsm.tif") - m for folder, m in zip((west, east), removed, strict=True)
    ])  # fmt: skip
    steps = seam_steps(heights, runs, source) / larger_of_neighbours(sigma)
    truth = on_grid(scene / "truth_dsm.tif", joined / "dsm.tif")
    both = np.isfinite(runs).all(axis=0) & np.isfinite(heights) & np.isfinite(truth)
    within = {
        name: float(np.mean(np.abs(z - truth)[both] < 0.5))
        for name, z in (("joined", heights), ("west", runs[0]), ("east", runs[1]))
    }
    return [
        Figure(
            "step along the seam, 95th percentile, standard deviations",
            float(np.nanpercentile(steps[np.isfinite(steps)], 95)), at_most=0.3,
            fails_when="a run begins or ends with its full weight, or a hole of one run is filled without a transition",
        ),
        Figure("planted offset found, error", abs(removed[1] - OFFSET_M), "m", is_detail=True),
        Figure("within 0.5 m in the overlap, joined", within["joined"]),
        Figure("within 0.5 m in the overlap, better of both runs", max(within["west"], within["east"])),
    ]  # fmt: skip


def _change_of_town(out: Path, seed: int) -> tuple[list[float], float]:
    """Errors of planted volumes in their standard deviations, and share of unchanged cells that are called changed."""
    folders = towns(out, seed)
    scene = folders["first"].parent
    later = cropped(folders["second"], scene / "later", 0.0, 1.0, 0.0)
    with rasterio.open(later / "dsm.tif", "r+") as file:
        heights, transform, crs = file.read(1), file.transform, file.crs.to_wkt()
        polygons, volumes, planted = [], [], np.zeros(heights.shape)
        row, col = np.indices(heights.shape)
        for down, across, half, height_m in PLANTED:
            r, c = round(down * file.height), round(across * file.width)
            inside = (np.abs(row - r) <= half) & (np.abs(col - c) <= half)
            hill = height_m * np.exp(-((row - r) ** 2 + (col - c) ** 2) / (half / 2) ** 2)
            planted += np.where(inside, hill, 0.0)
            volumes.append(float(np.where(inside, hill, 0.0).sum()) * CELL_M**2)
            (left, top), (right, bottom) = transform * (c - half, r - half), transform * (c + half + 1, r + half + 1)
            polygons.append(shapely.box(left, bottom, right, top))
        file.write((heights + planted).astype(np.float32), 1)
    area, result = scene / "area.gpkg", scene / "changed"
    area.unlink(missing_ok=True)
    numbers = np.arange(len(polygons))
    pyogrio.raw.write(
        area, shapely.to_wkb(np.array(polygons)), [numbers], ["place"], geometry_type="Polygon", crs=crs, driver="GPKG"
    )
    run([ZLOCUS, "change", folders["first"], later, "-o", result, "--area", area, "--overwrite"])
    found = json.loads((result / "change.json").read_text())["volumes"]
    errors = [(each["volume_m3"] - volume) / each["sigma_m3"] for each, volume in zip(found, volumes, strict=True)]
    unchanged = read(result / "class.tif")[planted == 0]
    known = unchanged > 0
    return errors, float(np.mean(unchanged[known] > 1))


def cropped(folder: Path, to: Path, first: float, last: float, add_m: float) -> Path:
    """A part of the columns of a surface, with something added to its heights."""
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir()
    for name in RASTERS:
        with rasterio.open(folder / name) as file:
            col, width = round(first * file.width), round(last * file.width) - round(first * file.width)
            window = Window(col, 0, width, file.height)
            profile = file.profile | {"driver": "GTiff", "width": width, "transform": file.window_transform(window)}
            values = file.read(window=window)
            with rasterio.open(to / name, "w", **profile) as copy:
                copy.write(values + np.float32(add_m) if name == "dsm.tif" else values)
                copy.descriptions = file.descriptions
    shutil.copy(folder / "run.json", to / "run.json")
    return to


def read(path: Path) -> NDArray[np.float64]:
    """The first band of a raster."""
    with rasterio.open(path) as file:
        return file.read(1).astype(float)


def on_grid(path: Path, like: Path) -> NDArray[np.float64]:
    """Cells of a raster on the grid of another one: where grids differ in size, the cell at the centre."""
    with rasterio.open(like) as grid, rasterio.open(path) as file:
        row, col = np.indices(grid.shape) + 0.5
        x, y = grid.transform.c + col * grid.transform.a, grid.transform.f + row * grid.transform.e
        cols = np.floor((x - file.transform.c) / file.transform.a).astype(int)
        rows = np.floor((y - file.transform.f) / file.transform.e).astype(int)
        values = file.read(1).astype(float)
    inside = (rows >= 0) & (rows < values.shape[0]) & (cols >= 0) & (cols < values.shape[1])
    return np.where(inside, values[np.where(inside, rows, 0), np.where(inside, cols, 0)], np.nan)


def seam_steps(
    joined: NDArray[np.float64], runs: NDArray[np.float64], source: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Steps (2, r, c) m between neighbours, down and to the right, by which a mosaic exceeds those of its runs.

    joined : (r, c) m; runs : (n, r, c) m, NaN where a run has no height; source : (r, c) number of the chosen run. NaN
    away from the seams: where neither the runs that have a height nor the chosen one change.
    """
    steps = np.full((2, *joined.shape), np.nan)
    there = np.isfinite(runs)
    for axis in (0, 1):
        here, beyond = [slice(None)] * 2, [slice(None)] * 2
        here[axis], beyond[axis] = slice(0, -1), slice(1, None)
        p, q = tuple(here), tuple(beyond)
        of_runs = runs[(slice(None), *q)] - runs[(slice(None), *p)]
        step = joined[q] - joined[p]
        known = np.isfinite(of_runs).any(axis=0) & np.isfinite(step)
        low, high = (np.where(known, extreme(of_runs), np.nan) for extreme in (_lowest, _highest))
        is_seam = (there[(slice(None), *p)] != there[(slice(None), *q)]).any(axis=0) | (source[p] != source[q])
        beside = np.maximum(np.maximum(low - step, step - high), 0.0)
        steps[(axis, *p)] = np.where(known & is_seam, beside, np.nan)
    return steps


def _lowest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), values, np.inf).min(axis=0)


def _highest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), values, -np.inf).max(axis=0)


def larger_of_neighbours(sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    """The larger standard deviation (2, r, c) of a cell and its neighbour below, and to the right."""
    out = np.full((2, *sigma.shape), np.nan)
    out[0, :-1] = np.fmax(sigma[:-1], sigma[1:])
    out[1, :, :-1] = np.fmax(sigma[:, :-1], sigma[:, 1:])
    return out
