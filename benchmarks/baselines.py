"""Accuracy of two simple methods on a rendered scene, which tells how hard the scene is, independently of zlocus.

    python benchmarks/baselines.py FOLDER ... [--keep OUT] [--only mvll|opencv]

Each FOLDER holds a rendered scene. `mvll` is plain vertical line locus matching: independent cells, six views. `opencv`
is StereoSGBM with eight paths on two views resampled onto a plane at a constant height. Both get the same pointing
corrections, and the area with truth. The shared judge of `ZLOCUS_TEST_DATA` gives the shares within 1 m, or `zlocus
evaluate` where that judge is not at hand.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio

import judging
from judging import rendered_scene
from rectifying import (
    STEP_M,
    Rectified,
    disparity_range,
    gridded,
    ground_points,
    on_plane,
    parallax,
    rectified,
    write_surface,
)
from workplace import ended
from zlocus.core.scene import View
from zlocus.io.scene_file import open_scene

VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")
PAIR = ("n1", "f1")
RANGE_MARGIN_M = 3.0
BLOCK = 3
GREY_PERCENT = (0.2, 99.8)
SURFACES = ("all", "ground", "building", "tree")
METHODS = ("mvll", "opencv")


@dataclass(frozen=True)
class RenderedFolder:
    """A rendered scene on disk. low, high : lowest and highest true height, m; bounds : west, south, east, north, m."""

    folder: Path
    kind: str
    crs: str
    low: float
    high: float
    bounds: tuple[float, float, float, float]

    @property
    def images(self) -> list[Path]:
        """The six views of one date."""
        return [self.folder / f"img_{view}.tif" for view in VIEWS]


def open_rendered(folder: Path) -> RenderedFolder:
    """Read the description of a rendered scene from its folder."""
    folder = rendered_scene(folder)
    text = json.loads((folder / "scene.json").read_text())
    with rasterio.open(folder / "truth_dsm.tif") as truth:
        heights = truth.read(1)
        return RenderedFolder(
            folder, text["kind"], truth.crs.to_string(), float(heights.min()), float(heights.max()), tuple(truth.bounds)
        )


def mvll(scene: RenderedFolder, out: Path) -> Path:
    """Run `zlocus dsm --method mvll` on the six views and return the path of the surface."""
    command = [
        sys.executable, "-c", "from zlocus.cli.app import app; app()", "dsm", *scene.images, "-o", out,
        "--method", "mvll", "--resolution", STEP_M, "--crs", scene.crs, "--bounds", *scene.bounds, "--overwrite",
        "--no-report",
    ]  # fmt: skip
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
    return out / "dsm.tif"


def pointing(scene: RenderedFolder, record: Path | None) -> dict[str, np.ndarray]:
    """Pointing corrections (column, row) px by view, to be added to projected positions.

    record : `run.json` with corrections; without it, the negative of the planted pointing errors.
    """
    if record is not None:
        views = json.loads(record.read_text())["orientation"]["views"]
        return {name: np.array(views[f"img_{name}"]["shift_px"]) for name in PAIR}
    views = json.loads((scene.folder / "scene.json").read_text())["views"]
    return {name: -np.array(views[name]["bias_row_col"][::-1]) for name in PAIR}


def opencv(scene: RenderedFolder, out: Path, record: Path | None = None) -> Path:
    """Match the pair by StereoSGBM and return the path of the surface: the highest point of each cell, gaps filled.

    record : `run.json` that holds the pointing corrections. A gap takes the height of the nearest cell.
    """
    opened = open_scene([scene.folder / f"img_{name}.tif" for name in PAIR])
    shifts = [pointing(scene, record)[name] for name in PAIR]
    middle = (scene.low + scene.high) / 2
    moved = parallax(scene, opened.views, shifts, middle)
    plane = rectified(scene, moved)
    left, right = (grey_on_plane(view, shift, plane, middle) for view, shift in zip(opened.views, shifts, strict=True))
    first, count = disparity_range((scene.low, scene.high), moved, RANGE_MARGIN_M)
    border = count
    left, right = (cv2.copyMakeBorder(grey, 0, 0, border, border, cv2.BORDER_REPLICATE) for grey in (left, right))
    matcher = cv2.StereoSGBM_create(
        minDisparity=first, numDisparities=count, blockSize=BLOCK, P1=8 * BLOCK**2, P2=32 * BLOCK**2, disp12MaxDiff=1,
        preFilterCap=63, uniquenessRatio=5, speckleWindowSize=50, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    disparity = matcher.compute(left, right)[:, border:-border].astype(float) / 16.0
    disparity[disparity < first] = np.nan
    xyz = ground_points(disparity, opened.views[0], shifts[0], plane, moved, middle)
    return write_surface(scene, gridded(scene, xyz), out / "dsm.tif")


def grey_on_plane(view: View, shift: np.ndarray, plane: Rectified, z: float) -> np.ndarray:
    """A view resampled onto the plane and stretched to 8 bits, (r, c) uint8."""
    rows, cols = view.image.shape
    dark, bright = np.percentile(view.image.read(0, 0, rows, cols).pixels, GREY_PERCENT)
    stretched = 255.0 * (on_plane(view, shift, plane, z) - dark) / (bright - dark)
    return np.asarray(np.clip(stretched, 0, 255).astype(np.uint8))


def judged(scene: RenderedFolder, dsm: Path) -> dict[str, dict[str, float]]:
    """Accuracy by class; hills, whose RPC have pointing errors, are aligned first."""
    truth, classes = scene.folder / "truth_dsm.tif", scene.folder / "truth_class.tif"
    return judging.judged(dsm, truth, classes, align=scene.kind == "hills")


def baselines(folder: Path, out: Path, methods: tuple[str, ...] = METHODS) -> dict[str, dict[str, dict[str, float]]]:
    """Accuracy by method and class. out : folder for the runs."""
    scene = open_rendered(folder)
    found = {}
    if "mvll" in methods:
        found["mvll"] = judged(scene, mvll(scene, out / "mvll"))
    if "opencv" in methods:
        record = out / "mvll" / "run.json"
        found["opencv"] = judged(scene, opencv(scene, out / "opencv", record if record.exists() else None))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="a rendered scene")
    parser.add_argument("--keep", type=Path, help="folder for the runs")
    parser.add_argument("--only", choices=METHODS)
    options = parser.parse_args()
    methods = (options.only,) if options.only else METHODS
    print("| scene | method | all | ground | building | tree | NMAD ground, m |\n|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        for folder in options.folders:
            for method, found in baselines(folder, (options.keep or Path(scratch)) / folder.name, methods).items():
                shares = (f"{found[name]['within']:.3f}" if name in found else "" for name in SURFACES)
                nmad = found["ground"]["nmad"]
                print(f"| {folder.name} | {method} | {' | '.join(shares)} | {nmad:.3f} |", flush=True)


if __name__ == "__main__":
    ended(main)
