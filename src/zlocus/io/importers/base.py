"""The result of every importer, and functions they share: find files, read numbers, sizes and rotations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.sensor_model import FloatArray
from zlocus.io.open_raster import existing_file
from zlocus.io.safe_text import EXPORT_AGAIN, MAX_MAGNITUDE, decimal

ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class ImportedExposure:
    """An image and its camera, in zlocus's conventions.

    image : its name in the imported file; interior : entries of a frame camera in `scene.yaml`, where principal_point
    defaults to the centre of the image; centre : projection centre (3,) m; rotation : (3, 3), rows are the camera's
    axes (right, down, forwards); size : columns and rows of the image, None where the file does not give them.
    """

    image: str
    interior: Mapping[str, Any]
    centre: FloatArray
    rotation: FloatArray
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class ImportedCameras:
    """The cameras of a file.

    path : of the file; crs : of the projection centres, None for a local frame; flat : the map is taken as Cartesian.
    """

    path: Path
    exposures: tuple[ImportedExposure, ...]
    crs: str | None = None
    flat: bool = False


def find_camera_file(source: Path, names: Sequence[str], what: str) -> Path:
    """The path `source` if it is a file, else the first of `names` that is a file in that folder.

    what : role of the file, for messages.

    Raises
    ------
    InputError
        There is no such file.
    """
    source = Path(source)
    if not source.is_dir():
        return existing_file(source, what)
    for name in names:
        if (source / name).is_file():
            return source / name
    raise InputError(f"{source} holds no {what}: looked for {', '.join(names)}. Give its folder, or the file itself.")


def read_number(value: Any, path: Path, where: str) -> float:
    """A finite number from a text or a number. where : place in the file, for messages.

    Raises
    ------
    InputError
        The value is not a finite number; the message names the place and the value.
    """
    try:
        # Python accepts True as 1 and 1_0 as 10.
        result = decimal(value) if isinstance(value, str) else math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    if not abs(result) <= MAX_MAGNITUDE:
        raise InputError(f"{path}: {where} is {quoted(value)}, not a finite number. {EXPORT_AGAIN}")
    return result


def read_numbers(values: Any, count: int, path: Path, where: str) -> FloatArray:
    """Finite numbers (count,) from a list, or from a text that separates them by blanks."""
    values = values.split() if isinstance(values, str) else values
    if not isinstance(values, list | tuple) or len(values) != count:
        n = len(values) if isinstance(values, list | tuple) else 0
        raise InputError(f"{path}: {where} has {n} numbers, not {count}. {EXPORT_AGAIN}")
    return np.array([read_number(value, path, where) for value in values])


def image_size(width: Any, height: Any, path: Path, where: str) -> tuple[int, int]:
    """Columns and rows of an image, checked to be whole numbers from 1 on."""
    values = [read_number(value, path, f"the size of {where}") for value in (width, height)]
    if not all(v >= 1 and v == int(v) for v in values):
        raise InputError(f"{path}: {where} has {values[0]:g} x {values[1]:g} pixels. {EXPORT_AGAIN}")
    return int(values[0]), int(values[1])


def rotation_matrix(rows: FloatArray, path: Path, where: str) -> FloatArray:
    """The rotation matrix (3, 3) nearest to `rows`, which must be one up to rounding.

    Raises
    ------
    InputError
        The rows are no rotation.
    """
    rows = np.asarray(rows, float).reshape(3, 3)
    usable = (
        np.abs(rows).max() < 2
        and np.abs(rows @ rows.T - np.eye(3)).max() < ROTATION_TOLERANCE
        and np.linalg.det(rows) > 0
    )
    if not usable:
        raise InputError(f"{path}: {where} has a matrix that is no rotation. {EXPORT_AGAIN}")
    u, _, v = np.linalg.svd(rows)
    return np.asarray(u @ v)
