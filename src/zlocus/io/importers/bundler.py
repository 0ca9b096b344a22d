"""Import Bundler's `bundle.out` with its list of images.

Axes: those of the camera are right, up, backwards, so two of them change their sign. Pixels: the origin is the centre
of the image, and y is up. Distortion: 1 + k1 r2 + k2 r4 on ideal positions, which is Brown's.
Source: Bundler v0.4 User's Manual, "Output format and scene representation".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.requests import ImportRequest
from zlocus.io.importers.base import (
    ImportedCameras,
    ImportedExposure,
    find_camera_file,
    read_number,
    read_numbers,
    rotation_matrix,
)
from zlocus.io.safe_text import EXPORT_AGAIN, text_lines

FILES = ("bundle.out", "bundle/bundle.out", "bundle.rd.out", "bundler.out")
LISTS = ("list.txt", "../list.txt", "bundle.out.list.txt", "bundle.rd.out.list.txt")
HEADING = re.compile(r"# Bundle file v0\.[345]\s*")
RIGHT_DOWN_FORWARDS = np.diag([1.0, -1.0, -1.0])


def read_bundler(request: ImportRequest) -> ImportedCameras:
    """The registered images. Coordinates are local, or those of `--crs`, taken as Cartesian.

    Raises
    ------
    InputError
        A file is missing or damaged, or the list of images has another length.
    """
    path = find_camera_file(request.source, FILES, "Bundler file")
    list_path = find_camera_file(path.parent, LISTS, "list of images of the Bundler file")
    names = [line.split()[0] for _, line in text_lines(list_path) if line.split()]
    lines = text_lines(path)
    _, heading = next(lines, (1, ""))
    if not HEADING.fullmatch(heading):
        raise InputError(f"{path} does not begin with '# Bundle file v0.3', but with {quoted(heading)}. {EXPORT_AGAIN}")
    n_cameras, n_points = _counts(lines, path)
    if n_cameras != len(names):
        raise InputError(f"{path} has {n_cameras} cameras, and {list_path} lists {len(names)} images. {EXPORT_AGAIN}")
    cameras = (_exposure(lines, name, path) for name in names)
    exposures = tuple(camera for camera in cameras if camera is not None)
    left = sum(1 for _ in lines)
    if left < 3 * n_points:
        raise InputError(
            f"{path} is truncated: {n_points} points take {3 * n_points} lines, and {left} follow. {EXPORT_AGAIN}"
        )
    return ImportedCameras(path, exposures, request.crs, flat=True)


def _counts(lines: Iterator[tuple[int, str]], path: Path) -> tuple[int, int]:
    line_number, line = next(lines, (2, ""))
    match = re.fullmatch(r"\s*(\d{1,12})\s+(\d{1,12})\s*", line)
    if match is None:
        raise InputError(
            f"{path}: line {line_number} is {quoted(line)}, not the numbers of cameras and points. {EXPORT_AGAIN}"
        )
    return int(match[1]), int(match[2])


def _exposure(lines: Iterator[tuple[int, str]], name: str, path: Path) -> ImportedExposure | None:
    """The camera in the next five lines: focal length, k1, k2; rotation; translation. None for unregistered images."""
    rows = []
    for _ in range(5):
        line_number, line = next(lines, (0, ""))
        if not line_number:
            raise InputError(f"{path} is truncated: it ends within the camera of {quoted(name)}. {EXPORT_AGAIN}")
        rows.append(read_numbers(line, 3, path, f"line {line_number}"))
    (focal, k1, k2), translation = rows[0], rows[4]
    if focal == 0:
        return None
    rotation = rotation_matrix(np.array(rows[1:4]), path, f"the camera of {quoted(name)}")
    interior = {
        "focal": read_number(focal, path, "focal"),
        "distortion": {"kind": "brown", "k1": float(k1), "k2": float(k2)},
    }
    return ImportedExposure(name, interior, -rotation.T @ translation, RIGHT_DOWN_FORWARDS @ rotation)
