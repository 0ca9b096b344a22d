"""Vertical datums: the ellipsoid, which all of zlocus works with, or a geoid, which files may use.

A height H above a geoid and the ellipsoidal height h of the same point differ by the undulation N of the geoid there:
h = H + N. N is always read from a raster. PROJ is not used for this, because it may return a height unchanged when the
grid of a conversion is missing.
"""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.geoid import GeoidRaster

Float = TypeVar("Float", np.float32, np.float64)
ELLIPSOID = "ellipsoid"
# Number of points along each side of an area at which the undulation is checked.
MIN_POINTS_PER_SIDE, MAX_POINTS_PER_SIDE = 9, 513


@dataclass(frozen=True)
class KnownGeoid:
    """A geoid for which PROJ has grids.

    title : its name in texts; epsg : code of the vertical CRS; datum : name of the vertical datum in a CRS; grids :
    file names of its grids, the current ones first; packages : where proj-data has one of them, in words.
    """

    title: str
    epsg: int
    datum: str
    grids: tuple[str, ...]
    packages: str


KNOWN_GEOIDS = {
    "egm96": KnownGeoid(
        "EGM96", 5773, "EGM96 geoid", ("us_nga_egm96_15.tif", "egm96_15.gtx"), "of Debian or conda-forge"
    ),
    "egm2008": KnownGeoid(
        "EGM2008", 3855, "EGM2008 geoid", ("us_nga_egm08_25.tif", "egm08_25.gtx"), "of conda-forge (not Debian's)"
    ),
}


@dataclass(frozen=True)
class VerticalDatum:
    """The surface from which heights are counted.

    name : ellipsoid, egm96, egm2008, or the path of a geoid raster; geoid : undulations, None for the ellipsoid; crs :
    vertical CRS, None for the ellipsoid.
    """

    name: str
    geoid: GeoidRaster | None = None
    crs: CRS | None = None

    @property
    def surface_name(self) -> str:
        """The surface in words, for descriptions: "the ellipsoid", "the EGM96 geoid"."""
        if self.geoid is None:
            return "the ellipsoid"
        return (
            f"the {KNOWN_GEOIDS[self.name].title} geoid"
            if self.name in KNOWN_GEOIDS
            else f"the geoid of {self.geoid.path.name}"
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that its heights depend on: the geoid raster, none for the ellipsoid."""
        return () if self.geoid is None else (self.geoid.path,)

    def undulation(self, xy: FloatArray, crs: CRS) -> FloatArray:
        """Height (n,) m of the datum's surface above the ellipsoid at points (n, 2); see `GeoidRaster.undulation`."""
        return np.zeros(len(xy)) if self.geoid is None else self.geoid.undulation(xy, crs)

    def points_from_ellipsoidal(self, xyz: FloatArray, crs: CRS) -> FloatArray:
        """Points (n, 3) m with heights in this datum, from points with ellipsoidal heights; NaN where it has no value.

        crs : CRS of x and y.
        """
        if self.geoid is None:
            return xyz
        return np.column_stack([xyz[:, :2], xyz[:, 2] - self.geoid.known_undulation(xyz[:, :2], crs)])

    def heights_from_ellipsoidal(
        self, ellipsoidal: NDArray[np.float32], geobox: GeoBox, row: int = 0, col: int = 0
    ) -> NDArray[np.float32]:
        """Heights (r, c) float32 m in this datum at cell centres, from their ellipsoidal heights.

        ellipsoidal : (r, c) m, NaN where there is no height; its first cell is cell (row, col) of the grid. The result
        of a cell does not depend on the other cells of the call.
        """
        return self._cells(ellipsoidal, geobox, row, col, -1.0)

    def ellipsoidal_from_heights(self, heights: NDArray[Float], geobox: GeoBox) -> NDArray[Float]:
        """Ellipsoidal heights (r, c) m at cell centres, from heights in this datum; the whole grid."""
        return self._cells(heights, geobox, 0, 0, 1.0)

    def _cells(self, heights: NDArray[Float], geobox: GeoBox, row: int, col: int, sign: float) -> NDArray[Float]:
        if self.geoid is None:
            return heights
        known = np.isfinite(heights)
        rows, cols = np.nonzero(known)
        a, b, c, d, e, f = geobox.transform[:6]
        across, down = cols + (col + 0.5), rows + (row + 0.5)
        xy = np.column_stack([a * across + b * down + c, d * across + e * down + f])
        out = heights.copy()
        out[known] = heights[known] + sign * self.undulation(xy, grid_crs(geobox))
        return out

    def check_covers(self, bounds: tuple[float, float, float, float], crs: CRS) -> None:
        """Check that the geoid has a value everywhere in an area.

        bounds : xmin, ymin, xmax, ymax in a projected CRS, m. The points checked are half the posts' spacing apart, but
        at most `MAX_POINTS_PER_SIDE` along each side.

        Raises
        ------
        InputError
            See `GeoidRaster.undulation`.
        """
        self.undulation_range(bounds, crs)

    def undulation_range(self, bounds: tuple[float, float, float, float], crs: CRS) -> tuple[float, float]:
        """Lowest and highest undulation in an area, m; see `check_covers`."""
        if self.geoid is None:
            return 0.0, 0.0
        xmin, ymin, xmax, ymax = bounds
        middle = np.array([(xmin + xmax) / 2, (ymin + ymax) / 2])
        step = self.geoid.spacing_m(middle, crs) / 2
        n_x, n_y = (
            int(np.clip(np.ceil(size / step) + 1, MIN_POINTS_PER_SIDE, MAX_POINTS_PER_SIDE))
            if np.isfinite(step)
            else MIN_POINTS_PER_SIDE
            for size in (xmax - xmin, ymax - ymin)
        )
        x, y = np.meshgrid(np.linspace(xmin, xmax, n_x), np.linspace(ymin, ymax, n_y))
        undulation = self.undulation(np.column_stack([x.ravel(), y.ravel()]), crs)
        return float(undulation.min()), float(undulation.max())

    def compound_crs(self, horizontal: CRS) -> CRS:
        """The compound CRS of a map and this datum; for the ellipsoid the horizontal CRS alone.

        GeoTIFF has no projected CRS with ellipsoidal heights. GDAL (3.10) writes such a CRS into a file beside the
        raster, and the raster itself then has no CRS.
        """
        if self.crs is None:
            return horizontal
        flat = horizontal.to_2d()
        parts = CompoundCRS(name=f"{flat.name} + {self.crs.name}", components=[flat, self.crs])
        return CRS.from_wkt(parts.to_wkt())

    def compound_geobox(self, geobox: GeoBox) -> GeoBox:
        """The same grid with the compound CRS of the map and this datum."""
        if self.crs is None:
            return geobox
        return GeoBox(geobox.shape, geobox.transform, self.compound_crs(grid_crs(geobox)))

    def as_dict(self) -> dict[str, Any]:
        """The entry of run.json."""
        record: dict[str, Any] = {"heights_above": self.surface_name}
        if self.crs is not None and self.geoid is not None:
            code = self.crs.to_epsg()
            record |= {"crs": self.crs.name if code is None else f"EPSG:{code}", "geoid": str(self.geoid.path)}
        return record


ELLIPSOIDAL = VerticalDatum(ELLIPSOID)
# Band description of a surface with ellipsoidal heights, which its CRS cannot express.
ELLIPSOIDAL_DESCRIPTION = f"height above {ELLIPSOIDAL.surface_name}"


def named_vertical_datum(given: str, option: str = "--vertical") -> VerticalDatum:
    """The vertical datum that `given` names: ellipsoid, egm96, egm2008 (in any case), or the path of a geoid raster.

    option : the option of the command line that gave it, for messages.

    Raises
    ------
    ConfigError
        PROJ's grid of the geoid is not installed.
    InputError
        The file is not a geoid; see `GeoidRaster.open`.
    """
    name = given.lower()
    if name == ELLIPSOID:
        return ELLIPSOIDAL
    if name in KNOWN_GEOIDS:
        return _installed(name, f"{option} {given}", f"{option} FILE")
    geoid = GeoidRaster.open(Path(given))
    return VerticalDatum(given, geoid, _named(geoid.path))


def declared_vertical_datum(crs: CRS, path: Path, option: str) -> VerticalDatum:
    """The vertical datum that the CRS of a file declares; the ellipsoid where the CRS has no vertical part.

    option : the option of the command line that can override it, for messages.

    Raises
    ------
    InputError
        zlocus has no geoid for the declared datum.
    ConfigError
        PROJ's grid of the geoid is not installed.
    """
    vertical = vertical_part(crs)
    if vertical is None:
        return ELLIPSOIDAL
    for name, known in KNOWN_GEOIDS.items():
        if vertical.datum is not None and vertical.datum.name == known.datum:
            return _installed(name, f"{path} has {known.title} heights by its CRS, which", f"{option} FILE")
    raise InputError(
        f"{path} has heights in a vertical datum that zlocus has no geoid for ({vertical.name}, by its CRS). Give its "
        f"geoid with {option} FILE, or {option} ellipsoid if they are ellipsoidal."
    )


def check_heights(crs: CRS, path: Path) -> None:
    """Check that the heights of a file are in metres and upwards, by its CRS.

    Raises
    ------
    InputError
        They are not.
    """
    vertical = vertical_part(crs)
    axis = vertical.axis_info[0] if vertical is not None else crs.axis_info[2] if len(crs.axis_info) > 2 else None
    if axis is None:
        return
    if abs(axis.unit_conversion_factor - 1.0) > 1e-9:
        raise InputError(f"The heights of {path} are in {axis.unit_name}. Convert them to metres.")
    if axis.direction.lower() != "up":
        raise InputError(f"The heights of {path} go {axis.direction}, by its CRS. Convert them to heights that go up.")


def vertical_part(crs: CRS) -> CRS | None:
    """The vertical part of a compound CRS; None for other CRSs."""
    return next((part for part in crs.sub_crs_list if part.is_vertical), None)


def grid_crs(geobox: GeoBox) -> CRS:
    """The CRS of the grid of a run."""
    assert geobox.crs is not None, "the grid of a run has a CRS"
    return CRS.from_user_input(geobox.crs.proj)


def proj_folders() -> list[Path]:
    """Folders in which grids of PROJ may be installed: those of pyproj, the environment and the system's packages."""
    named = [get_data_dir(), os.environ.get("PROJ_DATA", ""), os.environ.get("PROJ_LIB", "")]
    listed = [Path(part) for names in named for part in names.split(os.pathsep) if part]
    shares = [Path(prefix) / "share" / "proj" for prefix in (sys.prefix, "/usr/local", "/usr")]
    return list(dict.fromkeys([Path(get_user_data_dir()), *listed, *shares]))


def _installed(name: str, who: str, instead: str) -> VerticalDatum:
    """The datum of a geoid whose grid PROJ has on this machine. Nothing is downloaded."""
    known = KNOWN_GEOIDS[name]
    folders = proj_folders()
    for grid in known.grids:
        for folder in folders:
            if (folder / grid).is_file():
                return VerticalDatum(name, GeoidRaster.open(folder / grid), CRS.from_epsg(known.epsg))
    raise ConfigError(
        f"{who} needs PROJ's grid {known.grids[0]}, which is not in {', '.join(map(str, folders))}. Get it with "
        f"`pyproj sync --file {known.grids[0]}` or the package proj-data {known.packages}, or give a geoid raster with "
        f"{instead}."
    )


def _named(path: Path) -> CRS:
    """A vertical CRS for the geoid of a file, named after the file as far as GeoTIFF can store the name."""
    name = re.sub(r"[^\w .()+-]", "_", path.name, flags=re.ASCII)
    axis = {"name": "Gravity-related height", "abbreviation": "H", "direction": "up", "unit": "metre"}
    return CRS.from_json_dict(
        {
            "type": "VerticalCRS",
            "name": f"height above the geoid of {name}",
            "datum": {"type": "VerticalReferenceFrame", "name": f"geoid of {name}"},
            "coordinate_system": {"subtype": "vertical", "axis": [axis]},
        }
    )
