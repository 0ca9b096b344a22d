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
from zlocus.products.point_cloud import LAZ_REACH_M, LAZ_STEP_M, OFFSET_STEP_M, SIGMA, VIEWS, add_crs, add_precision

# Grey values from which on points are white, in standard deviations above the mean; of 8 bits: all are shown.
WHITE_DEVIATIONS = 3.0
SOURCES = ("dsm.tif", "sigma.tif", "views.tif", "ortho.tif")


def write_surface_points(folder: Path, path: Path, strip_rows: int = STRIP_ROWS) -> int:
    """A point at the centre of each cell that has a height, from north to south and west to east; their number.

    LAS 1.4, format 7, in steps of 1 mm, with the colours of the ortho-image and two dimensions more: `sigma_m`,
    float32, the height's standard deviation (NaN where it was interpolated), and `n_images`, uint8, images used. CRS in
    the header unless the frame is local. folder : of the rasters; strip_rows : rows worked on at a time.

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
            BandReader(folder / SOURCES[0]) as heights, BandReader(folder / SOURCES[1]) as sigmas,
            BandReader(folder / SOURCES[2]) as views, BandReader(folder / SOURCES[3]) as ortho,
        ):  # fmt: skip
            check_same_grid([heights, sigmas, views, ortho])
            white = _white_level(ortho)
            with laspy.open(part, "w", header=_header(heights), do_compress=True) as laz:
                for strip in strips_of(heights.geobox.shape[0], 0, strip_rows):
                    z = heights.read(strip)
                    known = np.isfinite(z)
                    if not known.any():
                        continue
                    points = laspy.ScaleAwarePointRecord.zeros(int(known.sum()), header=laz.header)
                    points.x, points.y = _centres(heights, strip)[:, known]
                    points.z = z[known].astype(np.float64)
                    points.red, points.green, points.blue = _colours(ortho, strip, white)[:, known]
                    points.return_number[:], points.number_of_returns[:] = 1, 1
                    points[SIGMA], points[VIEWS] = sigmas.read(strip)[known], views.read(strip)[known]
                    laz.write_points(points)
                n_points = int(laz.header.point_count)
        os.replace(part, path)
    except OverflowError as error:
        raise OutputError(
            f"{path} cannot hold points that lie further apart than {LAZ_REACH_M / 1000:.0f} km. Give a smaller area, "
            "or leave laz out of --products."
        ) from error
    except (OSError, LaspyException) as error:
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
        raise OutputError(f"{path} cannot be written: {reason}. Check the folder and the space left.") from error
    finally:
        part.unlink(missing_ok=True)
    return n_points


def _header(heights: BandReader) -> laspy.LasHeader:
    """What stands before the points, the same for any run on a grid but for the day."""
    header = laspy.LasHeader(point_format=7, version="1.4")
    box = heights.geobox.extent.boundingbox
    header.scales = np.full(3, LAZ_STEP_M)
    middle = np.array([(box.left + box.right) / 2, (box.bottom + box.top) / 2, heights.statistic("MEAN") or 0.0])
    header.offsets = np.floor(middle / OFFSET_STEP_M) * OFFSET_STEP_M
    header.generating_software = f"zlocus {__version__}"
    add_precision(header, "standard deviation of height, m")
    crs = heights.crs
    if crs is not None and not is_local(crs):
        add_crs(header, crs)
    return header


def _centres(heights: BandReader, strip: Strip) -> FloatArray:
    """Easting and northing of the cells of a strip, (2, r, c) m."""
    transform, cols = heights.geobox.transform, heights.geobox.shape[1]
    x = transform.c + transform.a * (np.arange(cols) + 0.5)
    y = transform.f + transform.e * (np.arange(strip.row, strip.row + strip.rows) + 0.5)
    return np.stack(np.broadcast_arrays(x, y[:, None]))


def _white_level(ortho: BandReader) -> float:
    """The grey value that is shown white."""
    if ortho.dtype == "uint8":
        return 255.0
    mean, deviation, largest = (ortho.statistic(name) or 0.0 for name in ("MEAN", "STDDEV", "MAXIMUM"))
    return max(min(largest, mean + WHITE_DEVIATIONS * deviation), 1e-6)


def _colours(ortho: BandReader, strip: Strip, white: float) -> NDArray[np.uint16]:
    """Red, green and blue of the cells of a strip, (3, r, c), white 65535; black where the ortho-image has none."""
    bands, valid = ortho.read_bands(strip)
    rgb = bands[:3] if len(bands) >= 3 else np.repeat(bands[:1], 3, axis=0)
    share = np.clip(rgb.astype(np.float64) / white, 0.0, 1.0)
    return np.where(valid, np.rint(share * 65535.0), 0.0).astype(np.uint16)
