"""What methods without zlocus' own steps reach on a rendered scene: how hard the scene is, whatever zlocus makes of it.

    python benchmarks/baselines.py FOLDER ... [--keep OUT] [--only mvll|opencv]

Each FOLDER holds a rendered scene. `mvll` is plain vertical line locus matching: independent cells, six views. `opencv`
is StereoSGBM with eight paths on two views resampled onto a plane at a constant height. Both get the same pointing
corrections, and the area with truth. The shared judge of `ZLOCUS_TEST_DATA` gives the shares within 1 m.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import distance_transform_edt

from zlocus.io.scene_file import open_scene
from zlocus.scene import View

VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")
PAIR = ("n1", "f1")
STEP_M = 0.5
MARGIN_M = 25.0
BLOCK = 3
GREY_PERCENT = (0.2, 99.8)
SURFACES = ("all", "ground", "building", "tree")
METHODS = ("mvll", "opencv")


@dataclass(frozen=True)
class RenderedFolder:
    """A rendered scene on disk. low, high : heights of the truth, m; bounds : west, south, east, north."""

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


@dataclass(frozen=True)
class Rectified:
    """A view on the plane: positions on it are metres along and across the parallax, `shape` cells of STEP_M.

    origin : (x, y) m of the first cell's centre; along, across : unit vectors in (x, y).
    """

    origin: np.ndarray
    along: np.ndarray
    across: np.ndarray
    shape: tuple[int, int]

    def ground(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """(n, 2) m of cells."""
        at = STEP_M * np.stack([cols, rows], axis=-1).reshape(-1, 2)
        return self.origin + at @ np.stack([self.along, self.across])


def open_rendered(folder: Path) -> RenderedFolder:
    """What is in a folder of a rendered scene."""
    text = json.loads((folder / "scene.json").read_text())
    with rasterio.open(folder / "truth_dsm.tif") as truth:
        heights = truth.read(1)
        return RenderedFolder(
            folder, text["kind"], truth.crs.to_string(), float(heights.min()), float(heights.max()), tuple(truth.bounds)
        )


def mvll(scene: RenderedFolder, out: Path) -> Path:
    """`zlocus dsm --method mvll` on the six views. Returns the surface."""
    command = [
        sys.executable, "-c", "from zlocus.cli import app; app()", "dsm", *scene.images, "-o", out,
        "--method", "mvll", "--resolution", STEP_M, "--crs", scene.crs, "--bounds", *scene.bounds, "--overwrite",
    ]  # fmt: skip
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
    return out / "dsm.tif"


def pointing(scene: RenderedFolder, record: Path | None) -> dict[str, np.ndarray]:
    """(column, row) px by view, to be added to what the RPC projects: a run's, or those that undo what was put in."""
    if record is not None:
        views = json.loads(record.read_text())["orientation"]["views"]
        return {name: np.array(views[f"img_{name}"]["shift_px"]) for name in PAIR}
    views = json.loads((scene.folder / "scene.json").read_text())["views"]
    return {name: -np.array(views[name]["bias_row_col"][::-1]) for name in PAIR}


def opencv(scene: RenderedFolder, out: Path, record: Path | None = None) -> Path:
    """StereoSGBM on the pair; heights from disparities; the highest in each cell, gaps from the nearest cell.

    record : `run.json` that holds the pointing corrections. Returns the surface.
    """
    opened = open_scene([scene.folder / f"img_{name}.tif" for name in PAIR])
    shifts = [pointing(scene, record)[name] for name in PAIR]
    middle = (scene.low + scene.high) / 2
    moved = parallax(scene, opened.views, shifts, middle)
    plane = rectified(scene, moved)
    left, right = (grey_on_plane(view, shift, plane, middle) for view, shift in zip(opened.views, shifts, strict=True))
    per_m = float(np.hypot(*moved)) / STEP_M
    reach = per_m * ((scene.high - scene.low) / 2 + 3.0)
    first, count = -int(np.ceil(reach)), 16 * int(np.ceil(2 * reach / 16) + 1)
    border = count
    left, right = (cv2.copyMakeBorder(grey, 0, 0, border, border, cv2.BORDER_REPLICATE) for grey in (left, right))
    matcher = cv2.StereoSGBM_create(
        minDisparity=first, numDisparities=count, blockSize=BLOCK, P1=8 * BLOCK**2, P2=32 * BLOCK**2, disp12MaxDiff=1,
        preFilterCap=63, uniquenessRatio=5, speckleWindowSize=50, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    disparity = matcher.compute(left, right)[:, border:-border].astype(float) / 16.0
    rows, cols = np.nonzero(disparity >= first)
    z = middle + disparity[rows, cols] / per_m
    seen = to_image(opened.views[0], shifts[0], plane.ground(rows, cols), middle)
    xyz = opened.views[0].sensor.ground_from_image(seen - shifts[0], z)
    return write_surface(scene, xyz, out)


def to_image(view: View, shift: np.ndarray, xy: np.ndarray, z: float) -> np.ndarray:
    """Image positions (n, 2) px of ground points (n, 2) m at one height."""
    return np.asarray(view.sensor.image_from_ground(np.column_stack([xy, np.full(len(xy), z)])) + shift)


def parallax(scene: RenderedFolder, views: tuple[View, ...], shifts: list[np.ndarray], z: float) -> np.ndarray:
    """How far (x, y) m on the plane the second view moves against the first for each metre of height; the direction is
    that in which a higher point of the second view lies before that of the first."""
    west, south, east, north = scene.bounds
    point = np.array([[(west + east) / 2, (south + north) / 2]])
    on_plane = []
    for view, shift in zip(views, shifts, strict=True):
        seen = to_image(view, shift, point, z + 10.0)
        on_plane.append(view.sensor.ground_from_image(seen - shift, np.array([z]))[0, :2])
    return np.asarray((on_plane[0] - on_plane[1]) / 10.0)


def rectified(scene: RenderedFolder, moved: np.ndarray) -> Rectified:
    """A plane's frame around the area, whose rows run along the parallax."""
    west, south, east, north = scene.bounds
    along = moved / np.hypot(*moved)
    across = np.array([along[1], -along[0]])
    corners = np.array([(x, y) for x in (west, east) for y in (south, north)])
    places = corners @ np.stack([along, across], axis=1)
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    cols, rows = (int(n) + 1 for n in (high - low) / STEP_M)
    return Rectified(low @ np.stack([along, across]), along, across, (rows, cols))


def grey_on_plane(view: View, shift: np.ndarray, plane: Rectified, z: float) -> np.ndarray:
    """(r, c) uint8 of a view on the plane."""
    rows, cols = view.image.shape
    grey = view.image.read(0, 0, rows, cols).pixels
    row, col = np.mgrid[: plane.shape[0], : plane.shape[1]]
    seen = to_image(view, shift, plane.ground(row.ravel(), col.ravel()), z).reshape(*plane.shape, 2)
    on_plane = cv2.remap(
        grey, seen[..., 0].astype(np.float32), seen[..., 1].astype(np.float32), cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    dark, bright = np.percentile(grey, GREY_PERCENT)
    return np.asarray(np.clip(255.0 * (on_plane - dark) / (bright - dark), 0, 255).astype(np.uint8))


def write_surface(scene: RenderedFolder, xyz: np.ndarray, out: Path) -> Path:
    """The highest point in each cell, gaps from the nearest cell that has one. xyz : (n, 3) m."""
    west, south, east, north = scene.bounds
    rows, cols = round((north - south) / STEP_M), round((east - west) / STEP_M)
    row = np.floor((north - xyz[:, 1]) / STEP_M).astype(int)
    col = np.floor((xyz[:, 0] - west) / STEP_M).astype(int)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    surface = np.full((rows, cols), -np.inf)
    np.maximum.at(surface, (row[inside], col[inside]), xyz[inside, 2])
    nearest = distance_transform_edt(~np.isfinite(surface), return_distances=False, return_indices=True)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "dsm.tif"
    with rasterio.open(
        path, "w", driver="GTiff", height=rows, width=cols, count=1, dtype="float32", crs=scene.crs,
        transform=from_origin(west, north, STEP_M, STEP_M),
    ) as file:  # fmt: skip
        file.write(surface[tuple(nearest)].astype(np.float32), 1)
    return path


def judged(scene: RenderedFolder, dsm: Path) -> dict[str, dict[str, float]]:
    """The shared judge's figures; hills are aligned first, for their pointing errors."""
    script = Path(os.environ["ZLOCUS_TEST_DATA"]).parent / "tools" / "evaluate_dsm.py"
    truth = [scene.folder / "truth_dsm.tif", "--class", scene.folder / "truth_class.tif", "--json"]
    align = ["--align"] if scene.kind == "hills" else []
    command = [sys.executable, script, dsm, *truth, *align]
    found: dict[str, dict[str, float]] = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    return found


def baselines(folder: Path, out: Path, methods: tuple[str, ...] = METHODS) -> dict[str, dict[str, dict[str, float]]]:
    """The judge's figures by method. out : folder for the runs."""
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
    main()
