"""Import COLMAP's sparse models, text (`cameras.txt`, `images.txt`) and binary (`.bin`).

Axes: those of the camera are right, down, forwards, as in zlocus. Pixels: COLMAP's (0.5, 0.5) is the centre of the
first pixel, so half a pixel is subtracted from the principal point.
Source: COLMAP's documentation, "Output format" and "Camera models".
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.requests import ImportRequest
from zlocus.core.sensor_model import FloatArray
from zlocus.io.importers.base import (
    ROTATION_TOLERANCE,
    ImportedCameras,
    ImportedExposure,
    find_camera_file,
    image_size,
    read_number,
    read_numbers,
)
from zlocus.io.safe_text import EXPORT_AGAIN, read_bytes, text_lines

FOLDERS = ("", "sparse/0/", "sparse/", "colmap/sparse/0/")
# Number, name, kind of distortion, and parameters. f, or fx and fy; cx, cy; coefficients.
MODELS: tuple[tuple[int, str, str | None, str], ...] = (
    (0, "SIMPLE_PINHOLE", None, "f cx cy"),
    (1, "PINHOLE", None, "fx fy cx cy"),
    (2, "SIMPLE_RADIAL", "brown", "f cx cy k1"),
    (3, "RADIAL", "brown", "f cx cy k1 k2"),
    (4, "OPENCV", "brown", "fx fy cx cy k1 k2 p1 p2"),
    (5, "OPENCV_FISHEYE", "fisheye", "fx fy cx cy k1 k2 k3 k4"),
    (6, "FULL_OPENCV", "brown", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    (8, "SIMPLE_RADIAL_FISHEYE", "fisheye", "f cx cy k1"),
    (9, "RADIAL_FISHEYE", "fisheye", "f cx cy k1 k2"),
)
BY_NAME = {name: (kind, tuple(parameters.split())) for _, name, kind, parameters in MODELS}
NAME_OF = {model: name for model, name, _, _ in MODELS}
ORIGIN_PX = 0.5


@dataclass(frozen=True)
class _ColmapCamera:
    """A camera of the model. interior : see `ImportedExposure`; size : columns and rows."""

    interior: dict[str, Any]
    size: tuple[int, int]


def read_colmap(request: ImportRequest) -> ImportedCameras:
    """The registered images of a model. Coordinates are local, or those of `--crs`, taken as Cartesian.

    Raises
    ------
    InputError
        A file is missing or damaged, or a camera model is not supported.
    """
    names = [f"{folder}images.{suffix}" for folder in FOLDERS for suffix in ("bin", "txt")]
    images = find_camera_file(request.source, names, "COLMAP model")
    cameras = find_camera_file(images.parent, [f"cameras{images.suffix}"], "COLMAP cameras")
    if images.suffix == ".bin":
        exposures = _binary_images(images, _binary_cameras(cameras))
    else:
        exposures = _text_images(images, _text_cameras(cameras))
    return ImportedCameras(images, tuple(exposures), request.crs, flat=True)


def _camera(name: str, values: FloatArray, pixels: tuple[int, int]) -> _ColmapCamera:
    kind, parameters = BY_NAME[name]
    given = dict(zip(parameters, map(float, values), strict=True))
    focal = given["f"] if "f" in given else [given["fx"], given["fy"]]
    point = [given["cx"] - ORIGIN_PX, given["cy"] - ORIGIN_PX]
    interior: dict[str, Any] = {"focal": focal, "principal_point": point}
    if kind is not None:
        lens = {key: value for key, value in given.items() if key[0] in "kp"}
        interior["distortion"] = {"kind": kind, **lens}
    return _ColmapCamera(interior, pixels)


def _exposure(
    path: Path, name: str, pose: FloatArray, camera: int, cameras: dict[int, _ColmapCamera]
) -> ImportedExposure:
    """The exposure of an image. pose : (7,) quaternion (w, x, y, z) and translation of camera from world."""
    if camera not in cameras:
        raise InputError(
            f"{path}: {quoted(name)} has camera {camera}, which is not in the file of cameras. {EXPORT_AGAIN}"
        )
    norm = float(np.linalg.norm(pose[:4]))
    if not abs(norm - 1.0) < ROTATION_TOLERANCE:
        raise InputError(f"{path}: {quoted(name)} has a quaternion of length {norm:g}, not 1. {EXPORT_AGAIN}")
    # SciPy's rotations cost 0.2 s to import, and other importers do without them.
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix()  # COLMAP has the scalar first, SciPy last
    known = cameras[camera]
    return ImportedExposure(name, known.interior, -rotation.T @ pose[4:], rotation, known.size)


def _checked_model(name: str, path: Path) -> str:
    if name not in BY_NAME:
        raise InputError(
            f"{path} has a camera of the model {quoted(name)}, which is not read. Undistort the images in COLMAP "
            f"(image_undistorter), or use one of {', '.join(BY_NAME)}."
        )
    return name


def _text_cameras(path: Path) -> dict[int, _ColmapCamera]:
    cameras: dict[int, _ColmapCamera] = {}
    announced = None
    for line_number, line in text_lines(path):
        where = f"line {line_number}"
        if line.startswith("#"):
            announced = _announced(line, "cameras", announced)
            continue
        fields = line.split()
        if not fields:
            continue
        if len(fields) < 4:
            raise InputError(f"{path}: {where} has {len(fields)} fields, and a camera has 5 or more. {EXPORT_AGAIN}")
        count = len(BY_NAME[_checked_model(fields[1], path)][1])
        pixels = image_size(fields[2], fields[3], path, where)
        key = _whole(fields[0], path, where)
        _check_new(key, cameras, "camera", path)
        cameras[key] = _camera(fields[1], read_numbers(fields[4:], count, path, where), pixels)
    _check_count(announced, len(cameras), "cameras", path)
    return cameras


def _text_images(path: Path, cameras: dict[int, _ColmapCamera]) -> list[ImportedExposure]:
    """The images of a text file: two lines each, its pose, and its points, which are skipped."""
    exposures, announced, is_points = [], None, False
    for line_number, line in text_lines(path):
        if is_points:
            is_points = False
            if len(line.split()) % 3:
                raise InputError(f"{path}: line {line_number} does not hold points in threes. {EXPORT_AGAIN}")
            continue
        if line.startswith("#"):
            announced = _announced(line, "images", announced)
            continue
        fields = line.split(maxsplit=9)
        if not fields:
            continue
        where = f"line {line_number}"
        if len(fields) < 10:
            raise InputError(f"{path}: {where} has {len(fields)} fields, and an image has 10. {EXPORT_AGAIN}")
        pose = read_numbers(fields[1:8], 7, path, where)
        exposures.append(_exposure(path, fields[9].strip(), pose, _whole(fields[8], path, where), cameras))
        is_points = True
    _check_count(announced, len(exposures), "images", path)
    return exposures


def _announced(line: str, what: str, before: int | None) -> int | None:
    """The number of cameras or images that a comment of COLMAP announces; `before` for other comments."""
    match = re.match(rf"#\s*Number of {what}:\s*(\d{{1,18}})\b", line)
    return int(match[1]) if match else before


def _check_count(announced: int | None, count: int, what: str, path: Path) -> None:
    if announced is not None and announced != count:
        raise InputError(f"{path} says that it holds {announced} {what}, and it holds {count}. {EXPORT_AGAIN}")


def _check_new(key: int, cameras: dict[int, _ColmapCamera], what: str, path: Path) -> None:
    if key in cameras:
        raise InputError(f"{path} holds {what} {key} twice. {EXPORT_AGAIN}")


def _whole(text: str, path: Path, where: str) -> int:
    if not re.fullmatch(r"\d{1,18}", text):
        raise InputError(f"{path}: {where} has {quoted(text)} where a whole number belongs. {EXPORT_AGAIN}")
    return int(text)


class _BinaryReader:
    """Reads values of a little-endian binary file one after the other, and checks the length before each."""

    def __init__(self, path: Path) -> None:
        self.path, self._content, self._at = path, read_bytes(path), 0

    def values(self, form: str) -> tuple[Any, ...]:
        form = "<" + form
        self._check(struct.calcsize(form))
        values = struct.unpack_from(form, self._content, self._at)
        self._at += struct.calcsize(form)
        return values

    def name(self) -> str:
        end = self._content.find(b"\0", self._at)
        self._check((len(self._content) if end < 0 else end) - self._at + 1)
        raw, self._at = self._content[self._at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path} has a name at byte {self._at} that is not UTF-8. {EXPORT_AGAIN}") from error

    def skip(self, count: int, n_bytes: int) -> None:
        self._check(count * n_bytes)
        self._at += count * n_bytes

    def end(self) -> None:
        if self._at != len(self._content):
            raise InputError(
                f"{self.path} has {len(self._content) - self._at} bytes too many at its end. {EXPORT_AGAIN}"
            )

    def _check(self, n_bytes: int) -> None:
        if n_bytes > len(self._content) - self._at:
            raise InputError(
                f"{self.path} is truncated or damaged: at byte {self._at} it needs {n_bytes} more, and has "
                f"{len(self._content) - self._at}. {EXPORT_AGAIN}"
            )


def _binary_cameras(path: Path) -> dict[int, _ColmapCamera]:
    reader = _BinaryReader(path)
    cameras: dict[int, _ColmapCamera] = {}
    for _ in range(reader.values("Q")[0]):
        key, model, width, height = reader.values("IiQQ")
        name = _checked_model(NAME_OF.get(model, f"number {model}"), path)
        _check_new(key, cameras, "camera", path)
        values = [read_number(v, path, f"camera {key}") for v in reader.values(f"{len(BY_NAME[name][1])}d")]
        cameras[key] = _camera(name, np.array(values), image_size(width, height, path, f"camera {key}"))
    reader.end()
    return cameras


def _binary_images(path: Path, cameras: dict[int, _ColmapCamera]) -> list[ImportedExposure]:
    reader = _BinaryReader(path)
    exposures = []
    for _ in range(reader.values("Q")[0]):
        key, *pose, camera = reader.values("I7dI")
        name = reader.name()
        values = np.array([read_number(v, path, f"image {key}") for v in pose])
        exposures.append(_exposure(path, name, values, camera, cameras))
        reader.skip(reader.values("Q")[0], 24)  # x, y and the number of the point
    reader.end()
    return exposures
