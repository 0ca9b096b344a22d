"""Row of the acceptance table on a cloud over one of four images: with its mask, and without it.

The cloud is painted over one image of rendered towns, and of copies of the shared realistic scenes. With the mask the
surface is to be as good as that of the three other images; without it the images that agree are to win.
"""

from __future__ import annotations

import shutil
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
import yaml
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning

from marked_cells import marked_errors
from peers.realistic import SHARED, judged_realistic
from rows.realistic import CLASSES
from seeds import fresh_seeds, over_seeds
from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, rendered_images, run
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.statistics import ErrorStatistics
from zlocus.io.cameras.rpc import read_rpc
from zlocus.sensors.rpc import RpcModel
from zlocus.synthetic.painted_clouds import with_clouds

# The cloud is over the first image, which looks most nearly straight down and shows most of the ground.
CLOUDED, CLEAR_VIEWS = "n1", ("f1", "b1", "n2")
CLOUD_SHARE, PIXEL_M, TOWN_CELLS = 0.3, 0.5, 400
# From this share on a pixel shows the cloud more than the ground.
MOSTLY_CLOUD = 0.5
THRESHOLDS_M, OFF_M = (1.0, 0.5), 10.0
# Shares may be lower by so much with the masked image than without it, and of the heights under the cloud so many may
# be wrong without the mask.
MAX_LOSS, MAX_OFF = 0.005, 0.02
# Beside the three clear images, on scenes where some heights are wrong without any cloud.
MAX_MORE_OFF = 0.01


def clouds(workplace: Workplace) -> list[Figure]:
    """Rendered towns by their mean, and the two shared realistic scenes."""
    seeds = fresh_seeds()
    workplace.inputs["seeds"] = seeds
    figures = over_seeds(seeds, lambda seed: _on_town(workplace.out, seed), ("within", "with a height"))
    for number, name in enumerate(SHARED):
        scene = clouded_scene(workplace.scene(name), workplace.out / name, number)
        figures += cloud_figures(f"real-{name[-1]}", scene, is_realistic=True)
    return figures


def _on_town(out: Path, seed: int) -> list[Figure]:
    rendered = out / f"town{seed}"
    if not (rendered / "scene.json").exists():
        command = [sys.executable, "-m", "zlocus.synthetic", "-o", rendered, "--kind", "city", "--size", TOWN_CELLS]
        run([*command, "--views", 1 + len(CLEAR_VIEWS), "--seed", seed])
    return cloud_figures("towns", clouded_scene(rendered, out / f"clouded{seed}", seed), is_realistic=False)


def clouded_scene(scene: Path, folder: Path, seed: int) -> Path:
    """A copy of a rendered scene with a cloud over one image, its mask (mask.tif), and the ground under it (cloud.tif,
    on the grid of the truth). seed : of the cloud."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(scene, folder)
    image = folder / f"img_{CLOUDED}.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(image) as file:
            profile, rpcs = file.profile, file.rpcs
            cloudy = with_clouds(file.read(1), CLOUD_SHARE, PIXEL_M, seed)
        with rasterio.open(image, "w", **profile, rpcs=rpcs) as file:
            file.write(cloudy.numbers, 1)
        mask = {"driver": "GTiff", "count": 1, "dtype": "uint8", "compress": "deflate"}
        with rasterio.open(
            folder / "mask.tif", "w", height=profile["height"], width=profile["width"], **mask
        ) as file:  # fmt: skip
            # Where light of the cloud reaches a pixel at all.
            file.write((cloudy.cover > 0).astype(np.uint8), 1)
    with rasterio.open(folder / "truth_dsm.tif") as file:
        heights, transform, crs = file.read(1).astype(float), file.transform, CRS.from_wkt(file.crs.to_wkt())
        marks = mask | {"height": file.height, "width": file.width, "transform": transform, "crs": file.crs}
    row, col = np.indices(heights.shape) + 0.5
    x, y = transform * (col, row)
    xyz = np.column_stack([x.ravel(), y.ravel(), heights.ravel()])
    with np.errstate(invalid="ignore"):
        at = np.rint(RpcModel(read_rpc(image, None), crs).image_from_ground(xyz))[:, ::-1]
        inside = ((at >= 0) & (at < cloudy.cover.shape)).all(axis=1)
    is_under = np.zeros(len(xyz), np.uint8)
    is_under[inside] = cloudy.cover[tuple(at[inside].astype(int).T)] > MOSTLY_CLOUD
    with rasterio.open(folder / "cloud.tif", "w", **marks) as file:
        file.write(is_under.reshape(heights.shape), 1)
    return folder


def cloud_figures(label: str, scene: Path, is_realistic: bool) -> list[Figure]:
    """Figures of a scene with a cloud. is_realistic : see `shares`."""
    clear = surface(scene, "three", rendered_images(scene, CLEAR_VIEWS))
    masked = surface(scene, "masked", [scene_file(scene, "mask.tif")])
    cloudy = surface(scene, "cloudy", [scene_file(scene, None)])
    of_clear, of_masked = (shares(dsm, scene, is_realistic) for dsm in (clear, masked))
    figures = []
    for what, share in of_masked.items():
        figures.append(Figure(f"{label}, masked, {what}", share, is_detail=True))
        figures.append(
            Figure(
                f"{label}, three clear images less masked, {what}", of_clear[what] - share, at_most=MAX_LOSS,
                fails_when="masked pixels take part, or a mask costs more than its pixels",
            )
        )  # fmt: skip
    off = {name: marked_errors(dsm, scene, "cloud.tif").off_by_more(OFF_M) for name, dsm in
           (("three clear images", clear), ("masked", masked), ("without mask", cloudy))}  # fmt: skip
    wrong = f"under the cloud off by more than {OFF_M:g} m"
    figures += [Figure(f"{label}, {name}, {wrong}", off[name]) for name in ("three clear images", "masked")]
    fails_when = "the image with the cloud wins against images that agree"
    of_cloudy = Figure(f"{label}, without mask, {wrong}", off["without mask"])
    figures.append(of_cloudy if is_realistic else replace(of_cloudy, at_most=MAX_OFF, fails_when=fails_when))
    figures.append(
        Figure(
            f"{label}, without mask, {wrong}, more than with three", off["without mask"] - off["three clear images"],
            at_most=MAX_MORE_OFF, fails_when=fails_when,
        )
    )  # fmt: skip
    return figures


def scene_file(scene: Path, mask: str | None) -> Path:
    """A scene file of all four images. mask : of the one with the cloud, None: without."""
    views: list[dict[str, object]] = [
        {"name": name, "image": f"img_{name}.tif", "camera": {"kind": "rpc"}} for name in (CLOUDED, *CLEAR_VIEWS)
    ]
    if mask is not None:
        views[0]["mask"] = mask
    path = scene / ("cloudy.yaml" if mask is None else "masked.yaml")
    path.write_text(yaml.safe_dump({"schema": 1, "views": views}), encoding="utf-8")
    return path


def surface(scene: Path, name: str, inputs: Sequence[Path]) -> Path:
    """The surface of some images over the area with truth."""
    out = scene / name
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        area = ["--resolution", PIXEL_M, "--crs", truth.crs.to_string(), "--bounds", *truth.bounds]
    run([ZLOCUS, "dsm", *inputs, "-o", out, *area, "--no-report", "--overwrite"], accept=(0, COVERAGE_SHORT))
    return out / "dsm.tif"


def shares(dsm: Path, scene: Path, is_realistic: bool) -> dict[str, float]:
    """Shares within each threshold by class, and with a height, of all cells with truth.

    is_realistic : whether the scene is judged as in the rows of realistic scenes, after the common height of the ground
    was removed: their cameras point elsewhere.
    """
    if is_realistic:
        judged = judged_realistic(scene, dsm)
        within = {f"within 1 m: {name}": judged[name]["within"] for name in CLASSES}
        return within | {"with a height": judged["all"]["completeness"]}
    comparison = Comparison(
        scene / "truth_dsm.tif", scene / "truth_class.tif", threshold_m=THRESHOLDS_M[0],
        more_thresholds_m=THRESHOLDS_M[1:],
    )  # fmt: skip
    found = evaluate(dsm, comparison)
    classes: dict[str, ErrorStatistics] = {"all": found.statistics, **found.class_statistics}
    within = {
        f"within {limit_m:g} m: {name}": statistics.as_dict()["within_m"][f"{limit_m:g}"]
        for name, statistics in classes.items()
        for limit_m in THRESHOLDS_M
        if statistics.n
    }
    return within | {"with a height": found.statistics.completeness}
