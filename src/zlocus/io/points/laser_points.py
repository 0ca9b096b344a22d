"""Laser points in LAS, LAZ and COPC files, read some after others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from laspy.errors import LaspyException
from lazrs import LazrsError
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import InputError
from zlocus.io.crs import file_crs
from zlocus.io.open_raster import existing_file
from zlocus.io.points.ground_points import (
    MAX_HEIGHT_M,
    MIN_HEIGHT_M,
    NO_HEIGHT,
    Bounds,
    KnownPoints,
    PointFile,
    PointOptions,
)
from zlocus.io.points.land_cover import LASER_NOISE, laser_name

WHAT = "cloud of points"
POINTS_AT_A_TIME = 1_000_000
NOISE, OTHER_CLASS, OTHER_RETURN = "noise or withheld", "of other classes", "other returns"
ELSEWHERE = "in clouds outside of the surface"
# What the libraries raise of a damaged file.
DAMAGE = (LaspyException, LazrsError, OSError, ValueError, IndexError, EOFError, OverflowError, MemoryError)


def laser_points(paths: Sequence[Path], options: PointOptions) -> PointFile:
    """The points of clouds with one CRS. Withheld points and noise (classes 7 and 18) are left out, and counted.

    Raises
    ------
    InputError
        The file is missing, damaged or no cloud, or PROJ does not know its CRS. Damage further behind is found, and
        said in the same way, when the points are read.
    """
    opened = [_opened(path) for path in paths]
    if not any(cloud.n_points for cloud in opened):
        raise InputError(f"The {WHAT} {paths[0]} holds no points. Give one with points.")
    given = options.given_crs()
    other = next((cloud for cloud in opened if cloud.crs != opened[0].crs), None)
    if given is None and other is not None:
        names = (_name(cloud.crs) for cloud in (opened[0], other))
        raise InputError(
            f"{paths[0]} and {other.path} have different CRS ({', '.join(names)}). Give clouds of one CRS, or say "
            "which one with --points-crs."
        )
    point_file = PointFile(
        paths[0], given or opened[0].crs, lambda bounds: _chunks(point_file, opened, options, bounds), is_cloud=True
    )
    return point_file


@dataclass(frozen=True)
class _Cloud:
    """A cloud by its header. bounds : xmin, ymin, xmax, ymax of its points."""

    path: Path
    n_points: int
    crs: CRS | None
    bounds: Bounds


def _opened(path: Path) -> _Cloud:
    existing_file(path, WHAT)
    try:
        with laspy.open(path) as reader:
            header = reader.header
            (xmin, ymin), (xmax, ymax) = (map(float, ends[:2]) for ends in (header.mins, header.maxs))
            bounds = xmin, ymin, xmax, ymax
            return _Cloud(path, header.point_count, _declared_crs(path, header), bounds)
    except DAMAGE as error:
        raise _damaged(path, error) from error


def _name(crs: CRS | None) -> str:
    return "none" if crs is None else crs.name


def _declared_crs(path: Path, header: laspy.LasHeader) -> CRS | None:
    try:
        declared = header.parse_crs()
    except (CRSError, LaspyException, ValueError) as error:
        raise InputError(
            f"{path} has a CRS that PROJ does not know. Give it with --points-crs, such as EPSG:25832."
        ) from error
    return None if declared is None else file_crs(declared, path)


def _chunks(
    point_file: PointFile, clouds: Sequence[_Cloud], options: PointOptions, bounds: Bounds | None
) -> Iterator[KnownPoints]:
    """The points of clouds, as far as the clouds lie in the bounds by their headers."""
    point_file.left_out.clear()
    for cloud in clouds:
        if bounds is not None and not _overlap(cloud.bounds, bounds):
            point_file.leave_out(ELSEWHERE, cloud.n_points)
            continue
        n_read = 0
        try:
            with laspy.open(cloud.path) as reader:
                for record in reader.chunk_iterator(POINTS_AT_A_TIME):
                    n_read += len(record)
                    if len(points := _points(record, point_file, cloud.path, options)):
                        yield points
        except DAMAGE as error:
            raise _damaged(cloud.path, error) from error
        if n_read != cloud.n_points:
            raise InputError(
                f"{cloud.path} is truncated: it says that it has {cloud.n_points} points, and holds {n_read}. Copy it "
                "again from its source."
            )


def _overlap(one: Bounds, other: Bounds) -> bool:
    return one[0] <= other[2] and one[2] >= other[0] and one[1] <= other[3] and one[3] >= other[1]


def _points(
    record: laspy.ScaleAwarePointRecord, point_file: PointFile, path: Path, options: PointOptions
) -> KnownPoints:
    """The points of a record that are used."""
    chosen, codes = _chosen(record, point_file, options), np.asarray(record.classification, np.int64)
    xyz = np.column_stack([np.asarray(axis, np.float64)[chosen] for axis in (record.x, record.y, record.z)])
    for code in np.unique(codes[chosen]):
        point_file.cover_names[int(code)] = laser_name(int(code))
    if not np.isfinite(xyz).all():
        raise InputError(f"{path} is damaged: it has points without a place. Copy it again from its source.")
    has_height = (xyz[:, 2] > MIN_HEIGHT_M) & (xyz[:, 2] < MAX_HEIGHT_M)
    point_file.leave_out(NO_HEIGHT, int(np.count_nonzero(~has_height)))
    return KnownPoints.of(xyz[has_height], codes[chosen][has_height])


def _chosen(record: laspy.ScaleAwarePointRecord, point_file: PointFile, options: PointOptions) -> NDArray[np.bool_]:
    """Which points (n,) are used; the others are counted."""
    codes = np.asarray(record.classification)
    chosen = np.asarray(record.withheld) == 0
    if not options.laser_classes:
        chosen &= ~np.isin(codes, LASER_NOISE)
    point_file.leave_out(NOISE, int(np.count_nonzero(~chosen)))
    if options.laser_classes:
        of_class = chosen & np.isin(codes, options.laser_classes)
        point_file.leave_out(OTHER_CLASS, int(np.count_nonzero(chosen & ~of_class)))
        chosen = of_class
    if options.returns != "all":
        number = np.asarray(record.return_number)
        wanted = np.asarray(record.number_of_returns) if options.returns == "last" else 1
        of_return = chosen & (number == wanted)
        point_file.leave_out(OTHER_RETURN, int(np.count_nonzero(chosen & ~of_return)))
        chosen = of_return
    return np.asarray(chosen)


def _damaged(path: Path, error: Exception) -> InputError:
    reason = (getattr(error, "strerror", None) or " ".join(str(error).split()))[:200].rstrip(".") or type(
        error
    ).__name__
    return InputError(
        f"{path} cannot be read as a {WHAT}: {reason}. It is damaged or no LAS or LAZ file; copy it again from its "
        "source."
    )
