"""Rows of the acceptance table on satellite images with RPC."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import rasterio
from pyproj import CRS, Transformer

from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, run
from zlocus.core.scene import Scene
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.io.scene_file import open_scene

PIXEL_LOCKING = "heights gather near whole steps, as with a parabola through aggregated costs"


def calanques(workplace: Workplace) -> list[Figure]:
    """The Pleiades triplet, against the surface of another program."""
    scene = workplace.scene("pleiades_triplet_calanques")
    reference = scene / "reference" / "s2p_dsm_0.5m_utm31n.tif"
    images = sorted(scene.glob("img_0*.tif"))
    for _ in ("compile the kernels", "measure"):
        used = run([ZLOCUS, "dsm", *images, "-o", workplace.out, "--like", reference, "--workers", 1, "--overwrite"])
    dsm = workplace.out / "dsm.tif"
    plain = evaluate(dsm, Comparison(reference, margin_m=0))
    aligned = evaluate(dsm, Comparison(reference, align=True))
    unshifted = aligned.unshifted_statistics
    return [
        Figure("NMAD", unshifted.nmad, "m"),
        Figure(
            "aligned, NMAD", aligned.statistics.nmad, "m", at_most=0.55,
            fails_when="heights on steep rock are noisy, or the images are tied wrongly",
        ),
        Figure("within 1 m", unshifted.within),
        Figure("aligned, within 1 m", aligned.statistics.within),
        Figure(
            "reference's cells filled", plain.statistics.completeness, at_least=0.99,
            fails_when="cells are left empty, or images are excluded",
        ),
        Figure("median offset, as it is", plain.statistics.median, "m"),
        Figure("shift east", aligned.shift.east_m, "m"),
        Figure("shift north", aligned.shift.north_m, "m"),
        Figure(
            "CPU, kernels cached", used.cpu_s, "s", at_most=8, fails_when="a kernel becomes slower, or is compiled anew"
        ),
        *staircase(workplace.out),
    ]  # fmt: skip


def staircase(out: Path) -> list[Figure]:
    """Share of the heights in the emptiest and the fullest tenth of a height step, over the mean of the tenths.

    Heights that gather near whole steps (pixel locking) show as a staircase in the surface.
    """
    heights = json.loads((out / "run.json").read_text())["heights"]
    with rasterio.open(out / "dsm.tif") as file:
        heights_m = file.read(1).astype(float)
    steps = (heights_m[np.isfinite(heights_m)] - heights["searched_m"][0]) / heights["step_m"]
    share = np.bincount((10 * (steps % 1)).astype(int).clip(0, 9), minlength=10) / len(steps) * 10
    return [
        Figure("least of the tenths of a step", share.min(), at_least=0.8, fails_when=PIXEL_LOCKING),
        Figure("most of the tenths of a step", share.max(), at_most=1.2, fails_when=PIXEL_LOCKING),
    ]


def ventoux(workplace: Workplace) -> list[Figure]:
    """The Pleiades pair, with little overlap and a large pointing error; its height range comes from tie points."""
    scene = workplace.scene("pleiades_pair_ventoux")
    images = sorted(scene.glob("img_0*.tif"))
    run([ZLOCUS, "dsm", *images, "-o", workplace.out, "--overwrite"], accept=(0, COVERAGE_SHORT))
    opened = open_scene(images)
    srtm = read_heights(scene / "reference" / "srtm3_v2_egm96_heights.tif")
    geoid = read_heights(scene / "reference" / "geoid_egm96_15min.tif")
    xyz = ground_seen_by_all(opened, srtm, geoid)
    dsm = read_heights(workplace.out / "dsm.tif")
    to_grid = Transformer.from_crs(opened.crs, CRS.from_user_input(dsm.crs), always_xy=True)
    z = dsm.nearest(np.column_stack(to_grid.transform(xyz[:, 0], xyz[:, 1])))
    difference = z[np.isfinite(z)] - xyz[np.isfinite(z), 2]
    median = float(np.median(difference))
    return [
        Figure(
            "ground seen by both, filled", float(np.isfinite(z).mean()), at_least=0.6,
            fails_when="the search range from the ties leaves ground out, or cells stay empty",
        ),
        Figure(
            "absolute median difference to SRTM", abs(float(np.nanmedian(z - xyz[:, 2]))), "m", at_most=10,
            fails_when="the pointing error of the pair is corrected along the heights",
        ),
        # A horizontal shift cannot be found on cells of 90 m, so aligned means without the median difference.
        Figure("RMSE to SRTM", rms(difference), "m"),
        Figure("aligned in height, RMSE to SRTM", rms(difference - median), "m"),
        *staircase(workplace.out),
    ]  # fmt: skip


def rms(values: np.ndarray) -> float:
    """Root mean square of values (n,)."""
    return float(np.sqrt(np.mean(values**2)))


def ground_seen_by_all(scene: Scene, srtm: HeightRaster, geoid: HeightRaster) -> np.ndarray:
    """Ground points (n, 3), one metre apart on a coarse terrain model, that lie inside all images."""
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


def datum(workplace: Workplace) -> list[Figure]:
    """Surfaces above a geoid, against ellipsoidal surfaces less the undulation, which other code interpolates here."""
    figures = []
    for name in ("pleiades_triplet_calanques", "pleiades_pair_ventoux"):
        scene = workplace.scene(name)
        geoid = scene / "reference" / "geoid_egm96_15min.tif"
        surfaces = []
        for vertical in ("ellipsoid", geoid):
            out = workplace.out / f"{name}-{len(surfaces)}"
            images = sorted(scene.glob("img_0*.tif"))
            run([ZLOCUS, "dsm", *images, "-o", out, "--vertical", vertical, "--overwrite"], accept=(0, COVERAGE_SHORT))
            surfaces.append(read_heights(out / "dsm.tif"))
        plain, above = surfaces
        row, col = np.nonzero(np.isfinite(plain.z) | np.isfinite(above.z))
        xy = np.column_stack(plain.transform * (col + 0.5, row + 0.5))
        to_degrees = Transformer.from_crs(CRS.from_user_input(plain.crs), "EPSG:4326", always_xy=True)
        expected = plain.z[row, col] - read_heights(geoid).bilinear(np.column_stack(to_degrees.transform(*xy.T)))
        # A cell with a height in only one of the two surfaces makes the maximum NaN, which passes no bar.
        worst = float(np.abs(above.z[row, col] - expected).max())
        figures.append(
            Figure(
                f"{name.split('_')[-1]}, worst difference", worst, "m", at_most=0.01,
                fails_when="the undulation is added with the wrong sign, at the wrong place, or to some cells only",
            )
        )  # fmt: skip
    return figures
