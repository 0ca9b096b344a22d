"""Rows on real images without truth: surfaces of independent images, and images that were left out of the matching.

The bars are what the matcher reached when the rows were made, with a margin: a change of a default must not be worse.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio

from independent_surfaces import Comparison, Disagreement, compare_surfaces
from reprojection import DISPLACED_PX, LIKE, Reprojection, Surface, reprojections
from rows.photographs import FACADE_NORTH, FACADE_UP, import_dmc, import_tuniu
from strecha import write_strecha_scene
from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, run
from zlocus.core.scene import View
from zlocus.io.scene_file import open_scene, read_scene_file, write_scene_file

# The facade is matched in images reduced by this factor: in full images one surface takes half an hour of two cores.
FACADE_FACTOR = 4
# A false height of the facade, whose reduced pixels are 2 cm: six pixels, as 3 m are in satellite images of 0.5 m.
FACADE_FALSE_M = 0.12
FALSE_M = 3.0
# Cameras were corrected once for all images, so that the image that is left out stays registered.
NO_CORRECTION = "orientation:\n  model: none\n"
# Pairs of neighbours across the two strips; together they show the ground that all four images have in common.
DMC_PAIRS = (("05_0182", "06_0253"), ("05_0184", "06_0251"))

WRONG_HEIGHTS = "wrong heights: the matched texture lies elsewhere in the image that was left out"
UNTEXTURED = "the surface has gaps, or occludes too much: fewer windows can be judged"
TWO_SURFACES = "either surface has false heights, or their standard deviations are too small"


@dataclass(frozen=True)
class Bars:
    """Bars of one image that was left out.

    ncc : least median correlation; displaced : largest share of displaced windows; judged : least share of the cells
    with a height whose window can be judged.
    """

    ncc: float
    displaced: float
    judged: float


# Two of the eight images of the facade are left out in turn. All eight would take four times as long.
FACADE_LEFT_OUT = {"0003": Bars(0.96, 0.07, 0.54), "0005": Bars(0.97, 0.05, 0.7)}


def pairs_of_triplet(workplace: Workplace) -> list[Figure]:
    """The surfaces of the three pairs of the Pleiades triplet against each other.

    Two pairs have an image in common, so their errors are not fully independent.
    """
    scene = workplace.scene("pleiades_triplet_calanques")
    reference = scene / "reference" / "s2p_dsm_0.5m_utm31n.tif"
    for pair in ("12", "13", "23"):
        images = [scene / f"img_0{number}.tif" for number in pair]
        make_surface(images, workplace.out / pair, "--like", reference)
    bars = {("12", "13"): 0.001, ("12", "23"): 0.0015, ("13", "23"): 0.0015}
    figures = []
    for (one, other), bar in bars.items():
        found = compare_surfaces(workplace.out / one, workplace.out / other)
        figures += disagreement_figures(f"{one} and {other}", found, FALSE_M, bar)
    return figures


def independent_surfaces(workplace: Workplace) -> list[Figure]:
    """Surfaces of two sets of images without a common image: WorldView-3, DMC and the facade of Herz-Jesu.

    Of the four images of tuniu no two disjoint pairs show a common piece of ground (0018 and 0140 share none), and the
    triplet has only three images.
    """
    figures = []
    for name, folders, false_m, most_false, least_shared in (
        ("JAX_068", surfaces_of_halves(workplace), FALSE_M, 0.025, 0.95),
        ("DMC", surfaces_across_strips(workplace), FALSE_M, 0.035, 0.15),
        ("Herz-Jesu", surfaces_of_facade(workplace), FACADE_FALSE_M, 0.1, 0.75),
    ):
        found = compare_surfaces(*folders, false_m, (false_m / 3, false_m))
        figures += disagreement_figures(name, found, false_m, most_false, least_shared)
    return figures


def left_out_views(workplace: Workplace) -> list[Figure]:
    """Surfaces judged by an image that was left out: the triplet, DMC, tuniu and the facade of Herz-Jesu.

    The cameras of all images are corrected once, from tie points and without any surface.
    """
    triplet = sorted(workplace.scene("pleiades_triplet_calanques").glob("img_0*.tif"))
    figures = []
    oriented = orient(triplet, workplace.out / "triplet")
    for name in ("img_01", "img_02", "img_03"):
        figures += left_out_figures(f"triplet {name[-1]}", oriented, name, Bars(0.95, 0.01, 0.9))
    for scene, imported, name, bars in (
        ("DMC", import_dmc, "3324c_2015_1004_05_0184_RGB", Bars(0.82, 0.02, 0.19)),
        ("tuniu", import_tuniu, "100_0005_0136", Bars(0.84, 0.085, 0.11)),
    ):
        oriented = orient([imported(workplace, workplace.out / scene)], workplace.out / scene / "oriented")
        figures += left_out_figures(scene, oriented, name, bars)
    facade = reduced_facade(workplace)
    for name, bars in FACADE_LEFT_OUT.items():
        figures += left_out_figures(f"Herz-Jesu {name}", facade, name, bars)
    return figures


def make_surface(inputs: Sequence[Path], out: Path, *options: object) -> None:
    """Match images with the default options and without a report, into a folder."""
    plain = ["--products", "none", "--no-report", "--overwrite"]
    run([ZLOCUS, "dsm", *inputs, "-o", out, *plain, *options], accept=(0, COVERAGE_SHORT))


def orient(inputs: Sequence[Path], out: Path) -> Path:
    """Correct the cameras of all images by their tie points; the scene file with the corrected cameras."""
    run([ZLOCUS, "orient", *inputs, "-o", out, "--overwrite"])
    return out / "scene.yaml"


def without(scene: Path, names: Iterable[str], out: Path) -> Path:
    """Write a scene file beside another one, without the views of these names."""
    left, names = read_scene_file(scene), set(names)
    kept = tuple(view for view in left.views if view.name not in names)
    write_scene_file(out, left.model_copy(update={"views": kept}))
    return out


def reduced_facade(workplace: Workplace) -> Path:
    """Scene file of the facade with images reduced by `FACADE_FACTOR`: means of square groups of pixels."""
    scene, out = workplace.scene("herzjesu_p8"), workplace.out / "facade"
    (cameras := out / "cameras").mkdir(parents=True, exist_ok=True)
    (images := out / "images").mkdir(exist_ok=True)
    for camera in sorted((scene / "gt_dense_cameras").glob("*.camera")):
        name = camera.name.removesuffix(".jpg.camera")
        pixels = cv2.imread(str(scene / "images" / f"{name}.jpg"))
        size = [side // FACADE_FACTOR for side in pixels.shape[1::-1]]
        cv2.imwrite(str(images / f"{name}.tif"), cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
        lines = [line.split() for line in camera.read_text().splitlines() if line.split()]
        for line in lines[:2]:
            line[:] = [str(float(number) / FACADE_FACTOR) for number in line]
            # (0, 0) is the centre of the first pixel, before and after.
            line[2] = str(float(line[2]) + 0.5 / FACADE_FACTOR - 0.5)
        lines[8] = [str(side) for side in size]
        (cameras / f"{name}.tif.camera").write_text("\n".join(map(" ".join, lines)) + "\n")
    write_strecha_scene(out, out / "scene.yaml", FACADE_UP, FACADE_NORTH)
    return out / "scene.yaml"


def surfaces_of_halves(workplace: Workplace) -> list[Path]:
    """Folders of two surfaces of JAX_068: from every second image in the order of their dates, and from the others."""
    scene = workplace.scene("worldview3_jax068")
    with (scene / "dates.csv").open() as file:
        lines = list(csv.reader(file))
    dates = {row[0]: row[1] for row in lines[1:]}
    images = sorted(scene.glob("JAX_068_*_RGB.tif"), key=lambda path: (dates[path.name], path.name))
    reference = scene / "reference" / "lidar_dsm_half_utm17n.tif"
    folders = [workplace.out / f"jax-{half}" for half in (0, 1)]
    for half, folder in enumerate(folders):
        make_surface(images[half::2], folder, "--like", reference)
    return folders


def surfaces_across_strips(workplace: Workplace) -> list[Path]:
    """Folders of two surfaces of the DMC scene, each from one image of each strip."""
    scene = import_dmc(workplace, workplace.out / "dmc")
    names = [view.name for view in read_scene_file(scene).views]
    folders = [workplace.out / f"dmc-{half}" for half in (0, 1)]
    for half, folder in enumerate(folders):
        others = [name for name in names if any(part in name for part in DMC_PAIRS[1 - half])]
        like = ("--like", folders[0] / "dsm.tif") if half else ()
        make_surface([without(scene, others, scene.with_name(f"half-{half}.yaml"))], folder, *like)
    return folders


def surfaces_of_facade(workplace: Workplace) -> list[Path]:
    """Folders of two surfaces of the facade: from the images of even numbers, and from those of odd numbers."""
    scene = reduced_facade(workplace)
    names = [view.name for view in read_scene_file(scene).views]
    folders = [workplace.out / f"facade-{half}" for half in (0, 1)]
    for half, folder in enumerate(folders):
        grid = same_grid(folders[0]) if half else ()
        make_surface([without(scene, names[1 - half :: 2], scene.with_name(f"half-{half}.yaml"))], folder, *grid)
    return folders


def same_grid(folder: Path) -> list[object]:
    """Options for the grid of another surface. `--like` refuses grids in local frames, which have no place on Earth."""
    with rasterio.open(folder / "dsm.tif") as file:
        return ["--bounds", *file.bounds, "--resolution", file.res[0]]


def disagreement_figures(
    label: str, found: Comparison, false_m: float, most_false: float, least_shared: float | None = None
) -> list[Figure]:
    """Figures of two surfaces, as they are and aligned.

    most_false : bar of the aligned share of false cells; least_shared : bar of the share of cells that have a height in
    both surfaces, of those that have one in either.
    """

    def figures(which: str, one: Disagreement, bar: float | None) -> list[Figure]:
        name = f"{label}{which}"
        return [
            Figure(f"{name}, median difference", one.median_m, "m", is_detail=True),
            Figure(f"{name}, NMAD", one.nmad_m, "m"),
            *(Figure(f"{name}, > {limit:g} m", share) for limit, share in one.beyond.items()),
            Figure(
                f"{name}, > 3 sigma and > {false_m:g} m", one.false, at_most=bar,
                fails_when="" if bar is None else TWO_SURFACES,
            ),
        ]  # fmt: skip

    moved = zip(("east", "north", "up"), (found.east_m, found.north_m, found.up_m), strict=True)
    return [
        Figure(f"{label}, cells in both", found.absolute.n / 1e6, "million", is_detail=True),
        Figure(
            f"{label}, cells in both, of those in either",
            found.absolute.in_both,
            at_least=least_shared,
            fails_when="" if least_shared is None else "one of the surfaces has gaps where the other has heights",
        ),
        *figures("", found.absolute, None),
        *(Figure(f"{label}, shift {axis}", shift_m, "m", is_detail=True) for axis, shift_m in moved),
        *figures(", aligned", found.aligned, most_false),
        Figure(f"{label}, without a sigma", found.absolute.without_sigma, is_detail=True),
    ]


def left_out_figures(label: str, scene: Path, name: str, bars: Bars) -> list[Figure]:
    """Match the views of a scene except one, and judge the surface by that one."""
    folder = scene.parent / f"without-{name}"
    (config := scene.with_name("no_correction.yaml")).write_text(NO_CORRECTION)
    rest = without(scene, [name], scene.with_name(f"without-{name}.yaml"))
    make_surface([rest], folder, "--config", config)
    views, surface = open_scene([scene]).views, Surface.read(folder / "dsm.tif")
    found = judged(surface, views, name)
    # Heights raised by two px of displacement, so that every window is displaced, and by one cell.
    per_px_m = found.metres_per_pixel
    shifted = judged(surface.moved(2 * DISPLACED_PX * per_px_m), views, name)
    raised = judged(surface.moved(surface.cell_m), views, name, search=False)
    coverage = json.loads((folder / "run.json").read_text())["coverage"]
    return [
        *judged_figures(label, found, bars),
        Figure(f"{label}, height of 1 px of displacement", per_px_m, "m"),
        Figure(f"{label}, heights moved by 2 px: displaced", share(shifted.displaced, shifted.judged), at_least=0.7,
               fails_when="the search of displacements does not see planted wrong heights"),
        Figure(f"{label}, heights raised by a cell: fall of the median NCC", found.median - raised.median,
               at_least=0.0, fails_when="lower heights than those found fit the image better"),
        Figure(f"{label}, seen by two, filled", coverage, is_detail=True),
    ]  # fmt: skip


def judged(surface: Surface, views: Sequence[View], name: str, search: bool = True) -> Reprojection:
    """Comparison of a surface with the view of this name; the other views give the texture."""
    matched = [view for view in views if view.name != name]
    ((_, found),) = reprojections(surface, matched, [view for view in views if view.name == name], search)
    return found


def judged_figures(label: str, found: Reprojection, bars: Bars) -> list[Figure]:
    """Figures of one comparison. Shares of windows are of the judged ones; shares of cells of those with a height."""
    error = found.error_m[found.judged & np.isfinite(found.error_m)]
    shift = found.shift_px[found.judged & np.isfinite(found.shift_px)]
    with_height, n_judged = found.with_height, int(found.judged.sum())
    return [
        Figure(f"{label}, median NCC", float(np.median(found.ncc[found.judged])), at_least=bars.ncc,
               fails_when=WRONG_HEIGHTS),
        Figure(f"{label}, NCC < {LIKE:g}", share(found.unlike, found.judged)),
        Figure(f"{label}, displaced > {DISPLACED_PX:g} px", share(found.displaced, found.judged),
               at_most=bars.displaced, fails_when=WRONG_HEIGHTS),
        Figure(f"{label}, found nowhere within 3 px", share(found.lost, found.judged)),
        Figure(f"{label}, median |displacement|", float(np.median(np.abs(shift))), "px"),
        Figure(f"{label}, median error of height", float(np.median(error)), "m", is_detail=True),
        Figure(f"{label}, median |error of height|", float(np.median(np.abs(error))), "m"),
        Figure(f"{label}, judged", n_judged / with_height, at_least=bars.judged, fails_when=UNTEXTURED),
        Figure(f"{label}, plain: cannot be judged", int(found.plain.sum()) / with_height),
        *(
            Figure(f"{label}, {what.replace('_', ' ')}", getattr(found, what) / with_height, is_detail=True)
            for what in ("hidden", "outside", "untextured", "at_rim")
        ),
    ]  # fmt: skip


def share(part: np.ndarray, whole: np.ndarray) -> float:
    """Share of the windows of `whole` (n,) that are in `part` (n,)."""
    return float((part & whole).sum() / max(int(whole.sum()), 1))
