"""What every importer hands over, and the reading they share: files found, finite numbers, sizes and rotations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.open_raster import existing_file
from zlocus.io.safe_text import EXPORT_AGAIN, MAX_MAGNITUDE, decimal, quoted

ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class ImportedExposure:
    """One image and its camera, in zlocus's conventions.

    image : name in the file; interior : entries of a frame camera in `scene.yaml`, of which principal_point may be left
    out, then it is the centre of the image; centre : (3,) m; rotation : (3, 3), the camera's axes (right, down,
    forwards); size : columns and rows for which the interior holds, None where the file does not say.
    """

    image: str
    interior: Mapping[str, Any]
    centre: FloatArray
    rotation: FloatArray
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class ImportedCameras:
    """The cameras of a file. path : it; crs : of the centres, None for local axes; flat : they are Cartesian in it."""

    path: Path
    exposures: tuple[ImportedExposure, ...]
    crs: str | None = None
    flat: bool = False


def find_camera_file(source: Path, names: Sequence[str], what: str) -> Path:
    """`source` itself if it is a file, else the first of `names` that is one in that folder.

    Raises
    ------
    InputError
        Where there is none.
    """
    source = Path(source)
    if not source.is_dir():
        return existing_file(source, what)
    for name in names:
        if (source / name).is_file():
            return source / name
    raise InputError(f"{source} holds no {what}: looked for {', '.join(names)}. Give its folder, or the file itself.")


def read_number(value: Any, path: Path, where: str) -> float:
    """A finite number, from text or from a number.

    Raises
    ------
    InputError
        Naming the place, and what stands there.
    """
    try:
        # Python takes True for 1 and 1_0 for 10.
        found = decimal(value) if isinstance(value, str) else math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not abs(found) <= MAX_MAGNITUDE:
        raise InputError(f"{path}: {where} is {quoted(value)}, not a finite number. {EXPORT_AGAIN}")
    return found


def read_numbers(values: Any, count: int, path: Path, where: str) -> FloatArray:
    """`count` finite numbers, (count,)."""
    values = values.split() if isinstance(values, str) else values
    if not isinstance(values, list | tuple) or len(values) != count:
        n = len(values) if isinstance(values, list | tuple) else 0
        raise InputError(f"{path}: {where} has {n} numbers, not {count}. {EXPORT_AGAIN}")
    return np.array([read_number(value, path, where) for value in values])


def image_size(width: Any, height: Any, path: Path, where: str) -> tuple[int, int]:
    """Columns and rows of an image."""
    found = [read_number(value, path, f"the size of {where}") for value in (width, height)]
    if not all(v >= 1 and v == int(v) for v in found):
        raise InputError(f"{path}: {where} has {found[0]:g} x {found[1]:g} pixels. {EXPORT_AGAIN}")
    return int(found[0]), int(found[1])


def rotation_matrix(rows: FloatArray, path: Path, where: str) -> FloatArray:
    """(3, 3), found to be a rotation and freed of rounding."""
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
