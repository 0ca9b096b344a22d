"""Row of the acceptance table on a rendered block of drone images, whose lens, ground and truth are exact.

The surface is judged cell by cell: each cell has nine true heights, those of the cells of the truth in and around it.
Judges of surfaces of satellites average half a metre, over which every steep roof counts as an edge.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio

from rows.photographs import n_images_around
from rows.resources import of_all_processes
from workplace import COVERAGE_SHORT, ZLOCUS, CannotRun, Figure, Workplace, run
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.statistics import ErrorStatistics, error_statistics
from zlocus.evaluation.truth import CLASS_NAMES, places
from zlocus.io.scene_file import open_scene
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.drone_block import DroneBlockSpec, render_drone_block

# Side of a cell, and the errors within which heights are counted, in ground pixels.
CELL_PX, LIMIT_PX = 2.0, 2.0
# Least share within that limit by class, and the least share of what two frames see that has a height.
LEAST_WITHIN = {"ground": 0.97, "building": 0.90, "tree": 0.60}
LEAST_FILLED, MOST_CPU_S = 0.97, 25.0
LARGER_LIMITS_M = (0.3, 1.0, 3.0)
# Side of the square in the middle of the block that is judged for itself, m: four frames or more see nearly all of it.
MIDDLE_M = 96.0
# Cells of the truth along a side of the square in which a cell of the surface has its true heights.
TRUTH_CELLS = 3
# A cell in which true heights differ by more holds an edge, either side of which is right.
EDGE_M = 0.2
# Blocks of the surface that find its shift stay so far inside.
SHIFT_MARGIN_M = 5.0
# One of so many cells is followed towards the frames. A ray is occluded where the truth lies this far above it.
SAMPLED_EVERY, CLEARANCE_M = 199, 0.1
# Rows of the surface whose truth is held in memory at a time.
ROWS_AT_ONCE = 256


def drone_block(workplace: Workplace, spec: DroneBlockSpec | None = None) -> list[Figure]:
    """Accuracy and cost of the surface of a whole block of 20 frames of 12 megapixels, at twice the ground pixel.

    The whole block has a rim that only two or three frames see, half of its area; its middle is judged for itself too.
    Beside houses and trees much of the rim is occluded in one of its two frames, and cannot be matched. So the bars of
    the whole block are those of a sample of the cells that two frames see past everything that stands in between.
    spec : None for that block. The block is rendered into the folder of the row. A block of the same specification that
    lies there is used again.
    """
    spec = DroneBlockSpec() if spec is None else spec
    scene, out = workplace.out / "block", workplace.out / "dsm"
    workplace.inputs["seeds"] = [spec.seed]
    provide_block(spec, scene)
    command = [ZLOCUS, "dsm", scene / "scene.yaml", "-o", out, "--resolution", CELL_PX * spec.ground_pixel_m]
    run([*command, "--workers", 1, "--no-report", "--overwrite"], accept=(0, COVERAGE_SHORT))
    cells = true_cells(read_heights(out / "dsm.tif"), scene)
    million_cells = len(cells.xy) / 1e6
    cpu, memory = of_all_processes(json.loads((out / "run.json").read_text()))
    limit_m, is_middle = LIMIT_PX * spec.ground_pixel_m, in_middle(cells, spec)
    errors = errors_of_cells(read_heights(out / "dsm.tif").nearest(cells.xy), cells.heights)
    of_middle = _figures(errors[is_middle], cells.classes[is_middle], limit_m)
    sampled = slice(None, None, SAMPLED_EVERY)
    is_seen = n_frames_that_see(scene, np.column_stack([cells.xy, cells.heights[:, TRUTH_CELLS**2 // 2]])[sampled]) >= 2
    of_seen = _figures(errors[sampled][is_seen], cells.classes[sampled][is_seen], limit_m)
    return [
        *(without_bar(figure) for figure in accuracy(out / "dsm.tif", scene, cells, limit_m)),
        *(replace(figure, what=f"middle, {figure.what}") for figure in of_middle),
        *(replace(figure, what=f"seen by two, {figure.what}") for figure in of_seen),
        Figure("cells inside two frames that two see", float(is_seen.mean())),
        Figure("million cells seen by two frames", million_cells),
        Figure(
            "CPU per million cells", cpu.value / million_cells, "s", at_most=MOST_CPU_S,
            fails_when="a stage works on cells that a view does not show, or images are read again for each tile",
        ),
        cpu,
        memory,
    ]  # fmt: skip


def provide_block(spec: DroneBlockSpec, scene: Path) -> None:
    """Render the block, unless the folder holds one of the same specification."""
    if not scene.exists():
        render_drone_block(spec, scene)
        return
    described = scene / "scene.json"
    if not described.exists() or json.loads(described.read_text()).get("spec") != json.loads(json.dumps(asdict(spec))):
        raise CannotRun(f"{scene} holds another scene; remove it")


def without_bar(figure: Figure) -> Figure:
    """A figure that is only reported."""
    return replace(figure, at_least=None, at_most=None, fails_when="")


def n_frames_that_see(scene: Path, xyz: np.ndarray) -> np.ndarray:
    """Number of frames of a block that see points (n, 3) m of its truth, (n,): inside the frame and not occluded.

    Rays from the points to the camera are followed over the truth, in steps of one of its cells, up to its top.
    """
    truth = read_heights(scene / "truth_dsm.tif")
    top, cell_m, seeing = float(np.nanmax(truth.z)), abs(truth.transform.a), np.zeros(len(xyz), int)
    for view in open_scene([scene / "scene.yaml"]).views:
        xy, sensor = view.sensor.image_from_ground(xyz), view.sensor
        assert isinstance(sensor, FrameModel), "blocks of drones have frame cameras"
        inside = np.flatnonzero(((xy >= 0) & (xy <= np.array(view.image.shape[::-1]) - 1)).all(axis=1))
        points = xyz[inside]
        per_metre = (np.array(sensor.centre)[:2] - points[:, :2]) / (sensor.centre[2] - points[:, 2])[:, None]
        step_m = cell_m / max(float(np.hypot(*per_metre.T).max(initial=0.0)), 1.0)
        is_free = np.ones(len(points), bool)
        for above_m in np.arange(step_m, top - points[:, 2].min(initial=top), step_m):
            with np.errstate(invalid="ignore"):
                height = truth.nearest(points[:, :2] + above_m * per_metre)
                is_free &= ~(height > points[:, 2] + above_m + CLEARANCE_M)
        seeing[inside[is_free]] += 1
    return seeing


def in_middle(cells: TrueCells, spec: DroneBlockSpec) -> np.ndarray:
    """Which cells lie in the square in the middle of a block, (n,) bool."""
    return (np.abs(cells.xy - (spec.east_m, spec.north_m)) <= MIDDLE_M / 2).all(axis=1)


def accuracy(dsm: Path, scene: Path, cells: TrueCells, limit_m: float) -> list[Figure]:
    """Figures of a surface as it is and after its shift was removed.

    scene : folder of the block; cells : that are judged; limit_m : within which errors are right.
    """
    surface = read_heights(dsm)
    # The blocks that find the shift stay inside the surface when it is moved.
    found = evaluate(dsm, Comparison(scene / "truth_dsm.tif", margin_m=2 * SHIFT_MARGIN_M)).found_shift
    if found is None:
        raise CannotRun(f"{dsm} has no height where the truth has one")
    east, north, up = found.enu_m
    moved = cells.xy + np.array((east, north))
    aligned = (surface.bilinear(moved) if found.is_horizontal else surface.nearest(cells.xy)) - up
    figures = _figures(errors_of_cells(surface.nearest(cells.xy), cells.heights), cells.classes, limit_m)
    after = _figures(errors_of_cells(aligned, cells.heights), cells.classes, limit_m)
    figures += [
        replace(figure, what=f"aligned, {figure.what}", at_least=None, fails_when="", is_detail=True)
        for figure in after
    ]  # fmt: skip
    return [*figures, Figure("shift east", east, "m"), Figure("shift north", north, "m"), Figure("shift up", up, "m")]


class TrueCells(NamedTuple):
    """Cells of a surface that lie inside two frames or more, and whose whole truth is known.

    xy : (n, 2) m, their centres; heights : (n, 9) float32 m, of the truth in and around each; classes : (n,), of the
    middle of each.
    """

    xy: np.ndarray
    heights: np.ndarray
    classes: np.ndarray


def true_cells(surface: HeightRaster, scene: Path) -> TrueCells:
    """The cells of a surface that are judged. scene : folder of the block, with its frames and its truth."""
    reference = read_heights(scene / "truth_dsm.tif")
    with rasterio.open(scene / "truth_class.tif") as source:
        classes = source.read(1)
    n_rows, strips = surface.z.shape[0], []
    for first in range(0, n_rows, ROWS_AT_ONCE):
        rows = np.arange(first, min(first + ROWS_AT_ONCE, n_rows))
        strips.append(_of_rows(surface, rows, reference, classes, scene))
    return TrueCells(*(np.concatenate(parts) for parts in zip(*strips, strict=True)))


def _of_rows(
    surface: HeightRaster, rows: np.ndarray, reference: HeightRaster, classes: np.ndarray, scene: Path
) -> TrueCells:
    """The cells of some rows of a surface that are judged. reference, classes : the truth."""
    row, col = (index.ravel() for index in np.meshgrid(rows, np.arange(surface.z.shape[1]), indexing="ij"))
    xy = places(surface.transform, row + 0.5, col + 0.5)
    middle = np.floor(reference.cells(xy)).astype(int)
    reach = TRUTH_CELLS // 2
    is_inside = ((middle >= reach) & (middle < np.array(reference.z.shape) - reach)).all(axis=1)
    xy, middle = xy[is_inside], middle[is_inside]
    around = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
    heights = np.stack([reference.z[middle[:, 0] + i, middle[:, 1] + j] for i, j in around], axis=1)
    is_judged = np.isfinite(heights).all(axis=1)
    is_judged[is_judged] = n_images_around(scene, np.column_stack([xy, heights[:, 4]])[is_judged]) >= 2
    of_class = classes[middle[:, 0], middle[:, 1]]
    return TrueCells(xy[is_judged], heights[is_judged].astype(np.float32), of_class[is_judged])


def errors_of_cells(z: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Errors (n,) m of heights z (n,): against the mean of the true ones (n, k), at an edge against the nearest."""
    nearest = np.abs(heights - np.nan_to_num(z)[:, None]).argmin(axis=1)
    member = np.take_along_axis(heights, nearest[:, None], axis=1)[:, 0]
    return z - np.where(np.ptp(heights, axis=1) > EDGE_M, member, heights.mean(axis=1))


def _figures(errors: np.ndarray, classes: np.ndarray, limit_m: float) -> list[Figure]:
    """Shares within each limit by class, share with a height, share off by more than the last limit, and NMAD.

    errors : (n,) m, NaN without a height, which counts as wrong; classes : (n,).
    """
    members = {"all": np.ones(len(errors), bool)} | {name: np.isin(classes, of) for name, of in CLASS_NAMES.items()}
    found: dict[str, ErrorStatistics] = {
        name: error_statistics(errors[chosen], limit_m, LARGER_LIMITS_M) for name, chosen in members.items()
    }
    shares = {name: dict(statistics.shares) for name, statistics in found.items()}
    figures = [
        Figure(
            f"within two ground pixels: {name}", shares[name][limit_m], at_least=LEAST_WITHIN.get(name),
            fails_when="" if name == "all" else f"heights of this class ({name}) are matched wrongly or refused",
        )
        for name in found
    ]  # fmt: skip
    *larger, last = LARGER_LIMITS_M
    figures += [
        Figure(f"within {limit:g} m: {name}", shares[name][limit], is_detail=limit == 1.0)
        for limit in larger for name in found
    ]  # fmt: skip
    complete = found["all"].completeness
    return [
        *figures,
        Figure(
            "filled", complete, at_least=LEAST_FILLED,
            fails_when="heights are refused where two frames agree, or views are left out of blocks",
        ),
        Figure(f"off by more than {last:g} m", complete - shares["all"][last]),
        Figure("NMAD ground", found["ground"].nmad, "m"),
    ]  # fmt: skip
