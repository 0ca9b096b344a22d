"""Rows of the acceptance table on the demo and on its ground seen by other sensors."""

from __future__ import annotations

import json
import sys
from itertools import product
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from rows.rendered import surfaces_of
from workplace import ZLOCUS, Figure, Workplace, rendered_images, run
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.io.scene_file import open_scene
from zlocus.synthetic.mixed import SENSORS
from zlocus.synthetic.scenes import demo_spec

# Twice the ground pixel of the demo's line scanner, and the shares of its heights that must lie within it, by class.
TWO_PIXELS_M, DEMO_BARS = 0.42, {"ground": 0.97, "building": 0.85}
# A height that is off by more than this is false; the bar is the share of such heights on the ground.
FALSE_HEIGHT_M, MAX_FALSE_SHARE = 10.0, 0.001
# Share of the cells seen by two images that had a height at commit f47ff51, and how much of it the removal of false
# heights may cost.
DEMO_COMPLETENESS, MAX_COMPLETENESS_LOST = 0.9799, 0.02


def demo(workplace: Workplace) -> list[Figure]:
    """The demo, and its ground seen from a steady flight: once with the trajectories, once with RPC fitted to them."""
    run([ZLOCUS, "demo", "-o", workplace.out / "demo"])
    scene = workplace.out / "demo" / "scene"
    inner = truth_of_area(scene, workplace.out / "inner")
    figures = whole_area(workplace.out / "demo", scene)
    for limit, bars in ((TWO_PIXELS_M, DEMO_BARS), (1.0, {})):
        found = workplace.judge(workplace.out / "demo" / "dsm.tif", inner, "--thr", str(limit))
        for kind in surfaces_of("city", "tree"):
            what = f"within {limit:g} m: {kind}"
            figures.append(Figure(what, found[kind]["within"], at_least=bars.get(kind)))
    heights = open_scene([scene / "scene.yaml"]).heights
    for cameras in ("linescan", "rpc"):
        folder = workplace.out / f"{cameras}-scene"
        synthetic = [sys.executable, "-m", "zlocus.synthetic", "--kind", "demo", "--seed", demo_spec().seed]
        run([*synthetic, "--steady", "--cameras", cameras, "-o", folder])
        inputs = [folder / "scene.yaml"] if cameras == "linescan" else rendered_images(folder)
        out = ["-o", workplace.out / cameras, "--resolution", 0.2, "--crs", "EPSG:32632", "--heights", *heights]
        run([ZLOCUS, "dsm", *inputs, *out, "--overwrite"])
    fits = json.loads((folder / "scene.json").read_text())["views"].values()
    figures.append(
        Figure("RPC of the steady flight, worst fit", max(v["rpc_fit_max_px"] for v in fits), "px", at_most=0.05)
    )
    nmad = {name: nmad_of(workplace.out / name, inner) for name in ("demo", "linescan", "rpc")}
    for name, what in (("linescan", "steady flight"), ("demo", "demo")):
        for kind, value in nmad[name].items():
            difference = value / nmad["rpc"][kind] - 1
            figures.append(Figure(f"{what} over RPC, NMAD {kind}, off 1", difference, at_least=-0.05, at_most=0.05))
    return figures


def whole_area(out: Path, scene: Path) -> list[Figure]:
    """Completeness and false heights of the demo over all ground that two images see, with its rim."""
    truth, classes = scene / "truth_dsm.tif", scene / "truth_class.tif"
    found = evaluate(
        out / "dsm.tif", Comparison(truth, classes=classes, margin_m=0.0, more_thresholds_m=(FALSE_HEIGHT_M,))
    )
    figures = [
        Figure(
            "whole area: with a height",
            found.statistics.completeness,
            at_least=DEMO_COMPLETENESS - MAX_COMPLETENESS_LOST,
        )
    ]
    for name, each, bar in (
        ("ground", found.class_statistics["ground"], MAX_FALSE_SHARE),
        ("all", found.statistics, None),
    ):
        false_share = 1.0 - each.as_dict()["within_m"][f"{FALSE_HEIGHT_M:g}"] / each.completeness
        figures.append(
            Figure(f"whole area: {name} heights off by more than {FALSE_HEIGHT_M:g} m", false_share, at_most=bar)
        )
    return figures


def truth_of_area(scene: Path, folder: Path) -> Path:
    """Write the truth of the demo's own area, without the rim that few images see, and return its folder."""
    spec = demo_spec()
    folder.mkdir()
    for name in ("truth_dsm.tif", "truth_class.tif"):
        with rasterio.open(scene / name) as source:
            row, col = source.index(spec.west_m + spec.step_m / 2, spec.north_m - spec.step_m / 2)
            n_cells = round(spec.size * spec.gsd_m / spec.step_m)
            window = Window(col, row, n_cells, n_cells)
            profile = {"driver": "GTiff", "height": n_cells, "width": n_cells, "count": 1, "crs": source.crs}
            profile |= {"dtype": source.dtypes[0], "transform": source.window_transform(window)}
            with rasterio.open(folder / name, "w", **profile) as file:
                file.write(source.read(1, window=window), 1)
    return folder


def nmad_of(out: Path, scene: Path) -> dict[str, float]:
    """NMAD in metres, unrounded, of all cells and of the ground; the surface is not aligned first."""
    found = evaluate(out / "dsm.tif", Comparison(scene / "truth_dsm.tif", classes=scene / "truth_class.tif"))
    return {"all": found.statistics.nmad, "ground": found.class_statistics["ground"].nmad}


def mixed(workplace: Workplace) -> list[Figure]:
    """One ground seen by a line scanner, a frame camera and a satellite with RPC: each alone, and all together."""
    scene = workplace.out / "scene"
    run([sys.executable, "-m", "zlocus.synthetic", "--kind", "mixed", "--seed", demo_spec().seed, "-o", scene])
    within, nmad, figures = {}, {}, []
    for name in (*SENSORS, "mixed"):
        out = workplace.out / name
        run([ZLOCUS, "dsm", scene / f"{name}.yaml", "-o", out, "--resolution", 0.2, "--overwrite"])
        nmad[name] = nmad_of(out, scene)["ground"]
        for limit in (TWO_PIXELS_M, 1.0):
            found = workplace.judge(out / "dsm.tif", scene, "--thr", str(limit))
            for kind in surfaces_of("city", "tree"):
                within[name, limit, kind] = found[kind]["within"]
                figures.append(Figure(f"{name}: within {limit:g} m: {kind}", found[kind]["within"]))
        figures.append(Figure(f"{name}: NMAD ground", nmad[name], "m"))
    for limit, kind in product((TWO_PIXELS_M, 1.0), surfaces_of("city", "tree")):
        gain = within["mixed", limit, kind] - max(within[name, limit, kind] for name in SENSORS)
        figures.append(Figure(f"over the best alone, {limit:g} m: {kind}", gain, at_least=0.0))
    best = min(nmad[name] for name in SENSORS)
    figures.append(Figure("NMAD ground over the best alone", nmad["mixed"] / best, at_most=1.0))
    views = json.loads((workplace.out / "mixed" / "run.json").read_text())["orientation"]["views"].values()
    figures.append(Figure("worst shift of the exact cameras", max(np.abs(v["shift_px"]).max() for v in views), "px"))
    return figures
