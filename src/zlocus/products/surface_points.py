"""surface.laz: the cells of a surface as coloured points."""

from __future__ import annotations

import os
from pathlib import Path

import laspy
import numpy as np
from laspy.errors import LaspyException
from numpy.typing import NDArray

from zlocus import __version__
from zlocus.core.errors import OutputError
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray
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


def write_surface_points(folder: Path, path: Path, strip_rows: int = STRIP_ROWS) -> int:
    """Write a point at the centre of each cell that has a height, and return their number.

    Points are ordered from north to south and from west to east. The file is LAS 1.4, format 7, in steps of 1 mm, with
    the colours of the ortho-image and two extra dimensions: `sigma_m`, float32, the standard deviation of the height
    (NaN where it was interpolated), and `n_images`, uint8, the number of images used. The header has the CRS unless the
    frame is local. folder : of the rasters; strip_rows : rows that are processed at a time.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    OutputError
        The file cannot be written, or the points lie too far apart for it.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with (
            BandReader(folder / SOURCES[0]) as height_reader, BandReader(folder / SOURCES[1]) as sigma_reader,
            BandReader(folder / SOURCES[2]) as views_reader, BandReader(folder / SOURCES[3]) as ortho_reader,
        ):  # fmt: skip
            check_same_grid([height_reader, sigma_reader, views_reader, ortho_reader])
            white = _white_level(ortho_reader)
            with laspy.open(part, "w", header=_header(height_reader), do_compress=True) as laz:
                for strip in strips_of(height_reader.geobox.shape[0], 0, strip_rows):
                    z = height_reader.read(strip)
                    known = np.isfinite(z)
                    if not known.any():
                        continue
                    points = laspy.ScaleAwarePointRecord.zeros(int(known.sum()), header=laz.header)
                    points.x, points.y = _centres(height_reader, strip)[:, known]
                    points.z = z[known].astype(np.float64)
                    points.red, points.green, points.blue = _colours(ortho_reader, strip, white)[:, known]
                    points.return_number[:], points.number_of_returns[:] = 1, 1
                    points[SIGMA], points[VIEWS] = sigma_reader.read(strip)[known], views_reader.read(strip)[known]
                    laz.write_points(points)
                n_points = int(laz.header.point_count)
        os.replace(part, path)
    except OverflowError as error:
        raise OutputError(
            f"{path} cannot hold points that lie further apart than {MAX_LAZ_EXTENT_M / 1000:.0f} km. Give a smaller "
            "area, or leave laz out of --products."
        ) from error
    except (OSError, LaspyException) as error:
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
        raise OutputError(f"{path} cannot be written: {reason}. Check the folder and the space left.") from error
    finally:
        part.unlink(missing_ok=True)
    return n_points


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
