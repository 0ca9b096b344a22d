"""surface.laz and surface.copc.laz: the cells of a surface as coloured points."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType

import laspy
import numpy as np
from laspy.errors import LaspyException
from numpy.typing import NDArray

from zlocus import __version__
from zlocus.core.errors import OutputError
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.atomic_write import atomic_file
from zlocus.io.points.copc import StepBounds, write_copc
from zlocus.io.row_strips import STRIP_ROWS, BandReader, Strip, check_same_grid, strips_of
from zlocus.products.point_cloud import (
    LAZ_STEP_M,
    MAX_LAZ_EXTENT_M,
    OFFSET_STEP_M,
    SIGMA,
    VIEWS,
    add_crs,
    add_precision,
)

# Points are white from this many standard deviations above the mean grey value. Images of 8 bits are not stretched.
WHITE_DEVIATIONS = 3.0
SOURCES = ("dsm.tif", "sigma.tif", "views.tif", "ortho.tif")


class SurfacePoints:
    """The points of a surface: one at the centre of each cell that has a height. A context manager.

    Points are ordered from north to south and from west to east. They are of LAS 1.4, format 7, in steps of 1 mm, with
    the colours of the ortho-image and two extra dimensions: `sigma_m`, float32, the standard deviation of the height
    (NaN where it was interpolated), and `n_images`, uint8, the number of images used.

    header : of a file with these points; it has the CRS unless the frame is local.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    """

    def __init__(self, folder: Path, strip_rows: int = STRIP_ROWS) -> None:
        """folder : of the rasters; strip_rows : rows that are read at a time."""
        self._stack, self._strip_rows = ExitStack(), strip_rows
        with ExitStack() as undo:
            undo.push(self._stack)
            readers = [self._stack.enter_context(BandReader(folder / name)) for name in SOURCES]
            check_same_grid(readers)
            self._height_reader, self._sigma_reader, self._views_reader, self._ortho_reader = readers
            self.header = _header(self._height_reader)
            self._white = _white_level(self._ortho_reader)
            undo.pop_all()

    def __enter__(self) -> SurfacePoints:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def records(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield the points of some rows after others.

        Raises
        ------
        InputError
            A raster is damaged.
        OverflowError
            The points lie too far apart for a file.
        """
        for strip in strips_of(self._height_reader.geobox.shape[0], 0, self._strip_rows):
            z = self._height_reader.read(strip)
            known = np.isfinite(z)
            if not known.any():
                continue
            points = laspy.ScaleAwarePointRecord.zeros(int(known.sum()), header=self.header)
            points.x, points.y = _centres(self._height_reader, strip)[:, known]
            points.z = z[known].astype(np.float64)
            points.red, points.green, points.blue = _colours(self._ortho_reader, strip, self._white)[:, known]
            points.return_number[:], points.number_of_returns[:] = 1, 1
            points[SIGMA], points[VIEWS] = self._sigma_reader.read(strip)[known], self._views_reader.read(strip)[known]
            yield points

    def bounds(self) -> StepBounds:
        """Bounds of the points.

        Raises
        ------
        InputError
            A raster is damaged.
        OverflowError
            The points lie too far apart for a file.
        """
        corners = []
        for strip in strips_of(self._height_reader.geobox.shape[0], 0, self._strip_rows):
            z = self._height_reader.read(strip)
            known = np.isfinite(z)
            if known.any():
                places = _centres(self._height_reader, strip)[:, known]
                corners += [[*find(places, axis=1), float(find(z[known]))] for find in (np.min, np.max)]
        points = laspy.ScaleAwarePointRecord.zeros(max(len(corners), 1), header=self.header)
        if corners:
            points.x, points.y, points.z = np.transpose(corners)
        steps = np.column_stack([points.X, points.Y, points.Z]).astype(np.int64)
        return StepBounds(steps.min(axis=0), steps.max(axis=0))


def write_surface_points(folder: Path, path: Path, strip_rows: int = STRIP_ROWS) -> int:
    """Write the points of a surface as LAZ, and return their number. See `SurfacePoints`.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    OutputError
        The file cannot be written, or the points lie too far apart for it.
    """
    with (
        _refusing(path, "laz"),
        SurfacePoints(folder, strip_rows) as surface_points,
        atomic_file(path) as part,
        laspy.open(part, "w", header=surface_points.header, do_compress=True) as laz,
    ):
        for points in surface_points.records():
            laz.write_points(points)
        return int(laz.header.point_count)


def write_surface_copc(folder: Path, path: Path, strip_rows: int = STRIP_ROWS) -> int:
    """Write the points of a surface as COPC, and return their number. Arguments and errors as `write_surface_points`;
    both files have the same points, in another order."""
    with _refusing(path, "copc"), SurfacePoints(folder, strip_rows) as surface_points:
        return write_copc(
            path,
            surface_points.header,
            surface_points.bounds(),
            lambda: (points.array for points in surface_points.records()),
        )


@contextmanager
def _refusing(path: Path, product: str) -> Iterator[None]:
    """Turn errors of a file of points into sentences. product : its name in --products."""
    try:
        yield
    except OverflowError as error:
        raise OutputError(
            f"{path} cannot hold points that lie further apart than {MAX_LAZ_EXTENT_M / 1000:.0f} km. Give a smaller "
            f"area, or leave {product} out of --products."
        ) from error
    except (OSError, LaspyException) as error:
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
        raise OutputError(f"{path} cannot be written: {reason}. Check the folder and the space left.") from error


def _header(height_reader: BandReader) -> laspy.LasHeader:
    """Header of the file; runs on the same grid differ only in its date."""
    header = laspy.LasHeader(point_format=7, version="1.4")
    box = height_reader.geobox.extent.boundingbox
    header.scales = np.full(3, LAZ_STEP_M)
    middle = np.array([(box.left + box.right) / 2, (box.bottom + box.top) / 2, height_reader.statistic("MEAN") or 0.0])
    header.offsets = np.floor(middle / OFFSET_STEP_M) * OFFSET_STEP_M
    header.generating_software = f"zlocus {__version__}"
    add_precision(header, "standard deviation of height, m")
    crs = height_reader.crs
    if crs is not None and not is_local(crs):
        add_crs(header, crs)
    return header


def _centres(height_reader: BandReader, strip: Strip) -> FloatArray:
    """Easting and northing of a strip's cells, (2, r, c) m."""
    transform, cols = height_reader.geobox.transform, height_reader.geobox.shape[1]
    x = transform.c + transform.a * (np.arange(cols) + 0.5)
    y = transform.f + transform.e * (np.arange(strip.row, strip.row + strip.rows) + 0.5)
    return np.stack(np.broadcast_arrays(x, y[:, None]))


def _white_level(ortho_reader: BandReader) -> float:
    """Grey value that is shown as white."""
    if ortho_reader.dtype == "uint8":
        return 255.0
    mean, deviation, largest = (ortho_reader.statistic(name) or 0.0 for name in ("MEAN", "STDDEV", "MAXIMUM"))
    return max(min(largest, mean + WHITE_DEVIATIONS * deviation), 1e-6)


def _colours(ortho_reader: BandReader, strip: Strip, white: float) -> NDArray[np.uint16]:
    """Red, green and blue of a strip's cells, (3, r, c), white is 65535; black where the ortho-image is empty."""
    bands, valid = ortho_reader.read_bands(strip)
    rgb = bands[:3] if len(bands) >= 3 else np.repeat(bands[:1], 3, axis=0)
    share = np.clip(rgb.astype(np.float64) / white, 0.0, 1.0)
    return np.where(valid, np.rint(share * 65535.0), 0.0).astype(np.uint16)
