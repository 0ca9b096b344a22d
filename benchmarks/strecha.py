"""The `.camera` files of the benchmark of Strecha et al. (CVPR 2008) as a `scene.yaml`.

    python benchmarks/strecha.py herzjesu_p8 --up -0.733 0.68 0 --north 0 0 -1 -o scene.yaml

Axes: x ~ K R' (X - C); the columns of R are the camera's axes right, down and forwards. Pixels: K is taken to count
from the centre of the first pixel, because the benchmark does not say how it counts. The images are free of distortion.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.requests import ImportRequest
from zlocus.io.importers.base import ImportedCameras, ImportedExposure, image_size, read_numbers, rotation_matrix
from zlocus.io.importers.scene import scene_of
from zlocus.io.safe_text import EXPORT_AGAIN, text_lines
from zlocus.io.scene_file import SceneFile, write_scene_file

FOLDERS = ("", "gt_dense_cameras", "cameras")
ENDING = ".camera"
N_LINES = 9

Axis = tuple[float, float, float]


def main() -> None:
    """Read the command line and write the scene file."""
    parser = argparse.ArgumentParser(description="Write a scene.yaml for a folder of the benchmark of Strecha et al.")
    parser.add_argument("folder", type=Path, help="folder of the *.camera files, or the folder that holds it")
    parser.add_argument("-o", "--out", type=Path, required=True, help="scene file to write")
    parser.add_argument("--up", type=float, nargs=3, metavar=("X", "Y", "Z"), help="direction that becomes z")
    parser.add_argument("--north", type=float, nargs=3, metavar=("X", "Y", "Z"), help="direction that becomes y")
    given = parser.parse_args()
    up, north = (None if axis is None else tuple(axis) for axis in (given.up, given.north))
    write_strecha_scene(given.folder, given.out, up, north)


def write_strecha_scene(folder: Path, out: Path, up: Axis | None = None, north: Axis | None = None) -> SceneFile:
    """Write the scene file of a folder of the benchmark, in a local frame, and return what was written.

    up, north : directions in the axes of the camera files that become z and y of the frame.

    Raises
    ------
    InputError
        There is no camera file, one is damaged, or an image is missing.
    OutputError
        The scene file cannot be written.
    """
    scene_file = scene_of(read_strecha(folder), ImportRequest("strecha", folder, out, up=up, north=north))
    write_scene_file(out, scene_file)
    return scene_file


def read_strecha(folder: Path) -> ImportedCameras:
    """The cameras of a folder, in the benchmark's own axes.

    Raises
    ------
    InputError
        There is no camera file, or one is damaged.
    """
    for name in FOLDERS:
        paths = sorted((folder / name).glob(f"*{ENDING}")) if folder.is_dir() else []
        if paths:
            return ImportedCameras(paths[0].parent, tuple(_read_exposure(path) for path in paths))
    raise InputError(f"{folder} holds no *{ENDING} file, nor do {', '.join(FOLDERS[1:])} in it. Give a folder.")


def _read_exposure(path: Path) -> ImportedExposure:
    lines = [line for _, line in text_lines(path) if line.split()]
    if len(lines) != N_LINES:
        raise InputError(f"{path} has {len(lines)} lines, not {N_LINES}: K, distortion, R, C, size. {EXPORT_AGAIN}")
    rows = [read_numbers(line, 3, path, f"line {i}") for i, line in enumerate(lines[:8], 1)]
    calibration, distortion = np.array(rows[:3]), rows[3]
    if np.any(distortion):
        raise InputError(f"{path} has a distortion, whose formula is not known. Use the images freed of it.")
    if calibration[1, 0] or not np.array_equal(calibration[2], [0.0, 0.0, 1.0]):
        raise InputError(f"{path} has a K that is no calibration matrix. {EXPORT_AGAIN}")
    (fx, skew, cx), (_, fy, cy), _ = calibration.tolist()
    interior = {"focal": [fx, fy], "principal_point": [cx, cy], **({"skew": skew} if skew else {})}
    rotation = rotation_matrix(np.array(rows[4:7]), path, "R")
    n_cols, n_rows = read_numbers(lines[8], 2, path, "the size of the image")
    size = image_size(n_cols, n_rows, path, "the image")
    return ImportedExposure(path.name.removesuffix(ENDING), interior, rows[7], rotation.T, size)


if __name__ == "__main__":
    main()
