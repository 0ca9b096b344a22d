"""Rows of the acceptance table on rendered scenes with exact truth: towns, hills and their ortho-images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import rasterio

from baselines import baselines
from double_mapping import double_mapped
from workplace import RENDERED_VIEWS, ZLOCUS, Figure, Workplace, render, rendered_images, run
from zlocus.core.scene import Scene
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.io.scene_file import open_scene

# Views of a rendered town that are matched: two strips, one strip, one pair.
VIEWS = {"six": RENDERED_VIEWS, "three": RENDERED_VIEWS[:3], "two": RENDERED_VIEWS[:2]}
# Kind and seed of scenes that only judge. They were chosen by the scores of the baselines, before zlocus had seen them,
# and no option is chosen by them.
NEW_SCENES = (("city", 16), ("city", 20), ("hills", 43), ("hills", 50))
# Bars of a town by the number of views: share of the cells within 1 m of the truth (all, and by class), share of the
# cells with a height (valid), NMAD of the ground in metres (nmad).
CITY_BARS = {
    "six": {"all": 0.97, "building": 0.92, "ground": 0.99, "tree": 0.60, "valid": 0.97, "nmad": 0.10},
    "three": {"all": 0.955, "building": 0.85, "ground": 0.98, "nmad": 0.10},
    "two": {"all": 0.925, "building": 0.72, "nmad": 0.25},
}
HILLS_NMAD_BAR_M = 0.16
POINTING_PX = {"city": 0, "hills": 4}
SHARED_SCENES = {"city": "rendered-city", "hills": "rendered-hills-biased"}
# Share of the cells of a class whose ortho-image shows the object that occludes them.
DOUBLE_MAPPED_BARS = {"ground": 0.005}
# The grey value of a cell tells which image it was taken from, so the ortho-image must keep the image's own values.
OWN_LEVELS = '[products]\northo_levels = "own"\n'


def city(workplace: Workplace) -> list[Figure]:
    """The shared rendered town with six views, against its exact truth."""
    scene = workplace.scene("rendered-city")
    run([ZLOCUS, "dsm", *rendered_images(scene), "-o", workplace.out, "--resolution", 0.5, "--overwrite"])
    figures = workplace.judge(workplace.out / "dsm.tif", scene)
    return [
        Figure("within 1 m: all", figures["all"]["within"], at_least=0.955),
        Figure("within 1 m: ground", figures["ground"]["within"], at_least=0.98),
        Figure("within 1 m: building", figures["building"]["within"], at_least=0.82),
        Figure("within 1 m: tree", figures["tree"]["within"]),
        Figure("NMAD ground", figures["ground"]["nmad"], "m", at_most=0.12),
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
        Figure(f"{what}, within 1 m: {kind}", found[kind]["within"], at_least=bars.get(kind))
        for kind in surfaces_of("city", "tree")
    ]
    return [
        *within,
        Figure(f"{what}, valid", found["all"]["complete"], at_least=bars.get("valid")),
        Figure(f"{what}, NMAD ground", found["ground"]["nmad"], "m", at_most=bars.get("nmad")),
    ]


def hills(workplace: Workplace) -> list[Figure]:
    """Rendered hills whose RPC have pointing errors."""
    scene = workplace.scene("rendered-hills-biased")
    images = rendered_images(scene)
    run([ZLOCUS, "dsm", *images, "-o", workplace.out, "--resolution", 0.5, "--overwrite"])
    figures = workplace.judge(workplace.out / "dsm.tif", scene, "--align")
    views = json.loads((workplace.out / "run.json").read_text())["orientation"]["views"]
    truth = json.loads((scene / "scene.json").read_text())
    opened = open_scene(images)
    # The correction must be the opposite of the planted pointing error.
    planted = np.array([truth["views"][view]["bias_row_col"][::-1] for view in RENDERED_VIEWS])
    applied = np.array([views[view.name]["shift_px"] for view in opened.views])
    left = shifts_left(opened, applied + planted, (truth["zmin"] + truth["zmax"]) / 2)
    return [
        Figure("NMAD ground, aligned", figures["ground"]["nmad"], "m", at_most=0.16),
        Figure("within 1 m: ground", figures["ground"]["within"]),
        Figure("worst shift, after the fit", float(left.max()), "px", at_most=0.1),
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
    found, plain = (
        workplace.judge(workplace.out / name / "dsm.tif", scene, "--align")["ground"] for name in ("dsm", "plain")
    )
    between = evaluate(
        workplace.out / "dsm" / "dsm.tif", Comparison(workplace.out / "plain" / "dsm.tif", margin_m=0)
    ).statistics
    return [
        Figure("worst shift, after the fit", float(left.max()), "px", at_most=0.05),
        Figure("NMAD ground, aligned", found["nmad"], "m", at_most=0.14),
        Figure("the same, images as they are", plain["nmad"], "m"),
        Figure("sigma0", report["sigma0_px"], "px"),
        Figure("against images as they are, median", abs(between.median), "m"),
        Figure("against images as they are, NMAD", between.nmad, "m"),
    ]


def new_scenes(workplace: Workplace) -> list[Figure]:
    """Rendered scenes that no option was chosen on, as hard as the shared ones for methods other than zlocus."""
    figures, shared = [], {}
    for kind, seed in NEW_SCENES:
        scene = workplace.out / f"{kind}{seed}"
        render(scene, kind, 520, "--seed", seed, "--pointing", POINTING_PX[kind])
        figures += new_scene(workplace, kind, seed, scene)
        if kind not in shared:
            shared[kind] = baselines(workplace.scene(SHARED_SCENES[kind]), workplace.out / f"{kind}-baselines")
        for method, here in baselines(scene, workplace.out / f"{kind}{seed}-baselines").items():
            there = shared[kind][method]
            gap = max(abs(here[surface]["within"] - there[surface]["within"]) for surface in surfaces_of(kind))
            figures.append(Figure(f"{kind} {seed}, {method} against shared", gap, at_most=0.03))
    return figures


def new_scene(workplace: Workplace, kind: str, seed: int, scene: Path) -> list[Figure]:
    """Accuracy on one of `NEW_SCENES`: towns with six, three and two views, hills with six."""
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        crs = truth.crs.to_string()
    figures: list[Figure] = []
    for name, views in VIEWS.items() if kind == "city" else [("six", RENDERED_VIEWS)]:
        out = workplace.out / f"{kind}{seed}-{name}"
        images = rendered_images(scene, views)
        run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--crs", crs, "--overwrite"])
        found = workplace.judge(out / "dsm.tif", scene, *(["--align"] if kind == "hills" else []))
        if kind == "city":
            figures += town_figures(f"city {seed}, {name}", found, CITY_BARS[name])
            continue
        for surface in surfaces_of(kind, "tree"):
            figures.append(Figure(f"{kind} {seed}, within 1 m: {surface}", found[surface]["within"]))
        figures.append(Figure(f"{kind} {seed}, NMAD ground", found["ground"]["nmad"], "m", at_most=HILLS_NMAD_BAR_M))
    return figures


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
        Figure(f"{kind} that shows what occludes it{which}", share, at_most=DOUBLE_MAPPED_BARS.get(kind + which))
        for kind, shares in found.items()
        for which, share in zip(("", ", of right heights"), shares, strict=True)
    ]


def surfaces_of(kind: str, *more: str) -> tuple[str, ...]:
    """Classes of a rendered scene that are judged: `all`, `ground`, in towns `building`, and those of `more`."""
    return ("all", "ground", *(("building",) if kind == "city" else ()), *more)
