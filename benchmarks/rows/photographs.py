"""Rows of the acceptance table on aerial images, drone images and photographs of a facade."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import rasterio

from reprojection import Surface, reprojected
from rows.resources import of_all_processes
from strecha import write_strecha_scene
from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, run
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.io.scene_file import open_scene, write_scene_file

# Standard deviation of heights that a user of oblique drone images may ask for (option checks.max_sigma_m).
PRECISE_M = 1.0
# Directions in the axes of the cameras of the facade: out of the wall, and up along it.
FACADE_UP, FACADE_NORTH = (-0.733, 0.68, 0.0), (0.0, 0.0, -1.0)
# All heights of the facade are moved by this much, to see how far the correlations fall.
MOVED_M = 0.05
# Search of the common shift of a surface: how far, and the step at which it ends.
SEARCHED_M, FINEST_STEP_M = 4.0, 0.02


def import_dmc(workplace: Workplace, out: Path) -> Path:
    """Import the images of the mapping camera into a folder; the scene file."""
    scene = workplace.scene("aerial_ngi_dmc")
    out.mkdir(parents=True, exist_ok=True)
    (camera := out / "camera.yaml").write_text(f"focal: {120 / 0.144}\n")
    crs = "+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    run([ZLOCUS, "import", "eo", scene, "--crs", crs, "--camera", camera, "-o", out / "scene.yaml", "--overwrite"])
    return out / "scene.yaml"


def import_tuniu(workplace: Workplace, out: Path) -> Path:
    """Import the images of the drone into a folder; the scene file."""
    scene = workplace.scene("drone_tuniu_oblique")
    out.mkdir(parents=True, exist_ok=True)
    (bundle,) = json.loads((scene / "opensfm_reconstruction.json").read_text())[0]["cameras"].values()
    side, lens = bundle["width"], {name: bundle[name] for name in ("k1", "k2", "k3", "p1", "p2")}
    point = [(bundle[f"c_{axis}"] * side + (bundle[size] - 1) / 2) for axis, size in (("x", "width"), ("y", "height"))]
    (camera := out / "camera.yaml").write_text(
        json.dumps(
            {"focal": bundle["focal_x"] * side, "principal_point": point, "distortion": {"kind": "brown", **lens}}
        )
    )
    table = ["--crs", "EPSG:32651", "--earth", "flat", "--camera", camera]
    run([ZLOCUS, "import", "eo", scene, *table, "-o", out / "scene.yaml", "--overwrite"])
    return out / "scene.yaml"


def dmc(workplace: Workplace) -> list[Figure]:
    """Four images of a mapping camera in two strips, with their exterior orientation and without a height range."""
    scene = workplace.scene("aerial_ngi_dmc")
    import_dmc(workplace, workplace.out)
    run([ZLOCUS, "dsm", workplace.out / "scene.yaml", "-o", workplace.out / "dsm"], accept=(0, COVERAGE_SHORT))
    # The reference is a terrain model of 24 m cells; a difference of more than 50 m is a false height, not its error.
    error, _ = errors_at(
        workplace.out, ground_where_two_see(workplace.out, scene / "reference" / "dem_24m_egm2008.tif")
    )
    return [
        *two_view_figures(error, Bars(min_filled=0.9, max_nmad_m=2.5, max_median_m=6.0)),
        *aligned_in_height(error),
        Figure(
            "heights > 50 m off", float((np.abs(error[np.isfinite(error)]) > 50.0).mean()), at_most=0.01,
            fails_when="a false surface grows in a shadow or beside the overlap of the images",
        ),
    ]  # fmt: skip


def tuniu(workplace: Workplace) -> list[Figure]:
    """Four oblique images of a drone, in four directions, without a height range."""
    scene = workplace.scene("drone_tuniu_oblique")
    import_tuniu(workplace, workplace.out)
    run([ZLOCUS, "dsm", workplace.out / "scene.yaml", "-o", workplace.out / "dsm"], accept=(0, COVERAGE_SHORT))
    ground = ground_where_two_see(workplace.out, scene / "reference" / "odm_dsm_0.8m.tif")
    error, sigma = errors_at(workplace.out, ground)
    precise = np.where(sigma <= PRECISE_M, error, np.nan)
    left_out = json.loads((workplace.out / "dsm" / "run.json").read_text())["left_out_cells"]
    return [
        *two_view_figures(error, Bars(min_filled=0.9, max_nmad_m=0.5)),
        *two_view_figures(precise, Bars(min_filled=0.6, max_nmad_m=0.5), which=f", sigma <= {PRECISE_M:g} m"),
        *aligned_in_height(error)[:1],
        *aligned_figures(read_heights(workplace.out / "dsm" / "dsm.tif"), ground),
        Figure("cells an image was left out of", float(left_out)),
    ]


def ground_where_two_see(folder: Path, reference: Path) -> np.ndarray:
    """Centres and heights (n, 3) m of those cells of a reference that lie inside at least two images of a scene."""
    with rasterio.open(reference) as source:
        z, transform = source.read(1, masked=True).astype(float).filled(np.nan), source.transform
    col, row = np.meshgrid(np.arange(z.shape[1]) + 0.5, np.arange(z.shape[0]) + 0.5)
    x, y = transform * (col, row)
    xyz = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    return xyz[n_images_around(folder, xyz) >= 2]


def n_images_around(folder: Path, xyz: np.ndarray) -> np.ndarray:
    """Number of images of a scene inside which ground points (n, 3) m lie, (n,); occluded ones are counted too."""
    n_images = np.zeros(len(xyz), int)
    for view in open_scene([folder / "scene.yaml"]).views:
        xy = view.sensor.image_from_ground(xyz)
        n_images += ((xy >= 0) & (xy <= np.array(view.image.shape[::-1]) - 1)).all(axis=1)
    return n_images


def errors_at(folder: Path, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height differences to ground points (n, 3) m, and the standard deviations of `sigma.tif`; (n,) m each.

    Both are NaN where the surface has no height.
    """
    dsm, sigma = (read_heights(folder / "dsm" / f"{name}.tif") for name in ("dsm", "sigma"))
    return np.asarray(dsm.nearest(xyz[:, :2]) - xyz[:, 2]), np.asarray(sigma.nearest(xyz[:, :2]))


@dataclass(frozen=True)
class Bars:
    """Bars of a surface against a reference: least share filled, largest NMAD and absolute median difference, m."""

    min_filled: float
    max_nmad_m: float
    max_median_m: float | None = None


def two_view_figures(error: np.ndarray, bars: Bars, which: str = "") -> list[Figure]:
    """Completeness, median and NMAD of height differences of the surface as it is.

    error : (n,) m, of ground that two images see, NaN without a height; which : end of the labels.
    """
    finite = error[np.isfinite(error)]
    median = float(np.median(finite))
    return [
        Figure(
            f"ground seen by two, filled{which}", float(np.isfinite(error).mean()), at_least=bars.min_filled,
            fails_when="cells are left empty, or standard deviations are too large",
        ),
        Figure(
            f"absolute median difference{which}", abs(median), "m", at_most=bars.max_median_m,
            fails_when="positions or angles of the cameras are read wrongly",
        ),
        Figure(
            f"NMAD{which}", float(1.4826 * np.median(np.abs(finite - median))), "m", at_most=bars.max_nmad_m,
            fails_when="cameras stay turned against each other, or many heights are false",
        ),
    ]  # fmt: skip


def aligned_in_height(error: np.ndarray) -> list[Figure]:
    """Root mean square difference as it is and without the median, where cells are too large for a horizontal shift.

    error : (n,) m, NaN without a height.
    """
    finite = error[np.isfinite(error)]
    as_it_is, aligned = (float(np.sqrt(np.mean((finite - up) ** 2))) for up in (0.0, np.median(finite)))
    return [Figure("RMS difference", as_it_is, "m"), Figure("aligned in height, RMS difference", aligned, "m")]


def aligned_figures(dsm: HeightRaster, xyz: np.ndarray) -> list[Figure]:
    """NMAD and RMS of the differences after the horizontal and vertical shift with the least spread was removed.

    xyz : (n, 3) m, ground of the reference. The search is that of the shared judge: every metre within 4 m, then half
    of the step until it is below 0.02 m.
    """

    def errors(shift: tuple[float, float]) -> np.ndarray:
        found = np.asarray(dsm.nearest(xyz[:, :2] + shift)) - xyz[:, 2]
        found = found[np.isfinite(found)]
        return found - np.median(found)

    def spread(shift: tuple[float, float]) -> float:
        return float(np.median(np.abs(errors(shift))))

    metres = np.arange(-SEARCHED_M, SEARCHED_M + 0.5)
    best, step = min(product(metres, metres), key=spread), 0.5
    while step > FINEST_STEP_M:
        around = [(best[0] + east * step, best[1] + north * step) for east, north in product((-1, 0, 1), repeat=2)]
        better = min(around, key=spread)
        step, best = (step / 2, best) if better == best else (step, better)
    return [
        Figure("aligned, NMAD", 1.4826 * spread(best), "m"),
        Figure("aligned, RMS difference", float(np.sqrt(np.mean(errors(best) ** 2))), "m"),
        Figure("shift removed, horizontally", float(np.hypot(*best)), "m"),
    ]


def herzjesu(workplace: Workplace) -> list[Figure]:
    """Eight photographs of a facade: heights from every second one, checked by correlation in the others."""
    scene = workplace.scene("herzjesu_p8")
    workplace.out.mkdir(parents=True, exist_ok=True)
    written = write_strecha_scene(scene, workplace.out / "scene.yaml", FACADE_UP, FACADE_NORTH)
    write_scene_file(workplace.out / "half.yaml", written.model_copy(update={"views": written.views[::2]}))
    run(
        [ZLOCUS, "dsm", workplace.out / "half.yaml", "-o", workplace.out / "dsm", "--overwrite"],
        accept=(0, COVERAGE_SHORT),
    )
    record = json.loads((workplace.out / "dsm" / "run.json").read_text())
    views, surface = open_scene([workplace.out / "scene.yaml"]).views, Surface.read(workplace.out / "dsm" / "dsm.tif")
    found = reprojected(surface, views[::2], views[1::2])
    together = np.concatenate([one.ncc for one in found.values()])
    figures = [
        Figure(
            "left-out images, median NCC", float(np.median(together)), at_least=0.7,
            fails_when="heights are off by more than some centimetres, or lens and attitude are read wrongly",
        )
    ]  # fmt: skip
    for name, one in found.items():
        figures.append(Figure(f"image {name}, median NCC", one.median))
        for what in ("hidden", "outside", "untextured", "at_rim"):
            share = getattr(one, what) / one.with_height
            figures.append(Figure(f"image {name}, {what.replace('_', ' ')}", share, is_detail=True))
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
