"""Rows of the acceptance table on rendered scenes with exact truth: towns, hills and their ortho-images."""

from __future__ import annotations

import json

import numpy as np

from double_mapping import double_mapped
from workplace import RENDERED_VIEWS, ZLOCUS, Figure, Workplace, rendered_images, run
from zlocus.core.scene import Scene
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.io.scene_file import open_scene

# Views of a rendered town that are matched: two strips, one strip, one pair.
VIEWS = {"six": RENDERED_VIEWS, "three": RENDERED_VIEWS[:3], "two": RENDERED_VIEWS[:2]}
# Bars of a town by the number of views: share of the cells within 1 m of the truth (all, and by class), share of the
# cells with a height (valid), NMAD of the ground in metres (nmad).
CITY_BARS = {
    "six": {"all": 0.97, "building": 0.92, "ground": 0.99, "tree": 0.60, "valid": 0.97, "nmad": 0.10},
    "three": {"all": 0.955, "building": 0.85, "ground": 0.98, "nmad": 0.10},
    "two": {"all": 0.925, "building": 0.72, "nmad": 0.25},
}
SHARED_TOWN_BARS = {"all": 0.955, "ground": 0.98, "building": 0.82}
HILLS_NMAD_BAR_M, JOINT_NMAD_BAR_M = 0.16, 0.14
POINTING_PX = {"city": 0, "hills": 4}
# Faults that make the figures of a town miss their bars.
TOWN_FAULTS = {
    "all": "false heights, or empty cells",
    "ground": "ground beside houses gets the height of roofs",
    "building": "roofs without texture are lost, or outlines grow",
    "tree": "crowns are smoothed away by large windows",
    "valid": "cells are left empty by checks that are too strict",
    "nmad": "heights below a step are noisy",
}
HILLS_FAULT = "heights are noisy, or images stay shifted against each other"
# Share of the cells of a class whose ortho-image shows the object that occludes them.
DOUBLE_MAPPED_BARS = {"ground": 0.005}
# The grey value of a cell tells which image it was taken from, so the ortho-image must keep the image's own values.
OWN_LEVELS = '[products]\northo_levels = "own"\n'


def city(workplace: Workplace) -> list[Figure]:
    """The shared rendered town with six views, against its exact truth."""
    scene = workplace.scene("rendered-city")
    run([ZLOCUS, "dsm", *rendered_images(scene), "-o", workplace.out, "--resolution", 0.5, "--overwrite"])
    found = workplace.judge_twice(workplace.out / "dsm.tif", scene)
    plain, aligned = found["absolute"], found["aligned"]
    return [
        *(
            Figure(f"within 1 m: {kind}", plain[kind]["within"], at_least=bar, fails_when=TOWN_FAULTS[kind])
            for kind, bar in SHARED_TOWN_BARS.items()
        ),
        Figure("within 1 m: tree", plain["tree"]["within"]),
        Figure("NMAD ground", plain["ground"]["nmad"], "m", at_most=0.12, fails_when=TOWN_FAULTS["nmad"]),
        *(
            Figure(f"aligned, within 1 m: {kind}", aligned[kind]["within"], is_detail=True)
            for kind in surfaces_of("city", "tree")
        ),
        Figure("aligned, NMAD ground", aligned["ground"]["nmad"], "m"),
    ]


def city_views(workplace: Workplace) -> list[Figure]:
    """The shared town with six, three and two views."""
    scene, figures = workplace.scene("rendered-city"), []
    for name, views in VIEWS.items():
        run([ZLOCUS, "dsm", *rendered_images(scene, views), "-o", workplace.out, "--resolution", 0.5, "--overwrite"])
        figures += town_figures(name, workplace.judge(workplace.out / "dsm.tif", scene), CITY_BARS[name])
    return figures


def town_figures(what: str, found: dict[str, dict[str, float]], bars: dict[str, float]) -> list[Figure]:
    """Accuracy and completeness of a town. bars : see `CITY_BARS`; a figure without a bar is only reported."""
    within = [
        Figure(
            f"{what}, within 1 m: {kind}", found[kind]["within"], at_least=bars.get(kind), fails_when=TOWN_FAULTS[kind]
        )
        for kind in surfaces_of("city", "tree")
    ]
    return [
        *within,
        Figure(f"{what}, valid", found["all"]["complete"], at_least=bars.get("valid"), fails_when=TOWN_FAULTS["valid"]),
        Figure(
            f"{what}, NMAD ground",
            found["ground"]["nmad"],
            "m",
            at_most=bars.get("nmad"),
            fails_when=TOWN_FAULTS["nmad"],
        ),
    ]


def hills(workplace: Workplace) -> list[Figure]:
    """Rendered hills whose RPC have pointing errors."""
    scene = workplace.scene("rendered-hills-biased")
    images = rendered_images(scene)
    run([ZLOCUS, "dsm", *images, "-o", workplace.out, "--resolution", 0.5, "--overwrite"])
    found = workplace.judge_twice(workplace.out / "dsm.tif", scene)
    views = json.loads((workplace.out / "run.json").read_text())["orientation"]["views"]
    truth = json.loads((scene / "scene.json").read_text())
    opened = open_scene(images)
    # The correction must be the opposite of the planted pointing error.
    planted = np.array([truth["views"][view]["bias_row_col"][::-1] for view in RENDERED_VIEWS])
    applied = np.array([views[view.name]["shift_px"] for view in opened.views])
    left = shifts_left(opened, applied + planted, (truth["zmin"] + truth["zmax"]) / 2)
    return [
        *absolute_and_aligned(found, HILLS_NMAD_BAR_M),
        Figure(
            "worst shift, after the fit", float(left.max()), "px", at_most=0.1,
            fails_when="tie points are wrong or imprecise, or a correction has the wrong sign",
        ),
    ]  # fmt: skip


def absolute_and_aligned(found: dict[str, dict[str, dict[str, float]]], nmad_bar_m: float) -> list[Figure]:
    """Figures of hills as they are and aligned; the bar is that of the NMAD of the aligned ground."""
    plain, aligned = found["absolute"], found["aligned"]
    return [
        Figure("within 1 m: ground", plain["ground"]["within"]),
        Figure("aligned, within 1 m: ground", aligned["ground"]["within"]),
        Figure("median of the ground", plain["ground"]["median"], "m"),
        Figure("NMAD ground", plain["ground"]["nmad"], "m"),
        Figure("aligned, NMAD ground", aligned["ground"]["nmad"], "m", at_most=nmad_bar_m, fails_when=HILLS_FAULT),
        Figure("shift removed, horizontally", float(np.hypot(*aligned["shift"])), "m"),
    ]


def shifts_left(scene: Scene, shifts: np.ndarray, z: float) -> np.ndarray:
    """Length (i,) px of the shifts (i, 2) px of the images that the best translation of the ground does not explain."""
    centre = np.array([[(n - 1) / 2 for n in scene.views[0].image.shape[::-1]]])
    ground = scene.views[0].sensor.ground_from_image(centre, np.array([z]))
    step = np.vstack([np.zeros(3), np.eye(3)])
    projected = [view.sensor.image_from_ground(ground + step) for view in scene.views]
    px_per_m = np.concatenate([(xy[1:] - xy[0]).T for xy in projected])
    translation, *_ = np.linalg.lstsq(px_per_m, shifts.ravel(), rcond=None)
    return np.hypot(*(shifts.ravel() - px_per_m @ translation).reshape(-1, 2).T)


def joint(workplace: Workplace) -> list[Figure]:
    """The same hills: cameras corrected by `zlocus orient`, written to files, and matched from these files."""
    scene = workplace.scene("rendered-hills-biased")
    images = rendered_images(scene)
    run([ZLOCUS, "orient", *images, "-o", workplace.out / "oriented", "--overwrite"])
    written = workplace.out / "oriented" / "scene.yaml"
    report = json.loads((workplace.out / "oriented" / "orientation.json").read_text())
    truth = json.loads((scene / "scene.json").read_text())
    middle = (truth["zmin"] + truth["zmax"]) / 2
    delivered, corrected = open_scene(images), {view.name: view for view in open_scene([written]).views}
    planted = np.array([truth["views"][view]["bias_row_col"][::-1] for view in RENDERED_VIEWS])
    ground = delivered.views[0].sensor.ground_from_image(np.array([[300.0, 300.0]]), np.array([middle]))
    applied = np.concatenate(
        [
            corrected[view.name].sensor.image_from_ground(ground) - view.sensor.image_from_ground(ground)
            for view in delivered.views
        ]
    )
    left = shifts_left(delivered, applied + planted, middle)
    run([ZLOCUS, "dsm", written, "-o", workplace.out / "dsm", "--resolution", 0.5, "--overwrite"])
    run([ZLOCUS, "dsm", *images, "-o", workplace.out / "plain", "--resolution", 0.5, "--overwrite"])
    found = workplace.judge_twice(workplace.out / "dsm" / "dsm.tif", scene)
    uncorrected = workplace.judge(workplace.out / "plain" / "dsm.tif", scene, "--align")["ground"]
    between = evaluate(
        workplace.out / "dsm" / "dsm.tif", Comparison(workplace.out / "plain" / "dsm.tif", margin_m=0)
    ).statistics
    return [
        Figure(
            "worst shift, after the fit", float(left.max()), "px", at_most=0.05,
            fails_when="the bundle adjustment is imprecise, or the files hold other cameras",
        ),
        *absolute_and_aligned(found, JOINT_NMAD_BAR_M),
        Figure("aligned, NMAD ground, images as they are", uncorrected["nmad"], "m"),
        Figure("sigma0", report["sigma0_px"], "px"),
        Figure("against images as they are, median", abs(between.median), "m"),
        Figure("against images as they are, NMAD", between.nmad, "m"),
    ]  # fmt: skip


def ortho(workplace: Workplace) -> list[Figure]:
    """The true ortho-image of the rendered town: share of the cells that show an object which occludes them."""
    scene = workplace.scene("rendered-city")
    images = rendered_images(scene)
    options = workplace.out.with_suffix(".toml")
    options.parent.mkdir(parents=True, exist_ok=True)
    options.write_text(OWN_LEVELS)
    run([ZLOCUS, "dsm", *images, "-o", workplace.out, "--resolution", 0.5, "--config", options, "--overwrite"])
    found = double_mapped(workplace.out, scene / "truth_dsm.tif", scene / "truth_class.tif", open_scene(images))
    return [
        Figure(
            f"{kind} that shows what occludes it{which}", share, at_most=DOUBLE_MAPPED_BARS.get(kind + which),
            fails_when="occluded images colour the cells, as when occlusion is not computed",
        )
        for kind, shares in found.items()
        for which, share in zip(("", ", of right heights"), shares, strict=True)
    ]  # fmt: skip


def surfaces_of(kind: str, *more: str) -> tuple[str, ...]:
    """Classes of a rendered scene that are judged: `all`, `ground`, in towns `building`, and those of `more`."""
    return ("all", "ground", *(("building",) if kind == "city" else ()), *more)
