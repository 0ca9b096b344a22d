"""Row of the acceptance table on `zlocus align`: planted shifts and tilts on natural ground under woods and noise."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from scipy.ndimage import gaussian_filter, map_coordinates

from seeds import fresh_seeds
from workplace import ZLOCUS, Figure, Workplace, run
from zlocus.synthetic.terrain import Relief, natural_ground

N_SCENES = 5
CELL_M, N_CELLS, RIM_CELLS, N_POINTS = 0.5, 600, 40, 20_000
WEST, NORTH = 461000.0, 5247000.0
RELIEF = Relief(base_m=400.0, relief_m=40.0, longest_m=150.0, roughness=2.4)
# Of the surface and of the points; and of the woods, which the points do not have.
NOISE_M, POINT_NOISE_M, WOODS_SHARE, WOODS_M = 0.05, 0.02, 0.25, 7.0
# Shifts are planted up to so far, heights, and tilts from the middle to an edge.
SHIFT_M, UP_M, TILT_M = 4.0, 2.0, 0.6
BAR_M = 0.01


def align(workplace: Workplace) -> list[Figure]:
    """Offsets that `zlocus align` finds less those that were planted, the largest of all scenes."""
    seeds = fresh_seeds(N_SCENES)
    workplace.inputs["seeds"] = seeds
    found = [_of_scene(workplace.out / f"scene{seed}", seed) for seed in seeds]
    largest = {name: max(abs(scene[name]) for scene in found) for name in found[0]}
    faults = {
        "shift": "slopes that are noise pull the shift, or trees have weight",
        "up": "trees have weight in the height", "tilt": "trees have weight in the tilt, or it is not removed",
    }  # fmt: skip
    figures = [
        Figure(f"{name}, largest", value, "m", at_most=BAR_M, fails_when=faults[name.rpartition(" ")[2]])
        for name, value in largest.items()
        if not name.endswith("sigmas")
    ]
    figures += [Figure(f"{name}, largest", value) for name, value in largest.items() if name.endswith("sigmas")]
    flat = sum(_flat_is_taken(workplace.out / f"flat{seed}", seed) for seed in seeds)
    return [*figures, Figure(
        "flat ground: horizontal shifts that were taken", float(flat), at_most=0.0,
        fails_when="noise is taken for relief",
    )]  # fmt: skip


def _ground(seed: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Height, m, at places east and south of the corner, m: a spline through natural ground."""
    side = N_CELLS + 2 * RIM_CELLS
    natural = natural_ground(seed, (0.0, 0.0), CELL_M, (side, side), RELIEF, texel_m=1.0)
    z = gaussian_filter(natural.planes[..., 0].astype(float), 2.0)
    return lambda east, south: map_coordinates(
        z, [south / CELL_M - 0.5 + RIM_CELLS, east / CELL_M - 0.5 + RIM_CELLS], order=3
    )


def _of_scene(out: Path, seed: int) -> dict[str, float]:
    """How far the offsets of a scene are off, m, and in standard deviations: at points, with a tilt, on a surface."""
    out.mkdir(parents=True, exist_ok=True)
    random, ground = np.random.default_rng(seed), _ground(seed)
    planted = np.array([*random.uniform(-SHIFT_M, SHIFT_M, 2), random.uniform(-UP_M, UP_M)])
    tilt = random.uniform(-TILT_M, TILT_M, 2)
    east, south = np.meshgrid(*[(np.arange(N_CELLS) + 0.5) * CELL_M] * 2)
    woods = gaussian_filter(random.normal(size=east.shape), 10)
    woods = woods > np.quantile(woods, 1 - WOODS_SHARE)
    seen = ground(east - planted[0], south + planted[1]) + planted[2] + WOODS_M * woods
    seen += random.normal(0, NOISE_M, east.shape)
    half = N_CELLS * CELL_M / 2
    raster(out / "dsm.tif", seen)
    raster(out / "tilted.tif", seen + tilt[0] * (east / half - 1) - tilt[1] * (south / half - 1))
    raster(out / "reference.tif", ground(east, south) + random.normal(0, POINT_NOISE_M, east.shape))
    at = random.uniform(5, N_CELLS * CELL_M - 5, (2, N_POINTS))
    z = ground(*at) + random.normal(0, POINT_NOISE_M, N_POINTS)
    table = np.column_stack([WEST + at[0], NORTH - at[1], z])
    np.savetxt(out / "points.csv", table, "%.4f", ",", header="x,y,z", comments="")
    found: dict[str, float] = {}
    for name, surface, reference, options in (
        ("points", "dsm.tif", "points.csv", []), ("surface", "dsm.tif", "reference.tif", []),
        ("points with tilt", "tilted.tif", "points.csv", ["--tilt"]),
    ):  # fmt: skip
        record = aligned(out / surface, out / reference, out / name.replace(" ", "-"), options)
        offset = np.array([record["offset_m"][axis] or 0.0 for axis in ("east", "north", "up")])
        if record["tilt"] is not None:
            # The height is that at the centre of the points, and the tilt was planted in the surface as it lies.
            centre = (np.array(record["centre"]) + planted[:2] - (WEST + half, NORTH - half)) / half
            slopes = np.array([record["tilt"][f"{axis}_m_per_km"] for axis in ("east", "north")]) * half / 1000
            offset[2] -= centre @ tilt
            found[f"{name}: tilt"] = 2 * float(np.abs(slopes - tilt).max())
        off = offset - planted
        sigma_m = np.array([record["sigma_m"][axis] or np.inf for axis in ("east", "north", "up")])
        found[f"{name}: shift"] = float(np.hypot(*off[:2]))
        found[f"{name}: up"] = float(off[2])
        found[f"{name}: off in sigmas"] = float(np.abs(off / sigma_m).max())
    return found


def _flat_is_taken(out: Path, seed: int) -> bool:
    """Whether a horizontal shift is taken on flat ground under noise that is alike over some cells."""
    out.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    noise = gaussian_filter(random.normal(size=(N_CELLS, N_CELLS)), 3)
    raster(out / "dsm.tif", 400 + NOISE_M * noise / noise.std())
    at = random.uniform(5, N_CELLS * CELL_M - 5, (2, N_POINTS // 10))
    table = np.column_stack([WEST + at[0], NORTH - at[1], np.full(at.shape[1], 400.0)])
    np.savetxt(out / "points.csv", table, "%.4f", ",", header="x,y,z", comments="")
    return aligned(out / "dsm.tif", out / "points.csv", out / "aligned", [])["horizontal_undetermined"] is None


def aligned(surface: Path, reference: Path, out: Path, options: list[str]) -> dict:
    """The entry `alignment` of run.json of an aligned surface."""
    run([ZLOCUS, "align", surface, reference, "-o", out, "--overwrite", *options])
    return json.loads((out / "run.json").read_text())["alignment"]


def raster(path: Path, z: np.ndarray) -> None:
    """Write heights on the grid of the scene."""
    with rasterio.open(
        path, "w", driver="GTiff", width=N_CELLS, height=N_CELLS, count=1, dtype="float32", crs="EPSG:32632",
        transform=Affine(CELL_M, 0, WEST, 0, -CELL_M, NORTH), nodata=float("nan"),
    ) as file:  # fmt: skip
        file.write(z.astype(np.float32), 1)
