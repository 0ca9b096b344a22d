"""Products of image space: a height map per image, and all points as LAZ, PLY and COPC."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import laspy
import numpy as np
from affine import Affine
from laspy.errors import LaspyException
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning

from zlocus import __version__
from zlocus.core.errors import OutputError
from zlocus.core.scene import is_local
from zlocus.io.points.copc import StepBounds, write_copc
from zlocus.io.rasters import RasterBands, RasterSink

LAZ_STEP_M = 0.001
# Extra dimensions of the points. Their descriptions have at most 32 characters.
SIGMA, VIEWS = "sigma_m", "n_images"
MAX_LAZ_EXTENT_M = 2**31 * LAZ_STEP_M
OFFSET_STEP_M = 1000.0
POINTS_AT_A_TIME = 1_000_000
PLY_POINT = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
PLY_DIGITS = 19  # of the number of points, at most
PLY_PROPERTIES = ("double x", "double y", "double z", "uchar red", "uchar green", "uchar blue")


class PointCloud:
    """Writer of cloud.laz and cloud.ply. Points go into files with temporary names at once, so none are kept in memory;
    the files get their own names when the context ends without an error.

    crs : of the scene; n_points : number of the points that were written so far.
    """

    def __init__(self, folder: Path, crs: CRS) -> None:
        self._paths = (folder / "cloud.laz", folder / "cloud.ply")
        self._parts = tuple(path.with_name(f".{path.name}.{os.getpid()}.part") for path in self._paths)
        self._crs = None if is_local(crs) else crs
        self._laz: laspy.LasWriter | None = None
        self._ply: BinaryIO | None = None
        self.n_points = 0

    def write(
        self,
        source: int,
        xyz: NDArray[np.float64],
        rgb: NDArray[np.uint16],
        sigma_m: NDArray[np.floating],
        n_images: NDArray[np.uint8],
    ) -> None:
        """Add points.

        source : number of their image; xyz : (n, 3) m; rgb : (n, 3), white is 65535; sigma_m : (n,) m, standard
        deviation; n_images : (n,), number of images used.
        """
        try:
            laz, ply = self._files(xyz)
            points = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=laz.header)
            points.x, points.y, points.z = xyz.T
            points.red, points.green, points.blue = rgb.T
            points.return_number[:], points.number_of_returns[:] = 1, 1
            points.point_source_id[:] = source
            points[SIGMA], points[VIEWS] = sigma_m, n_images
            laz.write_points(points)
            records = np.empty(len(xyz), PLY_POINT)
            records["xyz"], records["rgb"] = xyz, rgb >> 8
            ply.write(records.tobytes())
            self.n_points += len(xyz)
        except OverflowError as error:
            raise OutputError(
                f"{self._paths[0]} cannot hold points that lie further apart than {MAX_LAZ_EXTENT_M / 1000:.0f} km. "
                "Give narrower --heights."
            ) from error
        except (OSError, LaspyException) as error:
            raise self._failed(error) from error

    def _files(self, xyz: NDArray[np.float64]) -> tuple[laspy.LasWriter, BinaryIO]:
        """Both files; they are opened with the first points, which give the offset of the coordinates."""
        if self._laz is None or self._ply is None:
            header = laspy.LasHeader(point_format=7, version="1.4")
            header.scales = np.full(3, LAZ_STEP_M)
            header.offsets = np.floor(xyz.mean(axis=0) / OFFSET_STEP_M) * OFFSET_STEP_M if len(xyz) else np.zeros(3)
            header.generating_software = f"zlocus {__version__}"
            add_precision(header, "standard deviation along ray, m")
            if self._crs is not None:
                add_crs(header, self._crs)
            self._laz = laspy.open(self._parts[0], "w", header=header, do_compress=True)
            self._ply = self._parts[1].open("wb")
            self._ply.write(ply_header(0, self._crs).encode("ascii"))
        return self._laz, self._ply

    def __enter__(self) -> PointCloud:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                ply = self._files(np.empty((0, 3)))[1]
                ply.seek(0)
                ply.write(ply_header(self.n_points, self._crs).encode("ascii"))
            for file in (self._laz, self._ply):
                if file is not None:
                    file.close()
            if kind is None:
                for part, path in zip(self._parts, self._paths, strict=True):
                    os.replace(part, path)
        except (OSError, LaspyException) as cause:
            raise self._failed(cause) from cause
        finally:
            for part in self._parts:
                with suppress(OSError):  # where it was not begun, or has its name
                    part.unlink()

    def _failed(self, error: Exception) -> OutputError:
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
        return OutputError(f"{self._paths[0]} cannot be written: {reason}. Check the folder and the space left.")


def write_cloud_copc(folder: Path) -> int:
    """Write cloud.copc.laz from the points of cloud.laz in a folder, and return their number.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    path = folder / "cloud.laz"

    def batches() -> Iterator[NDArray[Any]]:
        with laspy.open(path) as laz:
            for points in laz.chunk_iterator(POINTS_AT_A_TIME):
                yield points.array

    with laspy.open(path) as laz:
        header = laz.header
    low, high = (
        np.rint((np.asarray(ends) - header.offsets) / header.scales).astype(np.int64)
        for ends in (header.mins, header.maxs)
    )
    return write_copc(folder / "cloud.copc.laz", header, StepBounds(low, high), batches)


def add_precision(header: laspy.LasHeader, of: str) -> None:
    """Add dimensions for a standard deviation and a number of images. of : description of the former, 32 characters."""
    header.add_extra_dims([
        laspy.ExtraBytesParams(SIGMA, np.float32, of),
        laspy.ExtraBytesParams(VIEWS, np.uint8, "images used"),
    ])  # fmt: skip


def add_crs(header: laspy.LasHeader, crs: CRS) -> None:
    """Write a CRS to a header as LAS 1.4 requires: WKT of OGC 01-009, which is WKT 1 (laspy writes WKT 2)."""
    header.vlrs.append(WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")))
    header.global_encoding.wkt = True


def ply_header(n_points: int, crs: CRS | None) -> str:
    """Header of a binary PLY file. It has the same length for every number of points, because the number is known only
    after the points were written."""
    lines = ["ply", "format binary_little_endian 1.0", f"comment zlocus {__version__}"]
    if crs is not None:
        lines.append(f"comment crs {_plain(crs)}")
    filler = "comment" + " " * (PLY_DIGITS - len(str(n_points)))
    lines += [f"element vertex {n_points}", *(f"property {name}" for name in PLY_PROPERTIES), filler, "end_header", ""]
    return "\n".join(lines)


def _plain(crs: CRS) -> str:
    """A CRS in one line of ASCII: its code, the codes of its horizontal and vertical parts, or WKT."""
    codes = [part.to_epsg() for part in crs.sub_crs_list or [crs]]
    if None not in codes:
        return "EPSG:" + "+".join(map(str, codes))
    return crs.to_wkt().encode("ascii", "replace").decode("ascii")


def write_map(
    path: Path, shape: tuple[int, int], rows: Iterable[NDArray[np.generic]], description: str, units: str = ""
) -> None:
    """Write values of an image's pixels as a raster without a place on the ground; NaN in floats is no data.

    shape : of the image; rows : values (r, c) of all its rows, some rows after others, of one type.
    """
    parts = iter(rows)
    first = next(parts)
    nodata = float("nan") if first.dtype.kind == "f" else None
    bands = RasterBands(first.dtype, nodata, (description,), units)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with RasterSink(path, GeoBox(shape, Affine.identity(), None), bands) as sink:
            row = 0
            for values in chain([first], parts):
                sink.write(row, 0, values)
                row += len(values)


def file_names(names: Sequence[str]) -> list[str]:
    """Names for files of views: without characters that files may not have, and all different."""
    unique: list[str] = []
    for name in names:
        plain = re.sub(r"[^\w.-]+", "_", name).strip(".") or "view"
        tried = (plain if k == 1 else f"{plain}_{k}" for k in count(1))
        unique.append(next(new for new in tried if new.casefold() not in {old.casefold() for old in unique}))
    return unique
