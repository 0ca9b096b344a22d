"""Points with known heights, such as check points or laser points, and how their files are to be understood."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_choice, check_positive, check_vertical
from zlocus.core.sensor_model import FloatArray
from zlocus.io.points.columns import ROLES
from zlocus.io.points.land_cover import LASER_NAMES, LASER_VEGETATION, OTHER_COVER, VEGETATION

# Heights beyond these stand for a missing one, whatever number a program chose for it.
MIN_HEIGHT_M, MAX_HEIGHT_M = -1e4, 1e5
NO_HEIGHT = "no height"
RETURNS = ("all", "last", "first")
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class KnownPoints:
    """Points of a file, or some of them after others.

    xyz : (n, 3) float64, finite; z in m, x and y in the units of the file's CRS, longitude first. sigma_m : (n,)
    standard deviation of z, m; sigma_xy_m : (n,) of each of x and y, m; time_s : (n,) seconds since some time;
    measured_xy : (n, 2) where the point was measured in the product, in the CRS of the file. These are NaN where they
    are not known. cover : (n,) int64, keys of the file's `cover_names`.
    """

    xyz: FloatArray
    sigma_m: FloatArray
    sigma_xy_m: FloatArray
    time_s: FloatArray
    measured_xy: FloatArray
    cover: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def of(cls, xyz: FloatArray, cover: NDArray[np.int64] | None = None) -> KnownPoints:
        """Points of which only the places, and perhaps the kind of ground, are known."""
        n, unknown = len(xyz), np.full(len(xyz), np.nan)
        return cls(
            xyz, unknown, unknown, unknown, np.full((n, 2), np.nan), np.zeros(n, int) if cover is None else cover
        )

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> KnownPoints:
        """The points that a mask or their numbers select."""
        arrays = (self.xyz, self.sigma_m, self.sigma_xy_m, self.time_s, self.measured_xy, self.cover)
        return KnownPoints(*(array[chosen] for array in arrays))  # type: ignore[arg-type]

    @classmethod
    def joined(cls, parts: list[KnownPoints]) -> KnownPoints:
        """The points of several parts after each other."""
        names = ("xyz", "sigma_m", "sigma_xy_m", "time_s", "measured_xy", "cover")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class PointFile:
    """A file of points, or several clouds.

    path : of the first file, for messages. chunks : yields the points, some after others, so that large clouds need
    little memory; it may leave out clouds that lie outside of bounds (xmin, ymin, xmax, ymax) in the CRS of the points.
    crs : CRS of the points, None where the file has none and none was given; cover_names : kind of ground of each
    number in `KnownPoints.cover`, filled as chunks are read; empty where the file knows none. is_cloud : laser points.
    left_out : number of points that were left out, by the reason, filled as chunks are read.
    """

    path: Path
    crs: CRS | None
    chunks: Callable[[Bounds | None], Iterator[KnownPoints]]
    cover_names: dict[int, str] = field(default_factory=dict)
    is_cloud: bool = False
    left_out: dict[str, int] = field(default_factory=dict)

    def leave_out(self, reason: str, n: int) -> None:
        """Count points that are left out."""
        if n:
            self.left_out[reason] = self.left_out.get(reason, 0) + n


@dataclass(frozen=True)
class PointOptions:
    """How a file of points is to be understood. `None` means: as the file says.

    crs : CRS of the points, in place of that of the file. vertical : what z is above: ellipsoid, egm96, egm2008 or the
    file of a geoid. columns : names of the columns of a table by role, see `ROLES`, as far as they are not found by
    their usual names. vegetated : kinds of ground that are vegetated; none named: the usual names. sigma_m : standard
    deviation of the heights of points that have none of their own, m. laser_classes : codes of the laser points that
    are used; none named: all but noise. returns : which returns of a pulse are used, one of `RETURNS`.

    Raises
    ------
    ConfigError
        A value out of range.
    """

    crs: str | None = None
    vertical: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    vegetated: tuple[str, ...] = ()
    sigma_m: float | None = None
    laser_classes: tuple[int, ...] = ()
    returns: str = RETURNS[0]

    def __post_init__(self) -> None:
        check_choice("returns", self.returns, RETURNS)
        check_positive("--points-sigma", self.sigma_m, "m")
        if self.vertical is not None:
            check_vertical("points-vertical", self.vertical)
        for role in self.columns:
            if role not in ROLES:
                raise ConfigError(f"--columns {role}=... is no column that is known; choose from {', '.join(ROLES)}.")
        for code in self.laser_classes:
            if not 0 <= code <= 255:
                raise ConfigError(f"--laser-classes {code} is no class of laser points. Give numbers from 0 to 255.")
        self.given_crs()

    def given_crs(self) -> CRS | None:
        """The CRS that was given in place of that of the file.

        Raises
        ------
        ConfigError
            PROJ does not know it.
        """
        if self.crs is None:
            return None
        try:
            return CRS.from_user_input(self.crs)
        except CRSError as error:
            raise ConfigError(
                f"--points-crs {self.crs} is no CRS that PROJ knows. Give one such as EPSG:25832."
            ) from error

    def is_vegetated(self, name: str, is_cloud: bool = False) -> bool:
        """Whether a kind of ground is vegetated. is_cloud : it is a class of laser points, see `laser_name`.

        Raises
        ------
        ConfigError
            Its name is not a usual one, and --vegetated does not say which ones are.
        """
        plain = name.strip().lower()
        code = plain.partition(" ")[0]
        if self.vegetated:
            return bool(
                {plain, code if code.isdecimal() else plain} & {each.strip().lower() for each in self.vegetated}
            )
        if code.isdecimal() and (is_cloud or int(code) in LASER_NAMES):
            return int(code) in LASER_VEGETATION
        if plain in VEGETATION:
            return True
        if plain in OTHER_COVER:
            return False
        raise ConfigError(
            f"The kind of ground {name!r} may be vegetated or not. Name those that are with --vegetated NAME,NAME..."
        )
