"""Rows of the acceptance table on the method: choice of images, rectified photographs, terrain features."""

from __future__ import annotations

import json
from itertools import product

import terrain_features
from middlebury import CASES, judge
from workplace import ZLOCUS, Figure, Workplace, rendered_images, run
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate


def selection(workplace: Workplace) -> list[Figure]:
    """Eight views of the rendered town, one of another date and one hazy: the chosen ones against all of them."""
    scene = workplace.scene("rendered-city")
    all_images = sorted(scene.glob("img_*.tif"))
    figures, shares, cpu = [], {}, {}
    for name, images, views in (
        ("all", all_images, "all"),
        ("good", rendered_images(scene), "auto"),
        ("auto", all_images, "auto"),
    ):
        out = workplace.out / name
        run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--views", views, "--overwrite"])
        found, record = workplace.judge(out / "dsm.tif", scene), json.loads((out / "run.json").read_text())
        shares[name] = {surface: found[surface]["within"] for surface in ("all", "building")}
        cpu[name] = sum(stage["cpu_s"] for stage in record["stages"])
    for surface in ("all", "building"):
        gain, loss = (shares["auto"][surface] - shares[other][surface] for other in ("all", "good"))
        figures.append(Figure(f"{surface}: over all images", gain, at_least=0.005))
        figures.append(Figure(f"{surface}: over the six good ones", loss, at_least=-0.005))
    counted = record["evaluations"]
    figures.append(Figure("evaluations saved", 1 - counted["done"] / counted["all_images"], at_least=0.4))
    figures.append(Figure("CPU over that of all images", cpu["auto"] / cpu["all"], at_most=1))
    return [*figures, no_worse(workplace, "hills"), no_worse(workplace, "calanques")]


def no_worse(workplace: Workplace, name: str) -> Figure:
    """NMAD with the chosen images over NMAD with all images."""
    nmad = {}
    for views in ("all", "auto"):
        out = workplace.out / f"{name}-{views}"
        if name == "hills":
            scene = workplace.scene("rendered-hills-biased")
            images = sorted(scene.glob("img_*.tif"))
            run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--views", views, "--overwrite"])
            nmad[views] = workplace.judge(out / "dsm.tif", scene, "--align")["ground"]["nmad"]
        else:
            scene = workplace.scene("pleiades_triplet_calanques")
            reference = scene / "reference" / "s2p_dsm_0.5m_utm31n.tif"
            images = sorted(scene.glob("img_0*.tif"))
            run([ZLOCUS, "dsm", *images, "-o", out, "--like", reference, "--views", views, "--overwrite"])
            nmad[views] = evaluate(out / "dsm.tif", Comparison(reference, align=True)).statistics.nmad
    return Figure(f"{name}: NMAD over that of all images", nmad["auto"] / nmad["all"], at_most=1.02)


def middlebury(workplace: Workplace) -> list[Figure]:
    """Rectified photographs matched by `zlocus cloud`, and by OpenCV's StereoSGBM in its slowest mode."""
    scenes = workplace.scene("middlebury_multiview")
    found = {name: judge(scenes, name, workplace.out / name.replace(", ", "-").replace(" ", "-")) for name in CASES}
    share = {name: case.zlocus for name, case in found.items()}
    bars = {"cones, 2 views": 4.0, "teddy, 2 views": 7.0}
    figures = [Figure(f"{name}: bad > 1 px", value, "%", at_most=bars.get(name)) for name, value in share.items()]
    figures += [Figure(f"{name}: over OpenCV's", share[name] / found[name].opencv, at_most=1) for name in bars]
    for more, fewer in (("cones, 3 views", "cones, 2 views"), ("tsukuba, 5 views", "tsukuba, 2 views")):
        figures.append(Figure(f"{more} over {fewer}", share[more] / share[fewer], at_most=1))
    return figures


def features(workplace: Workplace) -> list[Figure]:
    """Three rendered terrain features: gain of the semi-global constraint and of the resolution levels."""
    workplace.out.mkdir(parents=True, exist_ok=True)
    lines = []
    for name in terrain_features.FEATURES:
        crop = terrain_features.rendered(name, terrain_features.VIEWS, workplace.out)
        found = {
            (method, levels): terrain_features.run(crop, method, levels, workplace.out)[0]
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
