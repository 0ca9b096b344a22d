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
# Other images of the demo's ground: options of `zlocus.synthetic`, and their names in the labels.
OTHER_FLIGHTS = {
    "raw": ("--cameras", "linescan", "--level", 0),
    "linescan": ("--cameras", "linescan", "--steady"),
    "rpc": ("--cameras", "rpc", "--steady"),
}
FLIGHT_NAMES = {"raw": "raw images", "linescan": "steady flight", "rpc": "steady flight through RPC"}
# A height that is off by more than this is false; the bar is the share of such heights on the ground.
FALSE_HEIGHT_M, MAX_FALSE_SHARE = 10.0, 0.001
# Share of the cells seen by two images that had a height at commit f47ff51, and how much of it the removal of false
# heights may cost.
DEMO_COMPLETENESS, MAX_COMPLETENESS_LOST = 0.9799, 0.02

SENSORS_DISAGREE = "sensors of several kinds are shifted against each other, or the worst images count as much"


def demo(workplace: Workplace) -> list[Figure]:
    """The demo, its raw images, and its ground seen from a steady flight: with the trajectories, and through RPC.

    The figures of the demo are those of `zlocus demo`: of all ground that two images see. The bars within 0.42 m hold
    for its inner area, without the rim of 10 m that few images see.
    """
    run([ZLOCUS, "demo", "-o", workplace.out / "demo"])
    scene = workplace.out / "demo" / "scene"
    inner = truth_of_area(scene, workplace.out / "inner")
    figures = whole_area(workplace.out / "demo", scene)
    found = workplace.judge(workplace.out / "demo" / "dsm.tif", inner, "--thr", str(TWO_PIXELS_M))
    for kind, bar in DEMO_BARS.items():
        figures.append(
            Figure(
                f"inner area, within {TWO_PIXELS_M:g} m: {kind}", found[kind]["within"], at_least=bar,
                fails_when="heights below a step are noisy, or roofs without texture are lost", is_detail=True,
            )
        )  # fmt: skip
    heights = open_scene([scene / "scene.yaml"]).heights
    for name, options in OTHER_FLIGHTS.items():
        folder = workplace.out / f"{name}-scene"
        synthetic = [sys.executable, "-m", "zlocus.synthetic", "--kind", "demo", "--seed", demo_spec().seed]
        run([*synthetic, *options, "-o", folder])
        inputs = rendered_images(folder) if name == "rpc" else [folder / "scene.yaml"]
        out = ["-o", workplace.out / name, "--resolution", 0.2, "--crs", "EPSG:32632", "--heights", *heights]
        used = run([ZLOCUS, "dsm", *inputs, *out, "--overwrite"])
        figures += flight_figures(FLIGHT_NAMES[name], workplace.out / name, scene, used.cpu_s)
    fits = json.loads((workplace.out / "rpc-scene" / "scene.json").read_text())["views"].values()
    figures.append(
        Figure(
            "RPC of the steady flight, worst fit", max(v["rpc_fit_max_px"] for v in fits), "px", at_most=0.05,
            fails_when="the RPC are fitted with too few terms or points",
        )
    )  # fmt: skip
    nmad = {name: nmad_of(workplace.out / name, inner) for name in ("demo", "linescan", "rpc")}
    for name, what in (("linescan", "steady flight"), ("demo", "demo")):
        for kind, value in nmad[name].items():
            figures.append(
                Figure(
                    f"{what} over RPC, NMAD {kind}, off 1", value / nmad["rpc"][kind] - 1, at_least=-0.05, at_most=0.05,
                    fails_when="the line scanner model or its interpolation is less exact than RPC",
                )
            )  # fmt: skip
    return figures


def whole_area(out: Path, scene: Path) -> list[Figure]:
    """Accuracy of the demo over all ground that two images see, with its rim, as it is and aligned."""
    truth, classes = scene / "truth_dsm.tif", scene / "truth_class.tif"
    plain, aligned = (
        evaluate(
            out / "dsm.tif",
            Comparison(truth, classes=classes, margin_m=0.0, align=is_aligned, more_thresholds_m=(FALSE_HEIGHT_M,)),
        )
        for is_aligned in (False, True)
    )
    of_all = {"all": plain.statistics, **plain.class_statistics}
    of_all_aligned = {"all": aligned.statistics, **aligned.class_statistics}
    bars = {"all": DEMO_COMPLETENESS - MAX_COMPLETENESS_LOST}
    figures: list[Figure] = []
    for kind in surfaces_of("city", "tree"):
        each, shifted = of_all[kind], of_all_aligned[kind]
        figures += [
            Figure(f"blocks: {kind}", each.n, is_detail=True),
            Figure(
                f"with a height: {kind}", each.completeness, at_least=bars.get(kind), is_detail=kind != "all",
                fails_when="the rules against false heights at the border empty true ones",
            ),
            Figure(f"within 1 m: {kind}", each.within),
            Figure(f"aligned, within 1 m: {kind}", shifted.within, is_detail=True),
            Figure(f"NMAD: {kind}", each.nmad, "m", is_detail=True),
            Figure(f"aligned, NMAD: {kind}", shifted.nmad, "m", is_detail=True),
        ]  # fmt: skip
    for kind, bar in (("ground", MAX_FALSE_SHARE), ("all", None)):
        each = of_all[kind]
        false_share = 1.0 - each.as_dict()["within_m"][f"{FALSE_HEIGHT_M:g}"] / each.completeness
        figures.append(
            Figure(
                f"heights off by more than {FALSE_HEIGHT_M:g} m: {kind}", false_share, at_most=bar,
                fails_when="two images agree by chance in free air at the border of their overlap",
            )
        )  # fmt: skip
    return figures


def flight_figures(what: str, out: Path, scene: Path, cpu_s: float) -> list[Figure]:
    """Accuracy of the same ground from other images, over the whole area of the demo, and the CPU of `zlocus dsm`."""
    found = evaluate(
        out / "dsm.tif", Comparison(scene / "truth_dsm.tif", classes=scene / "truth_class.tif", margin_m=0.0)
    ).class_statistics
    return [
        Figure(f"{what}, within 1 m: ground", found["ground"].within, is_detail=True),
        Figure(f"{what}, within 1 m: building", found["building"].within, is_detail=True),
        Figure(f"{what}, NMAD: ground", found["ground"].nmad, "m", is_detail=True),
        Figure(f"{what}, CPU", cpu_s, "s", is_detail=True),
    ]


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
                figures.append(Figure(f"{name}: within {limit:g} m: {kind}", found[kind]["within"], is_detail=True))
        figures.append(Figure(f"{name}: NMAD ground", nmad[name], "m", is_detail=True))
    for limit, kind in product((TWO_PIXELS_M, 1.0), surfaces_of("city", "tree")):
        gain = within["mixed", limit, kind] - max(within[name, limit, kind] for name in SENSORS)
        what = f"over the best alone, {limit:g} m: {kind}"
        figures.append(Figure(what, gain, at_least=0.0, fails_when=SENSORS_DISAGREE))
    best = min(nmad[name] for name in SENSORS)
    what = "NMAD ground over the best alone"
    figures.append(Figure(what, nmad["mixed"] / best, at_most=1.0, fails_when=SENSORS_DISAGREE))
    views = json.loads((workplace.out / "mixed" / "run.json").read_text())["orientation"]["views"].values()
    figures.append(Figure("worst shift of the exact cameras", max(np.abs(v["shift_px"]).max() for v in views), "px"))
    return figures
