"""Rectified photographs with ground truth (Scharstein and Szeliski 2002, 2003): `zlocus cloud` and OpenCV's matcher.

    python benchmarks/middlebury.py FOLDER [--only CASE ...] [--keep OUT]

FOLDER holds cones, teddy and tsukuba, or those of them that the CASEs need (a CASE is "teddy, 2 views"). A pixel is bad
if its disparity is wrong by more than 1 px, or missing. All pixels with a known truth count. Where both images have a
truth, pixels whose two truths disagree are occluded and do not count.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from zlocus.io.cameras.camera_kinds import FrameCamera
from zlocus.io.images import open_image
from zlocus.io.scene_file import Frame, SceneFile, ViewEntry, write_scene_file
from zlocus.matching.quality import Quality

ZLOCUS = Path(sys.executable).with_name("zlocus")
# The focal length and the step are arbitrary; results are in pixels of disparity.
FOCAL_PX, STEP_M = 500.0, 1.0
LEAST_PX, BAD_PX = 1.0, 1.0
LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
BLOCK, UNIQUENESS = 3, 0


@dataclass(frozen=True)
class Case:
    """Photographs of one scene.

    views : image files and their steps to the right of the first, which is the reference; most_px : largest disparity
    per step that both programs search; truth : (file, value of one pixel of disparity) of the reference and, if there
    is one, of the view one step to the right.
    """

    folder: str
    views: tuple[tuple[str, float], ...]
    most_px: int
    truth: tuple[tuple[str, float], ...]


CONES_TRUTH = (("disp2.png", 4.0), ("disp6.png", 4.0))
TSUKUBA = tuple((f"scene1.row3.col{k}.ppm", k - 3.0) for k in (3, 4, 1, 2, 5))
TSUKUBA_TRUTH = (("truedisp.row3.col3.pgm", 16.0),)
CASES = {
    "cones, 2 views": Case("cones", (("im2.png", 0.0), ("im6.png", 1.0)), 63, CONES_TRUTH),
    "cones, 3 views": Case("cones", (("im2.png", 0.0), ("im6.png", 1.0), ("im4.png", 0.5)), 63, CONES_TRUTH),
    "teddy, 2 views": Case("teddy", (("im2.png", 0.0), ("im6.png", 1.0)), 63, CONES_TRUTH),
    "tsukuba, 2 views": Case("tsukuba", TSUKUBA[:2], 15, TSUKUBA_TRUTH),
    "tsukuba, 3 views": Case("tsukuba", (*TSUKUBA[:2], TSUKUBA[3]), 15, TSUKUBA_TRUTH),
    "tsukuba, 5 views": Case("tsukuba", TSUKUBA, 15, TSUKUBA_TRUTH),
}


@dataclass(frozen=True)
class BadPixels:
    """Percent of the counted pixels that are bad with zlocus, bad with OpenCV (first two views), and empty with zlocus
    before gaps are filled."""

    zlocus: float
    opencv: float
    unfilled: float


def judge(data: Path, name: str, out: Path) -> BadPixels:
    """Match one case by both programs. data : folder of the scenes; out : folder for the run."""
    case = CASES[name]
    truth = true_disparity(data / case.folder, case)
    found, unfilled = zlocus_disparity(data / case.folder, case, out)
    known = np.isfinite(truth)
    return BadPixels(
        bad(found, truth), bad(opencv_disparity(data / case.folder, case), truth), 100.0 * float(unfilled[known].mean())
    )


def true_disparity(folder: Path, case: Case) -> np.ndarray:
    """True disparity (r, c) px per step, NaN where it is unknown or the truth of the other image disagrees."""
    first, *others = (cv2.imread(str(folder / file), cv2.IMREAD_UNCHANGED) / unit for file, unit in case.truth)
    known = first > 0
    for other in others:
        row, col = np.mgrid[: first.shape[0], : first.shape[1]]
        there = np.rint(col - first).astype(int)
        known &= (there >= 0) & (np.abs(other[row, np.maximum(there, 0)] - first) <= BAD_PX)
    return np.where(known, first, np.nan)


def bad(found: np.ndarray, truth: np.ndarray) -> float:
    """Percent of the pixels with a truth that are wrong or empty."""
    known = np.isfinite(truth)
    return 100.0 * float((~(np.abs(found - truth) <= BAD_PX))[known].mean())


def zlocus_disparity(folder: Path, case: Case, out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (r, c) px per step with gaps filled, and the mask of the gaps."""
    out.mkdir(parents=True, exist_ok=True)
    scene = out / "scene.yaml"
    write_scene_file(scene, scene_file(folder, case))
    subprocess.run([ZLOCUS, "cloud", scene, "-o", out / "cloud", "--fill", "interpolate", "--overwrite"], check=True,
                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
    name = Path(case.views[0][0]).stem
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(out / "cloud" / f"{name}_depth.tif") as file:
            depth = file.read(1)
        with rasterio.open(out / "cloud" / f"{name}_quality.tif") as file:
            quality = file.read(1)
    return FOCAL_PX * STEP_M / depth, ((quality & Quality.FILLED) != 0) | np.isnan(depth)


def scene_file(folder: Path, case: Case) -> SceneFile:
    """Write the scene file: one ideal camera, moved along x, that looks along z."""
    entries = []
    for file, steps in case.views:
        path = (folder / file).resolve()
        rows, cols = open_image(path).shape
        camera = FrameCamera(focal=FOCAL_PX, principal_point=((cols - 1) / 2, (rows - 1) / 2),
                             centre=(steps * STEP_M, 0.0, 0.0), rotation=LEVEL)  # fmt: skip
        entries.append(ViewEntry(name=path.stem, image=str(path), camera=camera))
    depths = (FOCAL_PX * STEP_M / case.most_px, FOCAL_PX * STEP_M / LEAST_PX)
    return SceneFile(schema=1, frame=Frame(local=True), heights=depths, views=tuple(entries))


def opencv_disparity(folder: Path, case: Case) -> np.ndarray:
    """Disparity (r, c) px of StereoSGBM with eight paths, from the luminance of the first two views."""
    first, second = (cv2.imread(str(folder / file), cv2.IMREAD_GRAYSCALE) for file, _ in case.views[:2])
    n = -(-(case.most_px + 1) // 16) * 16
    # A border on the left keeps the first n columns, which StereoSGBM would leave empty.
    first, second = (cv2.copyMakeBorder(image, 0, 0, n, 0, cv2.BORDER_REPLICATE) for image in (first, second))
    matcher = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=n, blockSize=BLOCK, P1=8 * BLOCK**2, P2=32 * BLOCK**2, disp12MaxDiff=1,
        preFilterCap=63, uniquenessRatio=UNIQUENESS, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    found = matcher.compute(first, second)[:, n:] / 16.0
    return np.where(found < 0, np.nan, found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder that holds cones, teddy and tsukuba")
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES), metavar="CASE",
                        help="; ".join(CASES))  # fmt: skip
    parser.add_argument("--keep", type=Path, help="folder for the runs")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        print("| scene | zlocus | OpenCV SGBM HH | gaps before filling |\n|---|---|---|---|")
        for name in arguments.only:
            out = (arguments.keep or Path(scratch)) / name.replace(", ", "-").replace(" ", "-")
            found = judge(arguments.data, name, out)
            print(f"| {name} | {found.zlocus:.2f} % | {found.opencv:.2f} % | {found.unfilled:.2f} % |", flush=True)


if __name__ == "__main__":
    main()
