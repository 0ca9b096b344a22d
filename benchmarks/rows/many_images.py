"""Rows on stacks of images: the laser surface of Jacksonville, and whether further images ever make a surface worse."""

from __future__ import annotations

import json
import statistics
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from scipy.ndimage import distance_transform_edt, shift

import middlebury
from peers.realistic import judged_realistic
from reprojection import Surface, reprojected
from rows.real_images import make_surface, reduced_facade, without
from workplace import Figure, Workplace, rendered_images
from zlocus.io.scene_file import open_scene

LIDAR, CLASSES = "reference/lidar_dsm_half_utm17n.tif", "reference/classes_half_utm17n.tif"
# Images that are matched, by the end of their names; none stands for all nineteen.
STACKS = {
    "nineteen": (),
    "001 to 007": tuple(f"{number:03d}" for number in range(1, 8)),
    "001, 002, 010": ("001", "002", "010"),
    "001, 002": ("001", "002"),
}
GROUND, BUILDING = 2, 6
FAR_CELLS, FALSE_M = 5, 25.0
BLEEDS = "towers bleed onto the ground beside them, or images of other dates mislead"
HARMS = "further images add false heights instead of removing them"
# The image of the facade that judges, and the order in which the others are added.
JUDGE, FACADE = "0003", ("0002", "0004", "0001", "0005", "0000", "0006", "0007")


def many_images(workplace: Workplace) -> list[Figure]:
    """WorldView-3 images of ten months against laser heights, registered as papers on these images do."""
    scene = workplace.scene("worldview3_jax068")
    lidar, classes = scene / LIDAR, scene / CLASSES
    figures = []
    for name, numbers in STACKS.items():
        out = workplace.out / name.replace(", ", "-").replace(" ", "-")
        images = [path for path in sorted(scene.glob("*_RGB.tif")) if not numbers or path.stem[8:11] in numbers]
        make_surface(images, out, "--like", lidar)
        judged = workplace.judge_registered(out / "dsm.tif", lidar, classes)
        found = judged["all"]
        if name != "nineteen":
            figures.append(Figure(f"{name}: mean absolute error", found["mae"], "m"))
            continue
        record = json.loads((out / "run.json").read_text())
        cpu_s = sum(stage["cpu_s"] for stage in record["stages"])
        figures += [
            Figure(f"{name}: mean absolute error", found["mae"], "m", at_most=1.05, fails_when=BLEEDS),
            Figure(f"{name}: RMSE", found["rmse"], "m", at_most=2.9, fails_when=BLEEDS),
            Figure(f"{name}: median", found["median"], "m", at_most=0.25, fails_when=BLEEDS),
            Figure(f"{name}: within 1 m", found["within1"], at_least=0.8, fails_when=BLEEDS),
            Figure(f"{name}: mean absolute error of buildings", judged["building"]["mae"], "m", is_detail=True),
            Figure(f"{name}: CPU", cpu_s, "s", at_most=40, fails_when="every pair of images is compared everywhere"),
            Figure(
                f"{name}: ground away from buildings off by more than {FALSE_M:g} m, cells",
                float(n_false_on_ground(out / "dsm.tif", lidar, classes, judged)), at_most=0, fails_when=BLEEDS,
            ),
        ]  # fmt: skip
    return figures


def n_false_on_ground(dsm: Path, lidar: Path, classes: Path, judged: dict[str, Any]) -> int:
    """Cells of ground, `FAR_CELLS` cells from buildings or more, whose height is off by more than `FALSE_M`.

    judged : what the judge found, with the shift that it removed.
    """
    heights, truth, kind = (rasterio.open(path).read(1) for path in (dsm, lidar, classes))
    heights = np.where(np.isfinite(heights), heights, np.nan).astype(float)
    aligned = shift(heights, judged["shift_cells_row_col"], order=1, cval=np.nan) - judged["shift_m"]
    is_far = (kind == GROUND) & (distance_transform_edt(kind != BUILDING) >= FAR_CELLS)
    with np.errstate(invalid="ignore"):
        return int((is_far & (np.abs(aligned - truth) > FALSE_M)).sum())


def more_images(workplace: Workplace) -> list[Figure]:
    """Errors with two images and with more: in image space on rectified photographs, on the ground on rendered, drone
    and satellite scenes. An error that grows by more than a hundredth fails."""
    series = {
        "cones, bad > 1 px, %": of_photographs(workplace, "cones", (2, 3)),
        "tsukuba, bad > 1 px, %": of_photographs(workplace, "tsukuba", (2, 3, 5)),
        "realistic scene a, not within 1 m": of_realistic_scene(workplace, (2, 3, 5, 6)),
        "Jacksonville, mean absolute error, m": of_satellite_images(workplace, (2, 3, 7, 13, 19)),
        "Herz-Jesu, 1 - median NCC of an image left out": of_facade(workplace, (2, 3, 4, 5, 7)),
    }
    figures = []
    for name, errors in series.items():
        figures += [Figure(f"{name}: {n} images", error, is_detail=True) for n, error in errors.items()]
        figures.append(Figure(f"{name}: largest step up", step_up(errors), at_most=1.01, fails_when=HARMS))
    return figures


def step_up(errors: dict[int, float]) -> float:
    """Largest ratio of an error to that with fewer images before it. errors : by growing number of images."""
    values = list(errors.values())
    return max(more / fewer for fewer, more in pairwise(values))


def of_photographs(workplace: Workplace, scene: str, numbers: Sequence[int]) -> dict[int, float]:
    """Percent of bad pixels of rectified photographs, by the number of images."""
    data = workplace.scene("middlebury_multiview")
    with tempfile.TemporaryDirectory() as folder:
        return {n: middlebury.judge(data, f"{scene}, {n} views", Path(folder) / f"{scene}-{n}").zlocus for n in numbers}


def of_realistic_scene(workplace: Workplace, numbers: Sequence[int]) -> dict[int, float]:
    """Share of the cells of a realistic scene that are not within 1 m, by the number of images."""
    scene, errors = workplace.scene("rendered-real-a"), {}
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        area = ["--resolution", 0.5, "--crs", truth.crs.to_string(), "--bounds", *truth.bounds]
    for n in numbers:
        images = rendered_images(scene, ("n1", "f1", "b1", "n2", "f2", "s1")[:n])
        make_surface(images, workplace.out / f"realistic-{n}", *area)
        errors[n] = 1 - judged_realistic(scene, workplace.out / f"realistic-{n}" / "dsm.tif")["all"]["within"]
    return errors


def of_satellite_images(workplace: Workplace, numbers: Sequence[int]) -> dict[int, float]:
    """Mean absolute error of WorldView-3 images against laser heights, m, by their number, in the order of dates."""
    scene, errors = workplace.scene("worldview3_jax068"), {}
    images = sorted(scene.glob("*_RGB.tif"))
    for n in numbers:
        out = workplace.out / f"satellite-{n}"
        make_surface(images[:n], out, "--like", scene / LIDAR)
        errors[n] = workplace.judge_registered(out / "dsm.tif", scene / LIDAR, scene / CLASSES)["all"]["mae"]
    return errors


def of_facade(workplace: Workplace, numbers: Sequence[int]) -> dict[int, float]:
    """1 less the median correlation of a photograph that was left out, by the number of photographs of the facade."""
    facade, errors = reduced_facade(workplace), {}
    views = {view.name: view for view in open_scene([facade]).views}
    for n in numbers:
        left = without(facade, set(views) - set(FACADE[:n]), facade.with_name(f"{n}.yaml"))
        make_surface([left], workplace.out / f"facade-{n}")
        surface = Surface.read(workplace.out / f"facade-{n}" / "dsm.tif")
        found = reprojected(surface, [views[name] for name in FACADE[:n]], [views[JUDGE]])
        errors[n] = 1 - statistics.fmean(one.median for one in found.values())
    return errors
