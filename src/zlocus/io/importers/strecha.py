"""The `.camera` files of the benchmark of Strecha et al. (CVPR 2008), beside the images or in a folder of their own.

Axes: x ~ K R' (X - C), with the camera's axes right, down, forwards in the columns of R. Pixels: K's are taken as
zlocus's, for the benchmark does not say how they are counted. Distortion has been removed from the images.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.requests import ImportRequest
from zlocus.io.importers.base import Exposure, Imported, numbers, rotation_matrix, size
from zlocus.io.safe_text import AGAIN, text_lines

FOLDERS = ("", "gt_dense_cameras", "cameras")
ENDING = ".camera"
LINES = 9


def read_strecha(request: ImportRequest) -> Imported:
    """The images of the folder. See `Exposure`; coordinates are local.

    Raises
    ------
    InputError
        Where there is no such file, or one is damaged.
    """
    for folder in FOLDERS:
        files = sorted((request.source / folder).glob(f"*{ENDING}")) if request.source.is_dir() else []
        if files:
            return Imported(files[0].parent, tuple(_exposure(path) for path in files))
    raise InputError(f"{request.source} holds no *{ENDING} file, nor do {', '.join(FOLDERS[1:])} in it. Give a folder.")


def _exposure(path: Path) -> Exposure:
    lines = [line for _, line in text_lines(path) if line.split()]
    if len(lines) != LINES:
        raise InputError(f"{path} has {len(lines)} lines, not {LINES}: K, distortion, R, C, size. {AGAIN}")
    rows = [numbers(line, 3, path, f"line {i}") for i, line in enumerate(lines[:8], 1)]
    calibration, distortion = np.array(rows[:3]), rows[3]
    if np.any(distortion):
        raise InputError(f"{path} has a distortion, whose formula is not known. Use the images freed of it.")
    if calibration[1, 0] or not np.array_equal(calibration[2], [0.0, 0.0, 1.0]):
        raise InputError(f"{path} has a K that is no calibration matrix. {AGAIN}")
    (fx, skew, cx), (_, fy, cy), _ = calibration.tolist()
    interior = {"focal": [fx, fy], "principal_point": [cx, cy], **({"skew": skew} if skew else {})}
    rotation = rotation_matrix(np.array(rows[4:7]), path, "R")
    wide, high = numbers(lines[8], 2, path, "the size of the image")
    pixels = size(wide, high, path, "the image")
    return Exposure(path.name.removesuffix(ENDING), interior, rows[7], rotation.T, pixels)
