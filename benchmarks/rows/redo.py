"""Row of the acceptance table on parts of a surface that are redone: what changes outside them, and after a kill."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from pyogrio.raw import write as write_vector
from rasterio.features import rasterize, shapes

from seeds import fresh_seeds
from workplace import ZLOCUS, Figure, Workplace, render, rendered_images, run

N_TOWNS, SIDE_CELLS, N_KILLS = 3, 200, 8
CELL_M = 0.5
VIEWS = ("n1", "f1", "b1")
RASTERS = ("dsm", "sigma", "quality", "views", "ortho", "water")
# Several tiles in each town.
TILES = ("--set", "pyramid.tile=96")
OTHER_OPTIONS = ("--set", "semiglobal.p2=60", "--set", "checks.min_ncc=0.3")
BUILDING = 2
# Cells so far on both sides of an outline, m, are near it; right is a height that is off by less.
NEAR_M, RIGHT_M = 2.0, 1.0


def redo(workplace: Workplace) -> list[Figure]:
    """Parts of rendered towns that are redone in four ways, and commands that are killed."""
    seeds = fresh_seeds(N_TOWNS)
    workplace.inputs["seeds"] = seeds
    outside, inside, right = dict[str, int](), dict[str, int](), {"before": list[float](), "after": list[float]()}
    for seed in seeds:
        scene, base = workplace.out / f"town{seed}", workplace.out / f"town{seed}-surface"
        render(scene, "city", SIDE_CELLS, "--seed", seed)
        command = [ZLOCUS, "dsm", *rendered_images(scene, VIEWS), "-q", "--no-report", "--products", "none", *TILES]
        run([*command, "-o", base, "--resolution", CELL_M, "--overwrite"])
        area, roofs = write_area(base, seed), write_outlines(scene)
        ways: dict[str, list[Any]] = {
            "the same options": [], "other options": [*OTHER_OPTIONS], "outlines of roofs": ["--break-lines", roofs],
            "a level": ["--level", level_of(base)],
        }  # fmt: skip
        if not shapely.intersects(geometries(area)[0], geometries(roofs)).any():  # no roof stands there
            del ways["outlines of roofs"]
        for way, options in ways.items():
            out = workplace.out / f"town{seed}-redone"
            shutil.rmtree(out, ignore_errors=True)
            shutil.copytree(base, out)
            run([*command, "-o", out, "--redo", area, *options])
            changed, is_inside = changed_cells(base, out), cells_of(area, base)
            outside[way] = outside.get(way, 0) + int((changed & ~is_inside).sum())
            inside[way] = inside.get(way, 0) + int((changed & is_inside).sum())
            if way == "outlines of roofs":
                right["before"].append(right_near_outlines(base, scene, area))
                right["after"].append(right_near_outlines(out, scene, area))
    mixed = kills(workplace, [*command, "--redo", area, *OTHER_OPTIONS], base, seeds[0])
    return [
        *(
            Figure(
                f"cells outside that change: {way}", float(n), at_most=0.0,
                fails_when="cells beside the polygons are blended or encoded anew",
            )
            for way, n in outside.items()
        ),
        Figure(
            "cells inside that change: the same options", float(inside["the same options"]), at_most=0.0,
            fails_when="cameras, lattice or tiles are not those of the run",
        ),
        *(
            Figure(f"cells inside that change: {way}", float(n), is_detail=True)
            for way, n in inside.items()
            if way != "the same options"
        ),
        Figure(
            f"{N_KILLS} commands killed: folders that hold parts of two surfaces", float(mixed), at_most=0.0,
            fails_when="files are replaced one by one",
        ),
        Figure("near outlines of roofs, within 1 m: as they were", float(np.mean(right["before"]))),
        Figure("near outlines of roofs, within 1 m: with outlines as break lines", float(np.mean(right["after"]))),
    ]  # fmt: skip


def write_area(surface: Path, seed: int) -> Path:
    """Write a polygon that covers about a quarter of a surface, and return its path."""
    with rasterio.open(surface / "dsm.tif") as file:
        west, south, east, north = file.bounds
    rng = np.random.default_rng(seed)
    angles, radius = np.sort(rng.uniform(0, 2 * np.pi, 9)), min(east - west, north - south) * rng.uniform(0.3, 0.45, 9)
    centre = np.array([(west + east) / 2, (south + north) / 2])
    corners = centre + radius[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    path = surface.with_name(f"{surface.name}-area.gpkg")
    polygon = shapely.Polygon(corners).buffer(0)
    write_vector(path, shapely.to_wkb(np.array([polygon], object)), [], [], geometry_type="Unknown", crs="EPSG:32632")
    return path


def write_outlines(scene: Path) -> Path:
    """Write the outlines of the buildings of a scene as lines without heights, and return their path."""
    with rasterio.open(scene / "truth_class.tif") as file:
        is_roof = (file.read(1) == BUILDING).astype(np.uint8)
        found = [shapely.geometry.shape(shape) for shape, _ in shapes(is_roof, is_roof > 0, transform=file.transform)]
    lines = shapely.get_parts(shapely.boundary(np.array(found, object)))
    path = scene / "outlines.gpkg"
    write_vector(path, shapely.to_wkb(lines), [], [], geometry_type="LineString", crs="EPSG:32632")
    return path


def level_of(surface: Path) -> float:
    """A height of a surface, m."""
    with rasterio.open(surface / "dsm.tif") as file:
        return round(float(np.nanmedian(file.read(1))), 2)


def geometries(path: Path) -> np.ndarray:
    """Geometries (n,) of a vector file."""
    from pyogrio.raw import read

    return np.asarray(shapely.from_wkb(read(path)[2]))


def cells_of(area: Path, surface: Path) -> np.ndarray:
    """Cells (r, c) of a surface whose centres lie inside the polygon of a file."""
    (polygon,) = geometries(area)
    with rasterio.open(surface / "dsm.tif") as file:
        return rasterize([polygon], out_shape=file.shape, transform=file.transform, dtype="uint8") > 0


def changed_cells(before: Path, after: Path) -> np.ndarray:
    """Cells (r, c) in which any raster of two surfaces has other bytes, or another mask."""
    changed = None
    for name in RASTERS:
        with rasterio.open(before / f"{name}.tif") as one, rasterio.open(after / f"{name}.tif") as other:
            cells = [np.concatenate([file.read(), file.read_masks().astype(file.dtypes[0])]) for file in (one, other)]
        bits = [each.view(f"u{each.dtype.itemsize}") for each in cells]
        differs = (bits[0] != bits[1]).any(axis=0)
        changed = differs if changed is None else changed | differs
    assert changed is not None, "there are rasters"
    return changed


def right_near_outlines(surface: Path, scene: Path, area: Path) -> float:
    """Share of the cells inside an area and near outlines of buildings whose height is right."""
    with rasterio.open(surface / "dsm.tif") as file, rasterio.open(scene / "truth_dsm.tif") as truth:
        heights, transform = file.read(1), file.transform
        col, row = np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
        x, y = transform * (col, row)
        true_col, true_row = (np.floor(each).astype(int) for each in ~truth.transform * (x, y))
        known = (true_col >= 0) & (true_row >= 0) & (true_col < truth.width) & (true_row < truth.height)
        true = np.full(heights.shape, np.nan)
        true[known] = truth.read(1)[true_row[known], true_col[known]]
    judged = near_outlines(surface, scene, area) & known
    return float((np.abs(heights - true)[judged] < RIGHT_M).sum() / judged.sum())


def near_outlines(surface: Path, scene: Path, area: Path) -> np.ndarray:
    """Cells (r, c) of a surface inside an area and near outlines of buildings."""
    lines = geometries(scene / "outlines.gpkg")
    with rasterio.open(surface / "dsm.tif") as file:
        near = rasterize(shapely.buffer(lines, NEAR_M), out_shape=file.shape, transform=file.transform, dtype="uint8")
    return (near > 0) & cells_of(area, surface)


def kills(workplace: Workplace, command: list[Any], base: Path, seed: int) -> int:
    """Kill a command at random times, and return how often the folder holds neither the old nor a whole new surface."""
    out, mixed, rng = workplace.out / "killed", 0, random.Random(seed)
    words = [str(word) for word in (*command, "-o", out)]
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(base, out)
    begun = time.perf_counter()
    subprocess.run(words, check=True)
    whole_s = time.perf_counter() - begun
    for _ in range(N_KILLS):
        for folder in (out, out.with_name(f".{out.name}.redo")):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(base, out)
        old = checksums(out)
        with subprocess.Popen(words) as process:
            time.sleep(whole_s * rng.uniform(0.5, 1.0))
            process.kill()
        mixed += not (out.is_dir() and (checksums(out) == old or is_whole(out)))
    return mixed


def checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of each file."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.is_file()}


def is_whole(folder: Path) -> bool:
    """Whether a folder holds a redone surface whose files are those that it records."""
    found, recorded = checksums(folder), json.loads((folder / "finished.json").read_text())["products"]
    run_record = json.loads((folder / "run.json").read_text())
    named = {name: digest for name, digest in recorded.items() if not name.endswith(".gpkg")}
    return len(run_record.get("redone", [])) == 1 and all(found.get(name) == digest for name, digest in named.items())
