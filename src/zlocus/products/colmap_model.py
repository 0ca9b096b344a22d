"""Write a text model of COLMAP: `cameras.txt`, `images.txt` and `points3D.txt`.

Axes: those of the camera are right, down, forwards, as in zlocus. Pixels: COLMAP's (0.5, 0.5) is the centre of the
first pixel, so half a pixel is added to positions. Source: COLMAP's documentation, "Output format" and "Camera models".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from zlocus.core.sensor_model import FloatArray
from zlocus.io.importers.colmap import ORIGIN_PX
from zlocus.products.exported_images import ExportedView
from zlocus.products.exported_points import ExportedPoints
from zlocus.sensors.distortion import BrownDistortion, FisheyeDistortion
from zlocus.sensors.frame import FrameModel

MODEL = Path("sparse") / "0"


def can_be_said(sensor: FrameModel) -> bool:
    """Whether COLMAP has a camera model for the lens and the skew of a frame camera: it has none with skew."""
    return sensor.skew == 0.0 and isinstance(sensor.distortion, BrownDistortion | FisheyeDistortion | None)


def write_model(folder: Path, exported_views: Sequence[ExportedView], exported_points: ExportedPoints | None) -> None:
    """Write the model into `sparse/0` of a folder. Views with equal cameras and images of one size share a camera."""
    (folder / MODEL).mkdir(parents=True)
    cameras: dict[str, int] = {}
    numbers = [cameras.setdefault(camera_words(each), len(cameras) + 1) for each in exported_views]
    _write(folder / MODEL / "cameras.txt", (f"{number} {words}" for words, number in cameras.items()),
           f"# Number of cameras: {len(cameras)}")  # fmt: skip
    _write(folder / MODEL / "images.txt", _images(exported_views, numbers, exported_points),
           f"# Number of images: {len(exported_views)}")  # fmt: skip
    n_points = 0 if exported_points is None else len(exported_points)
    points = iter(()) if exported_points is None else _points(exported_points)
    _write(folder / MODEL / "points3D.txt", points, f"# Number of points: {n_points}")


def camera_words(exported: ExportedView) -> str:
    """Model, size and parameters of a camera, as a line of `cameras.txt` has them after its number."""
    sensor, (rows, cols) = exported.sensor, exported.shape
    column, row = (value + ORIGIN_PX for value in sensor.principal_point)
    values = [sensor.focal, sensor.focal * sensor.aspect, column, row]
    lens, name = sensor.distortion, "PINHOLE"
    if isinstance(lens, BrownDistortion):
        values += [lens.k1, lens.k2, lens.p1, lens.p2]
        name = "OPENCV"
        if lens.k3 or lens.k4 or lens.k5 or lens.k6:
            values += [lens.k3, lens.k4, lens.k5, lens.k6]
            name = "FULL_OPENCV"
    elif isinstance(lens, FisheyeDistortion):
        values += [lens.k1, lens.k2, lens.k3, lens.k4]
        name = "OPENCV_FISHEYE"
    return f"{name} {cols} {rows} {_numbers(values)}"


def quaternion(rotation: FloatArray) -> FloatArray:
    """Quaternion (4,) of a rotation (3, 3), the scalar first and not negative."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z]) * (-1.0 if w < 0 else 1.0)


def _images(
    exported_views: Sequence[ExportedView], numbers: Sequence[int], exported_points: ExportedPoints | None
) -> Iterator[str]:
    """Two lines of each image: its pose, camera and name; and the points that it shows."""
    seen = None if exported_points is None else exported_points.observations
    for k, (exported, camera) in enumerate(zip(exported_views, numbers, strict=True)):
        sensor = exported.sensor
        pose = [*quaternion(sensor.rotation), *(-sensor.rotation @ np.array(sensor.centre))]
        yield f"{k + 1} {_numbers(pose)} {camera} {exported.file}"
        if seen is None:
            yield ""
            continue
        mine = np.flatnonzero(seen.view == k)
        positions = (seen.xy[mine] + ORIGIN_PX).tolist()
        points = (seen.point[mine] + 1).tolist()
        yield " ".join(f"{x:.4f} {y:.4f} {point}" for (x, y), point in zip(positions, points, strict=True))


def _points(exported_points: ExportedPoints) -> Iterator[str]:
    """A line of each point: number, place, colour, error, and the images that show it with its place among theirs."""
    seen = exported_points.observations
    # The place of an observation among those of its image, in the order of `_images`.
    order = np.argsort(seen.view, kind="stable")
    place = np.empty(len(seen), np.int64)
    first = np.searchsorted(seen.view[order], seen.view)
    place[order] = np.arange(len(seen)) - first[order]
    by_point = np.argsort(seen.point, kind="stable")
    ends = np.searchsorted(seen.point[by_point], np.arange(len(exported_points) + 1))
    for k, xyz in enumerate(exported_points.xyz.tolist()):
        rows = by_point[ends[k] : ends[k + 1]]
        track = " ".join(f"{view + 1} {at}" for view, at in zip(seen.view[rows], place[rows], strict=True))
        colour = " ".join(map(str, exported_points.rgb[k].tolist()))
        yield f"{k + 1} {_numbers(xyz)} {colour} {exported_points.error_px[k]:.4f} {track}"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _write(path: Path, lines: Iterator[str], heading: str) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(heading + "\n")
        file.writelines(line + "\n" for line in lines)
