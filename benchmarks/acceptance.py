"""The figures of the acceptance table, from the real commands on the shared scenes.

    python benchmarks/acceptance.py [ROW ...] [--slow] [--keep FOLDER]

Rows: see `ROWS`; without any, all but the slow ones. Exit status 1 when a row could not be run; a figure that falls
short of its bar is shown as such and changes nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import traceback
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from pyproj import CRS, Transformer
from rasterio.windows import Window

import compared
import inspecting
import large
import terrain_features
from baselines import baselines
from double_mapping import double_mapped
from middlebury import CASES, judge
from reprojection import Surface, reprojected
from strecha import write_strecha_scene
from workplace import RENDERED_VIEWS, ROOT, ZLOCUS, CannotRun, Figure, Workplace, render, rendered_images, run
from zlocus.core.scene import Scene
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.io.scene_file import open_scene, write_scene_file
from zlocus.synthetic.mixed import SENSORS
from zlocus.synthetic.scenes import demo_spec

# Views of a rendered town that are matched: two strips, one, a pair.
VIEWS = {"six": RENDERED_VIEWS, "three": RENDERED_VIEWS[:3], "two": RENDERED_VIEWS[:2]}
LARGE_SIDE_CELLS = 4000
COVERAGE_SHORT = 3
# Kind and seed of scenes that are rendered to be judged, never to choose an option by: chosen by what the baselines
# score there, before zlocus had seen them.
NEW_SCENES = (("city", 16), ("city", 20), ("hills", 43), ("hills", 50))
# Of a town, by the views matched: within 1 m of all cells or of a class, cells with a height (valid), NMAD of ground.
CITY_BARS = {
    "six": {"all": 0.97, "building": 0.92, "ground": 0.99, "tree": 0.60, "valid": 0.97, "nmad": 0.10},
    "three": {"all": 0.955, "building": 0.85, "ground": 0.98, "nmad": 0.10},
    "two": {"all": 0.925, "building": 0.72, "nmad": 0.25},
}
HILLS_NMAD_BAR_M = 0.16
# Of the ortho-image of a town: share of a class that shows what hides it. Grey values tell which image a cell shows, so
# they must be the image's own.
HIDDEN_BARS, OWN_LEVELS = {"ground": 0.005}, '[products]\northo_levels = "own"\n'
# Two ground pixels of the demo's line scanner, and shares of its surfaces within them.
TWO_PIXELS_M, DEMO_BARS = 0.42, {"ground": 0.97, "building": 0.85}
# The demo over all ground that two images see: heights that are off by more than this are false; the share of them on
# the ground; the share with a height at commit f47ff51, and how much of it may go for the sake of the false ones.
FAR_OFF_M, MOST_FAR_OFF = 10.0, 0.001
DEMO_FILLED, MOST_FILLED_LOST = 0.9799, 0.02
# A town of more than 4 M cells at 0.5 m, and CPU seconds per million cells that it may take.
SPEED_SIDE_CELLS, SPEED_SEED = 2048, 12
SPEED_BARS_S = {"six": 8.0, "three": 4.0}
# Standard deviation of heights that a user of oblique drone images may ask for (checks.most_sigma_m).
PRECISE_M = 1.0
POINTING_PX = {"city": 0, "hills": 4}
SHARED_SCENES = {"city": "rendered-city", "hills": "rendered-hills-biased"}
N_SIGNALS = 30
# Directions in the axes of the facade's cameras: out of the wall, and up along it. Heights are moved by so much to see
# what the correlations are worth.
FACADE_UP, FACADE_NORTH, MOVED_M = (-0.733, 0.68, 0.0), (0.0, 0.0, -1.0), 0.05


def calanques(at: Workplace) -> list[Figure]:
    """Pleiades triplet, against the surface of another program."""
    scene = at.scene("pleiades_triplet_calanques")
    reference = scene / "reference" / "s2p_dsm_0.5m_utm31n.tif"
    images = sorted(scene.glob("img_0*.tif"))
    for _ in ("compile the kernels", "measure"):
        used = run([ZLOCUS, "dsm", *images, "-o", at.out, "--like", reference, "--workers", 1, "--overwrite"])
    dsm = at.out / "dsm.tif"
    plain = evaluate(dsm, reference, margin_m=0)
    aligned = evaluate(dsm, reference, align=True)
    return [
        Figure("NMAD, aligned", aligned.all.nmad, "m", at_most=0.55),
        Figure("reference's cells filled", plain.all.completeness, at_least=0.99),
        Figure("median offset, as it is", plain.all.median, "m"),
        Figure("shift east", aligned.shift.east_m, "m"),
        Figure("shift north", aligned.shift.north_m, "m"),
        Figure("CPU, kernels cached", used.cpu_s, "s", at_most=8),
        *staircase(at.out),
    ]


def staircase(out: Path) -> list[Figure]:
    """Fewest and most heights in a tenth of a height step, over the mean of the ten: even without a staircase."""
    heights = json.loads((out / "run.json").read_text())["heights"]
    with rasterio.open(out / "dsm.tif") as file:
        found = file.read(1).astype(float)
    steps = (found[np.isfinite(found)] - heights["range_m"][0]) / heights["step_m"]
    share = np.bincount((10 * (steps % 1)).astype(int).clip(0, 9), minlength=10) / len(steps) * 10
    return [
        Figure("least of the tenths of a step", share.min(), at_least=0.8),
        Figure("most of the tenths of a step", share.max(), at_most=1.2),
    ]


def demo(at: Workplace) -> list[Figure]:
    """The demo, and its ground seen from a steady flight, through the trajectories and through RPC fitted to them."""
    run([ZLOCUS, "demo", "-o", at.out / "demo"])
    scene = at.out / "demo" / "scene"
    inner, figures = truth_of_area(scene, at.out / "inner"), whole_demo(at.out / "demo", scene)
    for limit, bars in ((TWO_PIXELS_M, DEMO_BARS), (1.0, {})):
        found = at.judge(at.out / "demo" / "dsm.tif", inner, "--thr", str(limit))
        for kind in surfaces_of("city", "tree"):
            what = f"within {limit:g} m: {kind}"
            figures.append(Figure(what, found[kind]["within"], at_least=bars.get(kind)))
    heights = open_scene([scene / "scene.yaml"]).heights
    for cameras in ("linescan", "rpc"):
        folder = at.out / f"{cameras}-scene"
        synthetic = [sys.executable, "-m", "zlocus.synthetic", "--kind", "demo", "--seed", demo_spec().seed]
        run([*synthetic, "--steady", "--cameras", cameras, "-o", folder])
        inputs = [folder / "scene.yaml"] if cameras == "linescan" else rendered_images(folder)
        out = ["-o", at.out / cameras, "--resolution", 0.2, "--crs", "EPSG:32632", "--heights", *heights]
        run([ZLOCUS, "dsm", *inputs, *out, "--overwrite"])
    fits = json.loads((folder / "scene.json").read_text())["views"].values()
    figures.append(
        Figure("RPC of the steady flight, worst fit", max(v["rpc_fit_max_px"] for v in fits), "px", at_most=0.05)
    )
    nmad = {name: nmad_of(at.out / name, inner) for name in ("demo", "linescan", "rpc")}
    for name, what in (("linescan", "steady flight"), ("demo", "demo")):
        for kind, value in nmad[name].items():
            off = value / nmad["rpc"][kind] - 1
            figures.append(Figure(f"{what} over RPC, NMAD {kind}, off 1", off, at_least=-0.05, at_most=0.05))
    return figures


def whole_demo(out: Path, scene: Path) -> list[Figure]:
    """The demo's surface over all ground that two images see, its rim included."""
    truth, classes = scene / "truth_dsm.tif", scene / "truth_class.tif"
    found = evaluate(out / "dsm.tif", truth, classes=classes, margin_m=0.0, more_thresholds_m=(FAR_OFF_M,))
    figures = [Figure("whole area: with a height", found.all.completeness, at_least=DEMO_FILLED - MOST_FILLED_LOST)]
    for name, each, bar in (("ground", found.classes["ground"], MOST_FAR_OFF), ("all", found.all, None)):
        far_off = 1.0 - each.as_dict()["within_m"][f"{FAR_OFF_M:g}"] / each.completeness
        figures.append(Figure(f"whole area: {name} heights off by more than {FAR_OFF_M:g} m", far_off, at_most=bar))
    return figures


def truth_of_area(scene: Path, folder: Path) -> Path:
    """A folder with the truth of the demo's own area, which leaves out the rim that few images see."""
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
    """NMAD of a surface as it is, with all digits: of all and of ground."""
    found = evaluate(out / "dsm.tif", scene / "truth_dsm.tif", classes=scene / "truth_class.tif")
    return {"all": found.all.nmad, "ground": found.classes["ground"].nmad}


def mixed(at: Workplace) -> list[Figure]:
    """One rendered ground seen by a line scanner, a frame camera and a satellite with RPC: together, and each alone."""
    scene = at.out / "scene"
    run([sys.executable, "-m", "zlocus.synthetic", "--kind", "mixed", "--seed", demo_spec().seed, "-o", scene])
    within, nmad, figures = {}, {}, []
    for name in (*SENSORS, "mixed"):
        out = at.out / name
        run([ZLOCUS, "dsm", scene / f"{name}.yaml", "-o", out, "--resolution", 0.2, "--overwrite"])
        nmad[name] = nmad_of(out, scene)["ground"]
        for limit in (TWO_PIXELS_M, 1.0):
            found = at.judge(out / "dsm.tif", scene, "--thr", str(limit))
            for kind in surfaces_of("city", "tree"):
                within[name, limit, kind] = found[kind]["within"]
                figures.append(Figure(f"{name}: within {limit:g} m: {kind}", found[kind]["within"]))
        figures.append(Figure(f"{name}: NMAD ground", nmad[name], "m"))
    for limit, kind in product((TWO_PIXELS_M, 1.0), surfaces_of("city", "tree")):
        gain = within["mixed", limit, kind] - max(within[name, limit, kind] for name in SENSORS)
        figures.append(Figure(f"over the best alone, {limit:g} m: {kind}", gain, at_least=0.0))
    best = min(nmad[name] for name in SENSORS)
    figures.append(Figure("NMAD ground over the best alone", nmad["mixed"] / best, at_most=1.0))
    views = json.loads((at.out / "mixed" / "run.json").read_text())["orientation"]["views"].values()
    figures.append(Figure("worst shift of the exact cameras", max(np.abs(v["shift_px"]).max() for v in views), "px"))
    return figures


def city(at: Workplace) -> list[Figure]:
    """Rendered town, six views, exact truth."""
    scene = at.scene("rendered-city")
    run([ZLOCUS, "dsm", *rendered_images(scene), "-o", at.out, "--resolution", 0.5, "--overwrite"])
    figures = at.judge(at.out / "dsm.tif", scene)
    return [
        Figure("within 1 m: all", figures["all"]["within"], at_least=0.955),
        Figure("within 1 m: ground", figures["ground"]["within"], at_least=0.98),
        Figure("within 1 m: building", figures["building"]["within"], at_least=0.82),
        Figure("within 1 m: tree", figures["tree"]["within"]),
        Figure("NMAD ground", figures["ground"]["nmad"], "m", at_most=0.12),
    ]


def hills(at: Workplace) -> list[Figure]:
    """Rendered hills seen by wrongly pointed cameras."""
    scene = at.scene("rendered-hills-biased")
    images = rendered_images(scene)
    run([ZLOCUS, "dsm", *images, "-o", at.out, "--resolution", 0.5, "--overwrite"])
    figures = at.judge(at.out / "dsm.tif", scene, "--align")
    views = json.loads((at.out / "run.json").read_text())["orientation"]["views"]
    truth = json.loads((scene / "scene.json").read_text())
    opened = open_scene(images)
    # What an RPC projects too far is what the correction must take off again.
    wrong = np.array([truth["views"][view]["bias_row_col"][::-1] for view in RENDERED_VIEWS])
    applied = np.array([views[view.name]["shift_px"] for view in opened.views])
    left = shifts_left(opened, applied + wrong, (truth["zmin"] + truth["zmax"]) / 2)
    return [
        Figure("NMAD ground, aligned", figures["ground"]["nmad"], "m", at_most=0.16),
        Figure("within 1 m: ground", figures["ground"]["within"]),
        Figure("worst shift, after the fit", float(left.max()), "px", at_most=0.1),
    ]


def shifts_left(scene: Scene, shifts: np.ndarray, z: float) -> np.ndarray:
    """What of the shifts (i, 2) px a common translation of the ground does not explain. (i,) px."""
    centre = np.array([[(n - 1) / 2 for n in scene.views[0].image.shape[::-1]]])
    ground = scene.views[0].sensor.ground_from_image(centre, np.array([z]))
    step = np.vstack([np.zeros(3), np.eye(3)])
    seen = [view.sensor.image_from_ground(ground + step) for view in scene.views]
    px_per_m = np.concatenate([(xy[1:] - xy[0]).T for xy in seen])
    translation, *_ = np.linalg.lstsq(px_per_m, shifts.ravel(), rcond=None)
    return np.hypot(*(shifts.ravel() - px_per_m @ translation).reshape(-1, 2).T)


def joint(at: Workplace) -> list[Figure]:
    """The same hills: all cameras corrected by `zlocus orient`, written, read back and matched."""
    scene = at.scene("rendered-hills-biased")
    images = rendered_images(scene)
    run([ZLOCUS, "orient", *images, "-o", at.out / "oriented", "--overwrite"])
    written = at.out / "oriented" / "scene.yaml"
    report = json.loads((at.out / "oriented" / "orientation.json").read_text())
    truth = json.loads((scene / "scene.json").read_text())
    middle = (truth["zmin"] + truth["zmax"]) / 2
    delivered, corrected = open_scene(images), {view.name: view for view in open_scene([written]).views}
    wrong = np.array([truth["views"][view]["bias_row_col"][::-1] for view in RENDERED_VIEWS])
    ground = delivered.views[0].sensor.ground_from_image(np.array([[300.0, 300.0]]), np.array([middle]))
    applied = np.concatenate(
        [
            corrected[view.name].sensor.image_from_ground(ground) - view.sensor.image_from_ground(ground)
            for view in delivered.views
        ]
    )
    left = shifts_left(delivered, applied + wrong, middle)
    run([ZLOCUS, "dsm", written, "-o", at.out / "dsm", "--resolution", 0.5, "--overwrite"])
    run([ZLOCUS, "dsm", *images, "-o", at.out / "plain", "--resolution", 0.5, "--overwrite"])
    found, plain = (at.judge(at.out / name / "dsm.tif", scene, "--align")["ground"] for name in ("dsm", "plain"))
    between = evaluate(at.out / "dsm" / "dsm.tif", at.out / "plain" / "dsm.tif", margin_m=0).all
    return [
        Figure("worst shift, after the fit", float(left.max()), "px", at_most=0.05),
        Figure("NMAD ground, aligned", found["nmad"], "m", at_most=0.14),
        Figure("the same, images as they are", plain["nmad"], "m"),
        Figure("sigma0", report["sigma0_px"], "px"),
        Figure("against images as they are, median", abs(between.median), "m"),
        Figure("against images as they are, NMAD", between.nmad, "m"),
    ]


def city_views(at: Workplace) -> list[Figure]:
    """The shared town with six, three and two views."""
    scene, figures = at.scene("rendered-city"), []
    for name, views in VIEWS.items():
        run([ZLOCUS, "dsm", *rendered_images(scene, views), "-o", at.out, "--resolution", 0.5, "--overwrite"])
        figures += town_figures(name, at.judge(at.out / "dsm.tif", scene), CITY_BARS[name])
    return figures


def town_figures(what: str, found: dict[str, dict[str, float]], bars: dict[str, float]) -> list[Figure]:
    """How near a town's surface is to the truth. bars : see `CITY_BARS`; a figure without one is only reported."""
    within = [
        Figure(f"{what}, within 1 m: {kind}", found[kind]["within"], at_least=bars.get(kind))
        for kind in surfaces_of("city", "tree")
    ]
    return [
        *within,
        Figure(f"{what}, valid", found["all"]["complete"], at_least=bars.get("valid")),
        Figure(f"{what}, NMAD ground", found["ground"]["nmad"], "m", at_most=bars.get("nmad")),
    ]


def new_scenes(at: Workplace) -> list[Figure]:
    """Rendered scenes that no option was chosen on, as hard as the shared ones by methods that are not zlocus' own."""
    figures, shared = [], {}
    for kind, seed in NEW_SCENES:
        scene = at.out / f"{kind}{seed}"
        render(scene, kind, 520, "--seed", seed, "--pointing", POINTING_PX[kind])
        figures += new_scene(at, kind, seed, scene)
        if kind not in shared:
            shared[kind] = baselines(at.scene(SHARED_SCENES[kind]), at.out / f"{kind}-baselines")
        for method, here in baselines(scene, at.out / f"{kind}{seed}-baselines").items():
            there = shared[kind][method]
            gap = max(abs(here[surface]["within"] - there[surface]["within"]) for surface in surfaces_of(kind))
            figures.append(Figure(f"{kind} {seed}, {method} against shared", gap, at_most=0.03))
    return figures


def new_scene(at: Workplace, kind: str, seed: int, scene: Path) -> list[Figure]:
    """A scene that no option was chosen on: towns with six, three and two views, hills with six."""
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        crs = truth.crs.to_string()
    figures: list[Figure] = []
    for name, views in VIEWS.items() if kind == "city" else [("six", RENDERED_VIEWS)]:
        out = at.out / f"{kind}{seed}-{name}"
        images = rendered_images(scene, views)
        run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--crs", crs, "--overwrite"])
        found = at.judge(out / "dsm.tif", scene, *(["--align"] if kind == "hills" else []))
        if kind == "city":
            figures += town_figures(f"city {seed}, {name}", found, CITY_BARS[name])
            continue
        for surface in surfaces_of(kind, "tree"):
            figures.append(Figure(f"{kind} {seed}, within 1 m: {surface}", found[surface]["within"]))
        figures.append(Figure(f"{kind} {seed}, NMAD ground", found["ground"]["nmad"], "m", at_most=HILLS_NMAD_BAR_M))
    return figures


def ortho(at: Workplace) -> list[Figure]:
    """The true ortho-image of the rendered town: cells that show what hides them."""
    scene = at.scene("rendered-city")
    images = rendered_images(scene)
    options = at.out.with_suffix(".toml")
    options.parent.mkdir(parents=True, exist_ok=True)
    options.write_text(OWN_LEVELS)
    run([ZLOCUS, "dsm", *images, "-o", at.out, "--resolution", 0.5, "--config", options, "--overwrite"])
    found = double_mapped(at.out, scene / "truth_dsm.tif", scene / "truth_class.tif", open_scene(images))
    return [
        Figure(f"{kind} that shows what hides it{which}", share, at_most=HIDDEN_BARS.get(kind + which))
        for kind, shares in found.items()
        for which, share in zip(("", ", of right heights"), shares, strict=True)
    ]


def surfaces_of(kind: str, *more: str) -> tuple[str, ...]:
    """Classes of a rendered scene that are judged."""
    return ("all", "ground", *(("building",) if kind == "city" else ()), *more)


def ventoux(at: Workplace) -> list[Figure]:
    """Pleiades pair with little overlap and a large pointing error: the height range is found from the ties."""
    scene = at.scene("pleiades_pair_ventoux")
    images = sorted(scene.glob("img_0*.tif"))
    run([ZLOCUS, "dsm", *images, "-o", at.out, "--overwrite"], accept=(0, COVERAGE_SHORT))
    opened = open_scene(images)
    srtm = read_heights(scene / "reference" / "srtm3_v2_egm96_heights.tif")
    geoid = read_heights(scene / "reference" / "geoid_egm96_15min.tif")
    xyz = ground_seen_by_all(opened, srtm, geoid)
    dsm = read_heights(at.out / "dsm.tif")
    to_grid = Transformer.from_crs(opened.crs, CRS.from_user_input(dsm.crs), always_xy=True)
    z = dsm.nearest(np.column_stack(to_grid.transform(xyz[:, 0], xyz[:, 1])))
    return [
        Figure("ground seen by both, filled", float(np.isfinite(z).mean()), at_least=0.6),
        Figure("|median difference to SRTM|", abs(float(np.nanmedian(z - xyz[:, 2]))), "m", at_most=10),
        *staircase(at.out),
    ]


def datum(at: Workplace) -> list[Figure]:
    """Surfaces above a geoid against the ellipsoidal ones less its undulation, which is interpolated by other code."""
    figures = []
    for name in ("pleiades_triplet_calanques", "pleiades_pair_ventoux"):
        scene = at.scene(name)
        geoid = scene / "reference" / "geoid_egm96_15min.tif"
        found = []
        for vertical in ("ellipsoid", geoid):
            out = at.out / f"{name}-{len(found)}"
            images = sorted(scene.glob("img_0*.tif"))
            run([ZLOCUS, "dsm", *images, "-o", out, "--vertical", vertical, "--overwrite"], accept=(0, COVERAGE_SHORT))
            found.append(read_heights(out / "dsm.tif"))
        plain, above = found
        row, col = np.nonzero(np.isfinite(plain.z) | np.isfinite(above.z))
        xy = np.column_stack(plain.transform * (col + 0.5, row + 0.5))
        to_degrees = Transformer.from_crs(CRS.from_user_input(plain.crs), "EPSG:4326", always_xy=True)
        expected = plain.z[row, col] - read_heights(geoid).bilinear(np.column_stack(to_degrees.transform(*xy.T)))
        # A height that only one of both has makes this NaN, which passes no bar.
        worst = float(np.abs(above.z[row, col] - expected).max())
        figures.append(Figure(f"{name.split('_')[-1]}, worst difference", worst, "m", at_most=0.01))
    return figures


def ground_seen_by_all(scene: Scene, srtm: HeightRaster, geoid: HeightRaster) -> np.ndarray:
    """Ground points (n, 3) one metre apart, on a coarse terrain model, that lie inside every image."""
    rows, cols = scene.views[0].image.shape
    corners = np.array([[0, 0], [cols, 0], [0, rows], [cols, rows]], float)
    box = np.vstack([scene.views[0].sensor.ground_from_image(corners, np.full(4, z)) for z in (0.0, 1500.0)])
    x, y = np.meshgrid(*(np.arange(np.floor(box[:, k].min()), box[:, k].max()) for k in (0, 1)))
    to_degrees = Transformer.from_crs(scene.crs, "EPSG:4326", always_xy=True)
    degrees = np.column_stack(to_degrees.transform(x.ravel(), y.ravel()))
    xyz = np.column_stack([x.ravel(), y.ravel(), srtm.bilinear(degrees) + geoid.bilinear(degrees)])
    inside = np.isfinite(xyz).all(axis=1)
    for view in scene.views:
        xy = view.sensor.image_from_ground(xyz)
        inside &= np.all((xy >= 0) & (xy <= np.array(view.image.shape[::-1]) - 1), axis=1)
    return xyz[inside]


def dmc(at: Workplace) -> list[Figure]:
    """Four images of a mapping camera in two strips, with their exterior orientation; no heights are given."""
    scene = at.scene("aerial_ngi_dmc")
    at.out.mkdir(parents=True, exist_ok=True)
    (camera := at.out / "camera.yaml").write_text(f"focal: {120 / 0.144}\n")
    crs = "+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    run([ZLOCUS, "import", "eo", scene, "--crs", crs, "--camera", camera, "-o", at.out / "scene.yaml"])
    run([ZLOCUS, "dsm", at.out / "scene.yaml", "-o", at.out / "dsm"], accept=(0, COVERAGE_SHORT))
    # Columns in front of what a terrain model of 24 m cells says; a blunder is far beyond what it may be wrong by.
    error, _ = errors_where_two_see(at.out, scene / "reference" / "dem_24m_egm2008.tif")
    return [
        *two_view_figures(error, least_filled=0.7, most_nmad_m=8.0, most_median_m=6.0),
        Figure("found heights > 50 m off", float((np.abs(error[np.isfinite(error)]) > 50.0).mean())),
    ]


def tuniu(at: Workplace) -> list[Figure]:
    """Four oblique images of a drone, in four directions; no heights are given."""
    scene = at.scene("drone_tuniu_oblique")
    at.out.mkdir(parents=True, exist_ok=True)
    (bundle,) = json.loads((scene / "opensfm_reconstruction.json").read_text())[0]["cameras"].values()
    side, lens = bundle["width"], {name: bundle[name] for name in ("k1", "k2", "k3", "p1", "p2")}
    point = [(bundle[f"c_{axis}"] * side + (bundle[size] - 1) / 2) for axis, size in (("x", "width"), ("y", "height"))]
    (camera := at.out / "camera.yaml").write_text(
        json.dumps(
            {"focal": bundle["focal_x"] * side, "principal_point": point, "distortion": {"kind": "brown", **lens}}
        )
    )
    table = ["--crs", "EPSG:32651", "--earth", "flat", "--camera", camera]
    run([ZLOCUS, "import", "eo", scene, *table, "-o", at.out / "scene.yaml"])
    run([ZLOCUS, "dsm", at.out / "scene.yaml", "-o", at.out / "dsm"], accept=(0, COVERAGE_SHORT))
    error, sigma = errors_where_two_see(at.out, scene / "reference" / "odm_dsm_0.8m.tif")
    precise = np.where(sigma <= PRECISE_M, error, np.nan)
    left_out = json.loads((at.out / "dsm" / "run.json").read_text())["left_out_cells"]
    return [
        *two_view_figures(error, least_filled=0.6, most_nmad_m=0.5),
        *two_view_figures(precise, least_filled=0.6, most_nmad_m=0.5, which=f", sigma <= {PRECISE_M:g} m"),
        Figure("cells an image was left out of", float(left_out)),
    ]


def herzjesu(at: Workplace) -> list[Figure]:
    """Eight photographs of a facade in a local frame: heights from every second one, seen by the others."""
    scene = at.scene("herzjesu_p8")
    at.out.mkdir(parents=True, exist_ok=True)
    written = write_strecha_scene(scene, at.out / "scene.yaml", FACADE_UP, FACADE_NORTH)
    write_scene_file(at.out / "half.yaml", written.model_copy(update={"views": written.views[::2]}))
    run([ZLOCUS, "dsm", at.out / "half.yaml", "-o", at.out / "dsm", "--overwrite"], accept=(0, COVERAGE_SHORT))
    record = json.loads((at.out / "dsm" / "run.json").read_text())
    views, surface = open_scene([at.out / "scene.yaml"]).views, Surface.read(at.out / "dsm" / "dsm.tif")
    found = reprojected(surface, views[::2], views[1::2])
    together = np.concatenate([one.ncc for one in found.values()])
    figures = [Figure("left-out images, median NCC", float(np.median(together)), at_least=0.7)]
    for name, one in found.items():
        figures.append(Figure(f"image {name}, median NCC", one.median))
        for what in ("hidden", "outside", "untextured", "at_rim"):
            figures.append(Figure(f"image {name}, {what.replace('_', ' ')}", getattr(one, what) / one.with_height))
        figures.append(Figure(f"image {name}, compared", len(one.ncc) / one.with_height))
    worse = reprojected(surface, views[::2], views[1::2], MOVED_M)
    ncc = float(np.median(np.concatenate([one.ncc for one in worse.values()])))
    figures.append(Figure(f"heights moved by {MOVED_M:g} m, median NCC", ncc))
    return [
        *figures,
        Figure("cell", surface.cell_m, "m"),
        Figure("million cells", surface.xyz[..., 2].size / 1e6),
        Figure("seen by two, filled", record["coverage"]),
        *of_all_processes(record),
    ]


def two_view_figures(
    error: np.ndarray, least_filled: float, most_nmad_m: float, most_median_m: float | None = None, which: str = ""
) -> list[Figure]:
    """Of the ground that two images see. error : (n,) m, NaN where there is no height; which : of them, as a label."""
    found = error[np.isfinite(error)]
    median = float(np.median(found))
    return [
        Figure(f"ground seen by two, filled{which}", float(np.isfinite(error).mean()), at_least=least_filled),
        Figure(f"|median difference|{which}", abs(median), "m", at_most=most_median_m),
        Figure(f"NMAD{which}", float(1.4826 * np.median(np.abs(found - median))), "m", at_most=most_nmad_m),
    ]


def errors_where_two_see(folder: Path, reference: Path) -> tuple[np.ndarray, np.ndarray]:
    """Heights of a surface less those of a reference, at the reference's cells that two images see, and their standard
    deviations by the surface, (n,) m each."""
    opened = open_scene([folder / "scene.yaml"])
    dsm, sigma = (read_heights(folder / "dsm" / f"{name}.tif") for name in ("dsm", "sigma"))
    with rasterio.open(reference) as source:
        z, transform = source.read(1, masked=True).astype(float).filled(np.nan), source.transform
    col, row = np.meshgrid(np.arange(z.shape[1]) + 0.5, np.arange(z.shape[0]) + 0.5)
    x, y = transform * (col, row)
    xyz = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    n_seeing = np.zeros(len(xyz), int)
    for view in opened.views:
        xy = view.sensor.image_from_ground(xyz)
        n_seeing += ((xy >= 0) & (xy <= np.array(view.image.shape[::-1]) - 1)).all(axis=1)
    xyz = xyz[n_seeing >= 2]
    return np.asarray(dsm.nearest(xyz[:, :2]) - xyz[:, 2]), np.asarray(sigma.nearest(xyz[:, :2]))


def selection(at: Workplace) -> list[Figure]:
    """Eight views of the rendered town, one of another date and one hazy: those that help against all of them."""
    scene = at.scene("rendered-city")
    every = sorted(scene.glob("img_*.tif"))
    figures, shares, cpu = [], {}, {}
    for name, images, views in (
        ("all", every, "all"),
        ("good", rendered_images(scene), "auto"),
        ("auto", every, "auto"),
    ):
        out = at.out / name
        run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--views", views, "--overwrite"])
        found, record = at.judge(out / "dsm.tif", scene), json.loads((out / "run.json").read_text())
        shares[name] = {surface: found[surface]["within"] for surface in ("all", "building")}
        cpu[name] = sum(stage["cpu_s"] for stage in record["stages"])
    for surface in ("all", "building"):
        gain, loss = (shares["auto"][surface] - shares[other][surface] for other in ("all", "good"))
        figures.append(Figure(f"{surface}: over all images", gain, at_least=0.005))
        figures.append(Figure(f"{surface}: over the six good ones", loss, at_least=-0.005))
    counted = record["evaluations"]
    figures.append(Figure("evaluations saved", 1 - counted["done"] / counted["all_images"], at_least=0.4))
    figures.append(Figure("CPU over that of all images", cpu["auto"] / cpu["all"], at_most=1))
    return [*figures, no_worse(at, "hills"), no_worse(at, "calanques")]


def no_worse(at: Workplace, name: str) -> Figure:
    """NMAD with the images that help over NMAD with all of them."""
    nmad = {}
    for views in ("all", "auto"):
        out = at.out / f"{name}-{views}"
        if name == "hills":
            scene = at.scene("rendered-hills-biased")
            images = sorted(scene.glob("img_*.tif"))
            run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--views", views, "--overwrite"])
            nmad[views] = at.judge(out / "dsm.tif", scene, "--align")["ground"]["nmad"]
        else:
            scene = at.scene("pleiades_triplet_calanques")
            reference = scene / "reference" / "s2p_dsm_0.5m_utm31n.tif"
            images = sorted(scene.glob("img_0*.tif"))
            run([ZLOCUS, "dsm", *images, "-o", out, "--like", reference, "--views", views, "--overwrite"])
            nmad[views] = evaluate(out / "dsm.tif", reference, align=True).all.nmad
    return Figure(f"{name}: NMAD over that of all images", nmad["auto"] / nmad["all"], at_most=1.02)


def middlebury(at: Workplace) -> list[Figure]:
    """Real rectified photographs through `zlocus cloud`, beside OpenCV's StereoSGBM in its slowest mode."""
    scenes = at.scene("middlebury_multiview")
    found = {name: judge(scenes, name, at.out / name.replace(", ", "-").replace(" ", "-")) for name in CASES}
    share = {name: case.zlocus for name, case in found.items()}
    bars = {"cones, 2 views": 4.0, "teddy, 2 views": 7.0}
    figures = [Figure(f"{name}: bad > 1 px", value, "%", at_most=bars.get(name)) for name, value in share.items()]
    figures += [Figure(f"{name}: over OpenCV's", share[name] / found[name].opencv, at_most=1) for name in bars]
    for more, fewer in (("cones, 3 views", "cones, 2 views"), ("tsukuba, 5 views", "tsukuba, 2 views")):
        figures.append(Figure(f"{more} over {fewer}", share[more] / share[fewer], at_most=1))
    return figures


def features(at: Workplace) -> list[Figure]:
    """Three rendered terrain features: what the semi-global constraint and the levels gain."""
    at.out.mkdir(parents=True, exist_ok=True)
    lines = []
    for name in terrain_features.FEATURES:
        crop = terrain_features.rendered(name, terrain_features.VIEWS, at.out)
        found = {
            (method, levels): terrain_features.run(crop, method, levels, at.out)[0]
            for method, levels in product(terrain_features.METHODS, terrain_features.RESOLUTIONS)
        }
        (one_alone, many_alone), (one, many) = (
            [found[method, levels] for levels in terrain_features.RESOLUTIONS] for method in terrain_features.METHODS
        )
        lines.append(Figure(f"{name}: within 1 m", many["within_1"]))
        for levels, alone, joined in (("one", one_alone, one), ("many", many_alone, many)):
            gain = joined["within_1"] - alone["within_1"]
            lines.append(Figure(f"{name}: over MVLL alone, {levels}", gain, at_least=0.0))
        lines.append(Figure(f"{name}: many over one resolution", many["within_1"] - one["within_1"], at_least=-0.005))
        lines.append(Figure(f"{name}: evaluations over one's", many["evaluations"] / one["evaluations"], at_most=1.0))
    return lines


def kernels(at: Workplace, side: int | None = None) -> list[Figure]:
    """Speed of the kernels: what the benchmarks leave in their `extra_info`.

    side : cells along a side of their scenes, where that is not to be the usual one.
    """
    report = at.out / "benchmarks.json"
    at.out.mkdir(parents=True, exist_ok=True)
    options = ["--benchmark-enable", "--benchmark-only", f"--benchmark-json={report}"]
    options += [] if side is None else ["--side", str(side)]
    run([sys.executable, "-m", "pytest", ROOT / "benchmarks", *options], cwd=ROOT)
    found: dict[str, float] = {}
    for benchmark in json.loads(report.read_text())["benchmarks"]:
        found |= benchmark["extra_info"]
    try:
        sgm, opencv = found["sgm_cell_steps_per_s"], found["opencv_hh_cell_steps_per_s"]
        ncc = found["resample_ncc_ns"]
    except KeyError as missing:
        raise CannotRun(f"no benchmark gives {missing} in its extra_info") from missing
    return [
        Figure("SGM, 8 paths", sgm / 1e6, "M cell-steps/s", at_least=200),
        Figure("over OpenCV StereoSGBM HH", sgm / opencv, at_least=1.3),
        Figure("resample + NCC 7 x 7", ncc, "ns", at_most=6),
    ]


def memory(at: Workplace) -> list[Figure]:
    """Six rendered views of a large area."""
    scene = at.out / "scene"
    render(scene, "city", LARGE_SIDE_CELLS)
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        crs, bounds = truth.crs.to_string(), tuple(truth.bounds)
    images, out = rendered_images(scene), at.out / "dsm"
    run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--crs", crs, "--bounds", *bounds])
    return of_all_processes(json.loads((out / "run.json").read_text()), at_most_gb=3)


def of_all_processes(record: dict[str, Any], at_most_gb: float | None = None) -> list[Figure]:
    """CPU of a run and its workers, and the most memory that one of them held. Workers are no children of the command,
    whose own usage knows nothing of them."""
    stages = record["stages"]
    return [
        Figure("CPU", sum(stage["cpu_s"] for stage in stages), "s"),
        Figure("peak memory of a process", max(stage["peak_mb"] for stage in stages) / 1e3, "GB", at_most=at_most_gb),
    ]


def speed(at: Workplace) -> list[Figure]:
    """CPU of the whole program on a large town, one worker, kernels cached; and how good the surface is."""
    scene, small, figures = at.out / "scene", at.scene("rendered-city"), []
    render(scene, "city", SPEED_SIDE_CELLS, "--seed", SPEED_SEED)
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        crs, bounds = truth.crs.to_string(), tuple(truth.bounds)
    area = ["--resolution", 0.5, "--crs", crs, "--bounds", *bounds, "--workers", 1]
    million_cells = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / 0.5**2 / 1e6
    run([ZLOCUS, "dsm", *rendered_images(small), "-o", at.out / "compiled", "--resolution", 0.5, "--overwrite"])
    for name, bar in SPEED_BARS_S.items():
        out, images = at.out / name, rendered_images(scene, VIEWS[name])
        used = run([ZLOCUS, "dsm", *images, "-o", out, *area, "--overwrite"])
        per_million = used.cpu_s / million_cells
        figures.append(Figure(f"{name}, CPU per million cells", per_million, "s", at_most=bar))
        figures += town_figures(name, at.judge(out / "dsm.tif", scene), {})
    return [Figure("million cells", million_cells, at_least=4), *figures]


def signals(at: Workplace) -> list[Figure]:
    """A run that gets signals of four kinds at random moments and goes on after each: the test of it, with more."""
    test = "tests/runs/test_resume.py::test_signals_at_random_moments"
    used = run(["env", f"ZLOCUS_SIGNALS={N_SIGNALS}", sys.executable, "-m", "pytest", "-q", test], cwd=ROOT)
    return [Figure("signals, and the same bytes afterwards", N_SIGNALS), Figure("CPU", used.cpu_s, "s")]


def clone(at: Workplace) -> list[Figure]:
    """Nothing but the repository, Python and make."""
    folder = at.out / "zlocus"
    run(["git", "clone", "--quiet", ROOT, folder])
    figures = []
    for target in ("demo", "test"):
        used = run(["make", target, f"PYTHON={sys.base_prefix}/bin/python3"], cwd=folder)
        figures.append(Figure(f"make {target} passes, CPU", used.cpu_s, "s"))
    return figures


ROWS: dict[str, Callable[[Workplace], list[Figure]]] = {
    "demo": demo, "mixed": mixed, "calanques": calanques, "city": city, "city-views": city_views, "hills": hills,
    "joint": joint,
    "new-scenes": new_scenes, "ventoux": ventoux, "datum": datum, "ortho": ortho,
    "dmc": dmc, "tuniu": tuniu, "herzjesu": herzjesu, "kernels": kernels,
    "selection": selection, "features": features, "middlebury": middlebury, "memory": memory, "speed": speed,
    "inspect": inspecting.inspect, "inspect-large": inspecting.inspect_large,
    "halo": large.halo, "growth": large.growth, "signals": signals, "clone": clone, "peers": compared.peers,
}  # fmt: skip
SLOW = ("new-scenes", "memory", "speed", "inspect-large", "growth", "clone")


def show(name: str, lines: list[tuple[str, str, str, str]]) -> None:
    for what, value, bar, verdict in lines:
        print(f"{name:<10} {what:<34} {value:>20}  {bar:<22} {verdict}".rstrip(), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--slow", action="store_true", help="the slow rows too")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave the results here")
    options = parser.parse_args()
    if unknown := [name for name in options.rows if name not in ROWS]:
        parser.error(f"no row {unknown[0]}; there are {', '.join(ROWS)}")
    chosen = options.rows or [name for name in ROWS if options.slow or name not in SLOW]
    data = os.environ.get("ZLOCUS_TEST_DATA")
    failed = 0
    show("row", [("what", "figure", "bar", "")])
    with tempfile.TemporaryDirectory() as scratch:
        for name in chosen:
            out = (options.keep or Path(scratch)).absolute() / name
            try:
                figures = ROWS[name](Workplace(Path(data) if data else None, out))
            except CannotRun as reason:
                failed += 1
                print(f"{name:<10} cannot be run: {reason}", flush=True)
            except Exception:
                failed += 1
                print(f"{name:<10} fails:\n{traceback.format_exc()}", flush=True)
            else:
                show(name, [figure.cells() for figure in figures])
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
