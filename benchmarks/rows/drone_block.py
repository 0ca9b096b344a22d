"""Row of the acceptance table on a rendered block of drone images, whose lens, ground and truth are exact.

The surface is judged cell by cell. Its cells are three cells of the truth wide and lie on them, so each has nine true
heights. Judges of surfaces of satellites average half a metre, over which every steep roof counts as an edge.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import from_bounds

from rows.resources import of_all_processes
from workplace import COVERAGE_SHORT, ZLOCUS, CannotRun, Figure, Workplace, run
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.statistics import ErrorStatistics, error_statistics
from zlocus.evaluation.truth import CLASS_NAMES, places
from zlocus.synthetic.drone_block import DroneBlockSpec, render_drone_block

# Side of the area in the middle of the block that is matched, in metres; the whole block is about 200 m wide.
AREA_M = 96.0
# Cells of the truth along a side of a cell of the surface.
TRUTH_CELLS = 3
LIMITS_M = (0.1, 0.3, 1.0, 3.0)
# A cell in which true heights differ by more holds an edge, either side of which is right.
EDGE_M = 0.2
# In a margin around the area the truth is kept, so that a shifted surface finds it.
SHIFT_MARGIN_M = 5.0


def drone_block(workplace: Workplace, spec: DroneBlockSpec | None = None, area_m: float = AREA_M) -> list[Figure]:
    """Accuracy and cost of a surface of a block of 20 frames of 12 megapixels, in the middle of the block.

    spec : None for that block; area_m : side of the area. The block is rendered into the folder of the row. A block of
    the same specification that lies there is used again.
    """
    spec = DroneBlockSpec() if spec is None else spec
    scene, out = workplace.out / "block", workplace.out / "dsm"
    workplace.inputs["seeds"] = [spec.seed]
    _provide_block(spec, scene)
    bounds = _area(scene / "truth_dsm.tif", spec, area_m)
    resolution = TRUTH_CELLS * spec.step_m
    command = [ZLOCUS, "dsm", scene / "scene.yaml", "-o", out, "--resolution", resolution, "--bounds", *bounds]
    run([*command, "--workers", 1, "--no-report", "--overwrite"], accept=(0, COVERAGE_SHORT))
    record = json.loads((out / "run.json").read_text())
    judged = workplace.out / "judged"
    _cut_truth(scene, bounds, judged)
    figures = accuracy(out / "dsm.tif", judged)
    million_cells = (area_m / resolution) ** 2 / 1e6
    cpu, memory = of_all_processes(record)
    return [
        *figures,
        Figure("ground pixel", spec.ground_pixel_m, "m"),
        Figure("cell", resolution, "m"),
        Figure("million cells", million_cells),
        Figure("CPU per million cells", cpu.value / million_cells, "s"),
        cpu,
        memory,
    ]


def _provide_block(spec: DroneBlockSpec, scene: Path) -> None:
    """Render the block, unless the folder holds one of the same specification."""
    if not scene.exists():
        render_drone_block(spec, scene)
        return
    described = scene / "scene.json"
    if not described.exists() or json.loads(described.read_text()).get("spec") != json.loads(json.dumps(asdict(spec))):
        raise CannotRun(f"{scene} holds another scene; remove it")


def _area(truth: Path, spec: DroneBlockSpec, side_m: float) -> tuple[float, float, float, float]:
    """Bounds of a square in the middle of a block that begins at a corner of a cell of the truth."""
    with rasterio.open(truth) as source:
        west, north = source.transform.c, source.transform.f
    step = spec.step_m
    left = west + round((spec.east_m - side_m / 2 - west) / step) * step
    top = north - round((north - spec.north_m - side_m / 2) / step) * step
    return left, top - side_m, left + side_m, top


def _cut_truth(scene: Path, bounds: tuple[float, float, float, float], folder: Path) -> None:
    """Write the part of the truth in an area with its margin, as far as there is truth."""
    folder.mkdir(parents=True, exist_ok=True)
    west, south, east, north = bounds
    wide = (west - SHIFT_MARGIN_M, south - SHIFT_MARGIN_M, east + SHIFT_MARGIN_M, north + SHIFT_MARGIN_M)
    for name in ("truth_dsm.tif", "truth_class.tif"):
        with rasterio.open(scene / name) as source:
            window = from_bounds(*wide, source.transform).round_offsets().round_lengths()
            window = window.intersection(rasterio.windows.Window(0, 0, source.width, source.height))
            profile = source.profile | {"width": window.width, "height": window.height}
            with rasterio.open(folder / name, "w", **profile | {"transform": source.window_transform(window)}) as file:
                file.write(source.read(1, window=window), 1)


def accuracy(dsm: Path, truth: Path) -> list[Figure]:
    """Figures of a surface as it is and after its shift was removed. truth : folder of its rasters."""
    surface = read_heights(dsm)
    xy, heights, classes = true_cells(surface, truth)
    # The blocks that find the shift stay inside the surface when it is moved.
    found = evaluate(dsm, Comparison(truth / "truth_dsm.tif", margin_m=2 * SHIFT_MARGIN_M)).found_shift
    if found is None:
        raise CannotRun(f"{dsm} has no height where the truth has one")
    east, north, up = found.enu_m
    moved = xy + np.array((east, north))
    aligned = (surface.bilinear(moved) if found.is_horizontal else surface.nearest(xy)) - up
    figures = []
    for label, z in (("", surface.nearest(xy)), ("aligned, ", aligned)):
        figures += _figures(label, errors_of_cells(z, heights), classes)
    return [*figures, Figure("shift east", east, "m"), Figure("shift north", north, "m"), Figure("shift up", up, "m")]


def true_cells(surface: HeightRaster, truth: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (n, 2) m, true heights (n, 9) m and class (n,) of the middle of the cells whose whole truth is known."""
    reference = read_heights(truth / "truth_dsm.tif")
    with rasterio.open(truth / "truth_class.tif") as source:
        classes = source.read(1)
    row, col = (index.ravel() for index in np.mgrid[: surface.z.shape[0], : surface.z.shape[1]])
    xy = places(surface.transform, row + 0.5, col + 0.5)
    middle = np.floor(reference.cells(xy)).astype(int)
    reach = TRUTH_CELLS // 2
    is_inside = ((middle >= reach) & (middle < np.array(reference.z.shape) - reach)).all(axis=1)
    xy, middle = xy[is_inside], middle[is_inside]
    around = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
    heights = np.stack([reference.z[middle[:, 0] + i, middle[:, 1] + j] for i, j in around], axis=1)
    is_known = np.isfinite(heights).all(axis=1)
    return xy[is_known], heights[is_known], classes[middle[is_known, 0], middle[is_known, 1]]


def errors_of_cells(z: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Errors (n,) m of heights z (n,): against the mean of the true ones (n, k), at an edge against the nearest."""
    nearest = np.abs(heights - np.nan_to_num(z)[:, None]).argmin(axis=1)
    member = np.take_along_axis(heights, nearest[:, None], axis=1)[:, 0]
    return z - np.where(np.ptp(heights, axis=1) > EDGE_M, member, heights.mean(axis=1))


def _figures(label: str, errors: np.ndarray, classes: np.ndarray) -> list[Figure]:
    """Shares within each limit by class, share with a height, share off by more than the last limit, and NMAD."""
    members = {"all": np.ones(len(errors), bool)} | {name: np.isin(classes, of) for name, of in CLASS_NAMES.items()}
    found: dict[str, ErrorStatistics] = {
        name: error_statistics(errors[chosen], LIMITS_M[0], LIMITS_M[1:]) for name, chosen in members.items()
    }
    shares = {name: dict(statistics.shares) for name, statistics in found.items()}
    figures = [
        Figure(f"{label}within {limit:g} m: {name}", shares[name][limit], is_detail=limit == 1.0)
        for limit in LIMITS_M[:-1] for name in found
    ]  # fmt: skip
    complete = found["all"].completeness
    return [
        *figures,
        Figure(f"{label}with a height", complete),
        Figure(f"{label}off by more than {LIMITS_M[-1]:g} m", complete - shares["all"][LIMITS_M[-1]]),
        Figure(f"{label}NMAD ground", found["ground"].nmad, "m"),
    ]
