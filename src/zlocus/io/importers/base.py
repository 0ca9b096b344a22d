"""What every importer hands over, and the reading they share: whole text files, finite numbers, JSON and XML."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np

from zlocus.errors import InputError
from zlocus.io.opening import existing_file
from zlocus.sensors.model import FloatArray

AGAIN = "Export it again, or copy it again from its source."
UNIT = 1e-3
DEEPEST_XML = 64
LONGEST_SHOWN = 40


@dataclass(frozen=True)
class Exposure:
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
class Imported:
    """The cameras of a file. path : it; crs : of the centres, None for local axes; flat : they are Cartesian in it."""

    path: Path
    exposures: tuple[Exposure, ...]
    crs: str | None = None
    flat: bool = False


def found_file(source: Path, names: Sequence[str], what: str) -> Path:
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


def read_bytes(path: Path) -> bytes:
    """The whole file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Check the path.") from error


def read_text(path: Path) -> str:
    """The whole file, which is UTF-8."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text, from byte {error.start} on. {AGAIN}") from error


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, from 1, read one at a time; every line, the last too, has an end.

    Raises
    ------
    InputError
        Where the file cannot be read, is not UTF-8, or stops within a line.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                if not line.endswith("\n"):
                    raise InputError(
                        f"{path} stops within line {number}: it may be truncated. Copy it again, or end that line."
                    )
                yield number, line.rstrip("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text. {AGAIN}") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Check the path.") from error


def number(value: Any, path: Path, where: str) -> float:
    """A finite number, from text or from a number.

    Raises
    ------
    InputError
        Naming the place, and what stands there.
    """
    try:
        # Python takes True for 1 and 1_0 for 10.
        found = math.nan if isinstance(value, bool) or "_" in str(value) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise InputError(f"{path}: {where} is {shown(value)}, not a finite number. {AGAIN}")
    return found


def numbers(values: Any, count: int, path: Path, where: str) -> FloatArray:
    """`count` finite numbers, (count,)."""
    values = values.split() if isinstance(values, str) else values
    if not isinstance(values, list | tuple) or len(values) != count:
        n = len(values) if isinstance(values, list | tuple) else 0
        raise InputError(f"{path}: {where} has {n} numbers, not {count}. {AGAIN}")
    return np.array([number(value, path, where) for value in values])


def size(width: Any, height: Any, path: Path, where: str) -> tuple[int, int]:
    """Columns and rows of an image."""
    found = [number(value, path, f"the size of {where}") for value in (width, height)]
    if not all(v >= 1 and v == int(v) for v in found):
        raise InputError(f"{path}: {where} has {found[0]:g} x {found[1]:g} pixels. {AGAIN}")
    return int(found[0]), int(found[1])


def rotation_matrix(rows: FloatArray, path: Path, where: str) -> FloatArray:
    """(3, 3), found to be a rotation and freed of rounding."""
    rows = np.asarray(rows, float).reshape(3, 3)
    usable = np.abs(rows).max() < 2 and np.abs(rows @ rows.T - np.eye(3)).max() < UNIT and np.linalg.det(rows) > 0
    if not usable:
        raise InputError(f"{path}: {where} has a matrix that is no rotation. {AGAIN}")
    u, _, v = np.linalg.svd(rows)
    return np.asarray(u @ v)


def shown(value: Any) -> str:
    """A value for a message."""
    text = value if isinstance(value, str) else repr(value)
    return repr(text if len(text) <= LONGEST_SHOWN else text[:LONGEST_SHOWN] + "...")


def read_json(path: Path) -> Any:
    """A JSON document, with finite numbers only."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"it holds {constant}, which is no number")

    try:
        return json.loads(read_text(path), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        what = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise InputError(f"{path} cannot be read as JSON: {what}. {AGAIN}") from error


def read_xml(path: Path) -> Element:
    """The root of an XML document that declares no document type, and so no entities.

    Raises
    ------
    InputError
        Where it does, is nested too deeply, or is not XML.
    """
    content, depth = read_bytes(path), 0

    def refuse(*_: Any) -> NoReturn:
        raise InputError(f"{path} declares a document type, which camera files do not and which is not read. {AGAIN}")

    def deeper(*_: Any) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST_XML:
            raise InputError(f"{path} is nested more than {DEEPEST_XML} levels deep: no file of cameras. {AGAIN}")

    def higher(*_: Any) -> None:
        nonlocal depth
        depth -= 1

    check = expat.ParserCreate()
    check.StartDoctypeDeclHandler, check.StartElementHandler, check.EndElementHandler = refuse, deeper, higher
    try:
        check.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path} cannot be read as XML: {error}. {AGAIN}") from error
