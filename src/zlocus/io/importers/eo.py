"""Import a table of exterior orientations: name, X, Y, Z, omega, phi, kappa (degrees) per line.

Columns are separated by commas, semicolons, tabs or blanks. They are in that order, or in the order of a heading. The
interior orientation comes from the request, in pixels counted from the centre of the first one. Axes: see
`rotation_from_angles`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.quoting import quoted
from zlocus.core.requests import ImportRequest
from zlocus.io.cameras.frame_camera import Interior
from zlocus.io.importers.base import ImportedCameras, ImportedExposure, find_camera_file, read_number
from zlocus.io.open_raster import existing_file
from zlocus.io.safe_documents import read_yaml
from zlocus.io.safe_text import EXPORT_AGAIN, MAX_LINE_CHARACTERS, decimal, text_lines
from zlocus.io.schema import validate_document
from zlocus.sensors.frame import rotation_from_angles

FILES = ("eo.csv", "eo.txt", "exterior.csv", "exterior.txt", "camera_pos_ori.txt", "odm_xyz_opk.csv")
COLUMNS: dict[str, tuple[str, ...]] = {
    "name": ("name", "image", "filename", "file", "label", "photo", "id"),
    "x": ("x", "east", "easting", "e"),
    "y": ("y", "north", "northing", "n"),
    "z": ("z", "height", "altitude", "h"),
    "omega": ("omega", "om"),
    "phi": ("phi", "ph"),
    "kappa": ("kappa", "ka"),
}
MAX_ANGLE_DEG = 1e4
MAX_INTERIOR_BYTES = 100_000


def read_eo(request: ImportRequest) -> ImportedCameras:
    """The images of a table. Coordinates are those of `--crs`, or local.

    Raises
    ------
    InputError
        A file is missing or damaged.
    ConfigError
        The interior orientation is not given.
    """
    path = find_camera_file(request.source, FILES, "table of exterior orientations")
    interior = _interior(request)
    order: dict[str, int] = {name: i for i, name in enumerate(COLUMNS)}
    exposures: list[ImportedExposure] = []
    is_first, n_columns = True, 0
    for line_number, line in text_lines(path):
        fields = _fields(line, path, line_number)
        if not fields or fields[0].startswith("#"):
            continue
        heading = _heading(fields) if is_first else None
        is_first = False
        if heading is not None:
            order = _checked_heading(heading, path)
        else:
            exposures.append(_exposure(fields, order, interior, path, f"line {line_number}"))
        n_columns = n_columns or len(fields)
        if len(fields) != n_columns:
            raise InputError(
                f"{path}: line {line_number} has {len(fields)} columns, and lines before it {n_columns}. {EXPORT_AGAIN}"
            )
    return ImportedCameras(path, tuple(exposures), request.crs, flat=request.earth == "flat")


def _fields(line: str, path: Path, line_number: int) -> list[str]:
    if len(line) > MAX_LINE_CHARACTERS:
        raise InputError(f"{path}: line {line_number} has {len(line)} letters, too many for a row. {EXPORT_AGAIN}")
    delimiter = next((mark for mark in ",;\t" if mark in line), " ")
    quote = "'" if line.lstrip().startswith("'") else '"'
    try:
        rows = list(csv.reader([line], delimiter=delimiter, quotechar=quote, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path}: line {line_number} is no line of a table: {error}. {EXPORT_AGAIN}") from error
    fields = [field.strip().strip("'") for field in rows[0]] if rows else []
    return fields if delimiter != " " else [field for field in fields if field]


def _heading(fields: Sequence[str]) -> list[str] | None:
    """The column names of a heading; None for a line with numbers."""
    for field in fields[1:]:
        if np.isfinite(decimal(field)):
            return None
    return [field.lower().strip("# ") for field in fields]


def _checked_heading(heading: Sequence[str], path: Path) -> dict[str, int]:
    order = {}
    for name, spellings in COLUMNS.items():
        columns = [i for i, column in enumerate(heading) if column in spellings]
        if len(columns) != 1:
            raise InputError(
                f"{path} has {len(columns) or 'no'} columns for {name} in its heading {quoted(' '.join(heading))}. "
                f"Name each of {', '.join(COLUMNS)} once, or leave the heading out."
            )
        order[name] = columns[0]
    return order


def _exposure(
    fields: Sequence[str], order: dict[str, int], interior: dict[str, Any], path: Path, where: str
) -> ImportedExposure:
    if len(fields) <= max(order.values()):
        raise InputError(f"{path}: {where} has {len(fields)} columns, not {max(order.values()) + 1}. {EXPORT_AGAIN}")
    values = {name: read_number(fields[i], path, f"{name} in {where}") for name, i in order.items() if name != "name"}
    angles = [values[name] for name in ("omega", "phi", "kappa")]
    if max(map(abs, angles)) > MAX_ANGLE_DEG:
        raise InputError(f"{path}: {where} has an angle of {max(map(abs, angles)):g} degrees. {EXPORT_AGAIN}")
    centre = np.array([values[name] for name in "xyz"])
    return ImportedExposure(fields[order["name"]], interior, centre, np.array(rotation_from_angles(*angles)))


def _interior(request: ImportRequest) -> dict[str, Any]:
    """The interior orientation: from the file of --camera, with keys as in `scene.yaml`, or from --focal alone."""
    if request.camera is None:
        if request.focal is None:
            raise ConfigError(
                "A table of exterior orientations holds no interior one. Give --focal in pixels, or --camera FILE."
            )
        return {"focal": request.focal}
    document = read_yaml(existing_file(request.camera, "interior orientation"), MAX_INTERIOR_BYTES)
    given = document if isinstance(document, dict) else {}
    # A principal point that is not given is the centre of the image, which the importer fills in later.
    filled = {"principal_point": [0.0, 0.0]} | given
    entry = validate_document(Interior, filled, Path(request.camera)).model_dump(mode="json", exclude_unset=True)
    return {key: value for key, value in entry.items() if key in given}
