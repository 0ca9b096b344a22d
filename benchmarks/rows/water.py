"""Row of the acceptance table on water: levels of rendered lakes, and where water is said to be possible."""

from __future__ import annotations

import json
import sys
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio
import shapely
from pyogrio.raw import write as write_vector
from rasterio.features import shapes
from rasterio.warp import Resampling, reproject

from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, rendered_images, run
from zlocus.products.rasters import WaterKind
from zlocus.synthetic.lakes import LAKES
from zlocus.synthetic.scenes import TROUBLE_SEEDS
from zlocus.synthetic.terrain import WATER

VIEWS = {"two": ("n1", "f1"), "three": ("n1", "f1", "b1")}
# By how much outlines are wider than the lakes, m.
WIDER_M = {"exact": 0.0, "1 m wide": 1.0, "1 m narrow": -1.0}
# A vertical wall at the water hides its level from matched heights.
WALLED = ("lake-quay",)
LEVEL_M = 0.05
# Scenes of ZLOCUS_TEST_DATA, with patterns of their images; those with a truth have lakes, the others no water.
SCENES = {
    "rendered-real-a": "img_*.tif", "rendered-real-b": "img_*.tif", "pleiades_triplet_calanques": "img_*.tif",
    "pleiades_pair_ventoux": "img_*.tif", "worldview3_jax068": "JAX_068_00[1-6]_RGB.tif",
}  # fmt: skip
OPTIONS = ("--no-report", "--products", "none", "--partial", "--overwrite")


class Levelled(NamedTuple):
    """off_m : level less truth, NaN where there is none; range_m : of the heights of its cells; n_wrong : cells inside
    the outline that are not levelled, and levelled cells beyond."""

    off_m: float
    range_m: float
    n_wrong: int


def water(workplace: Workplace) -> list[Figure]:
    """Levels of lakes with different shores, of three towns each, and the cells that are called possible water."""
    lakes = [figure for name in VIEWS for figure in _of_lakes(workplace, name)]
    return [*lakes, *(figure for name, pattern in SCENES.items() for figure in _possible(workplace, name, pattern))]


def _of_lakes(workplace: Workplace, views: str) -> list[Figure]:
    """Figures of all lakes from some views."""
    found: dict[tuple[str, str], list[Levelled]] = {}
    outlines = WIDER_M if views == "three" else {"exact": 0.0}
    for lake, seed in product(LAKES, TROUBLE_SEEDS):
        scene = workplace.out / f"{lake}-{seed}"
        if not scene.is_dir():
            run([sys.executable, "-m", "zlocus.synthetic", "-o", scene, "--trouble", lake, "--seed", seed])
        for outline, wider_m in outlines.items():
            polygons = write_outline(scene, wider_m)
            found.setdefault((lake, outline), []).append(levelled(scene, VIEWS[views], polygons))
        found.setdefault((lake, "possible"), []).append(levelled(scene, VIEWS[views], None))
    natural = [
        one for (lake, outline), ones in found.items() if lake not in WALLED and outline == "exact" for one in ones
    ]
    known = [one for (_, outline), ones in found.items() if outline in outlines for one in ones]
    return [
        Figure(
            f"{views} views, natural shores: level off, root mean square", rms(natural), "m",
            at_most=LEVEL_M if views == "three" else None,
            fails_when="the level is that of banks or of noise" if views == "three" else "",
        ),
        Figure(f"{views} views, natural shores: level off, largest", max(abs(one.off_m) for one in natural), "m"),
        Figure(
            f"{views} views: range of the heights of a lake, largest", max(one.range_m for one in known), "m",
            at_most=0.0, fails_when="a part of a lake has another level",
        ),
        Figure(
            f"{views} views: cells that disobey an outline", float(sum(one.n_wrong for one in known)), at_most=0.0,
            fails_when="cells beside the outline are levelled, or cells inside it are not",
        ),
        *(
            Figure(f"{lake}, {views} views, {outline}: level off, root mean square", rms(ones), "m", is_detail=True)
            for (lake, outline), ones in found.items()
        ),
    ]  # fmt: skip


def rms(levels: list[Levelled]) -> float:
    """Root mean square of the errors of levels; NaN where one has no level."""
    return float(np.sqrt(np.mean([one.off_m**2 for one in levels])))


def write_outline(scene: Path, wider_m: float) -> Path:
    """Write the outline of the lake of a scene as GeoPackage, and return its path."""
    with rasterio.open(scene / "trouble.tif") as file:
        marked = file.read(1)
        ((outline, _),) = shapes(marked, mask=marked > 0, transform=file.transform)
    # Centres of cells would lie on the outline itself, which is made of their corners.
    polygon = shapely.geometry.shape(outline).buffer(wider_m + 0.01)
    path = scene / f"outline{wider_m:+g}.gpkg"
    write_vector(path, shapely.to_wkb(np.array([polygon], object)), [], [], geometry_type="Polygon", crs="EPSG:32632")
    return path


def levelled(scene: Path, views: tuple[str, ...], outline: Path | None) -> Levelled:
    """The lake of a scene as a run levels it. outline : polygon that is given; None: possible water is levelled."""
    out = scene / "surface"
    given = ["--level-water"] if outline is None else ["--water", outline]
    with rasterio.open(scene / "truth_dsm.tif") as file:
        bounds, truth = file.bounds, file.read(1)
    with rasterio.open(scene / "truth_class.tif") as file:
        level = float(np.median(truth[file.read(1) == WATER]))
    grid = ["--resolution", 0.5, "--crs", "EPSG:32632", "--bounds", *bounds]
    run([ZLOCUS, "dsm", *rendered_images(scene, views), "-o", out, *grid, *given, *OPTIONS], accept=(0, COVERAGE_SHORT))
    with rasterio.open(out / "dsm.tif") as file:
        height, transform = file.read(1), file.transform
    with rasterio.open(out / "water.tif") as file:
        is_levelled = np.isin(file.read(1), (WaterKind.LEVELLED, WaterKind.POSSIBLE_LEVELLED))
    if not is_levelled.any():
        return Levelled(float("nan"), float("nan"), 0)
    levels = height[is_levelled]
    n_wrong = 0
    if outline is not None:
        col, row = np.meshgrid(np.arange(height.shape[1]) + 0.5, np.arange(height.shape[0]) + 0.5)
        (polygon,) = shapely.from_wkb(_stored(outline))
        n_wrong = int((is_levelled != shapely.contains_xy(polygon, *(transform * (col, row)))).sum())
    return Levelled(float(np.median(levels)) - level, float(np.ptp(levels)) if outline else 0.0, n_wrong)


def _stored(path: Path) -> np.ndarray:
    """Geometries of a vector file."""
    from pyogrio.raw import read

    return read(path)[2]


def _possible(workplace: Workplace, name: str, pattern: str) -> list[Figure]:
    """Cells that are called possible water in a shared scene, and how many of them are water by its truth."""
    scene, out = workplace.scene(name), workplace.out / name
    run([ZLOCUS, "dsm", *sorted(scene.glob(pattern)), "-o", out, *OPTIONS], accept=(0, COVERAGE_SHORT))
    with rasterio.open(out / "water.tif") as file:
        possible, transform, crs = file.read(1) == WaterKind.POSSIBLE, file.transform, file.crs
    n_areas = json.loads((out / "run.json").read_text())["water"]["possible"]
    truth = scene / "truth_class.tif"
    if not truth.exists():
        return [
            Figure(
                f"{name}, no water: cells called possible water", float(possible.sum()), at_most=0.0,
                fails_when="shadows, roofs or forests are called water",
            )
        ]  # fmt: skip
    with rasterio.open(truth) as file:
        classes = np.zeros(possible.shape, np.uint8)
        reproject(
            file.read(1), classes, src_transform=file.transform, src_crs=file.crs, dst_transform=transform, dst_crs=crs,
            resampling=Resampling.nearest,
        )  # fmt: skip
    is_water = classes == WATER
    right = float((possible & is_water).sum())
    return [
        Figure(f"{name}: areas of possible water", float(n_areas)),
        Figure(
            f"{name}: cells of possible water that are water", right / max(possible.sum(), 1), at_least=0.95,
            fails_when="shadows, roofs or forests are called water",
        ),
        Figure(f"{name}: cells of water that are found", right / is_water.sum()),
    ]  # fmt: skip
