"""Bring a surface and its reference to one vertical datum, or refuse to compare them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import ConfigError, InputError
from zlocus.evaluation.heights import HeightRaster
from zlocus.io.vertical import (
    ELLIPSOID,
    ELLIPSOIDAL_DESCRIPTION,
    VerticalDatum,
    check_heights,
    named_vertical_datum,
    vertical_part,
)


@dataclass(frozen=True)
class Compared:
    """A surface and a reference with one vertical datum.

    datums : vertical datums of surface and reference as their files state them, None where a file states none.
    converted : path of the one to whose heights the geoid's were added, None for neither.
    """

    surface: HeightRaster
    reference: HeightRaster
    datums: tuple[str | None, str | None]
    converted: Path | None = None

    @property
    def assumed(self) -> str | None:
        """What had to be assumed about a vertical datum, as a sentence; None where nothing was."""
        mine, theirs = self.datums
        if self.converted is not None or (mine is None) == (theirs is None):
            return None
        silent, datum = (self.reference, mine) if theirs is None else (self.surface, theirs)
        return f"{silent.path} does not state its vertical datum: taken to be {above(datum)}, as of the other raster"


def same_heights(surface: HeightRaster, reference: HeightRaster, geoid: Path | None) -> Compared:
    """Bring surface and reference to one vertical datum.

    geoid : raster of geoid heights above the ellipsoid, m, or its name; None: no conversion. They are added to the
    raster whose CRS has a geoid as vertical datum, or, where no CRS states one, to the reference.

    Raises
    ------
    InputError
        The vertical datums differ and no suitable geoid is given, heights are not in metres, or the geoid raster does
        not cover them.
    ConfigError
        A geoid is given although both have the same vertical datum.
    """
    datums = datum_of(surface), datum_of(reference)
    converted = above_geoid((surface.path, reference.path), datums, geoid)
    if geoid is None or converted is None:
        return Compared(surface, reference, datums)
    if converted == surface.path:
        return Compared(_raised(surface, geoid), reference, datums, converted)
    return Compared(surface, _raised(reference, geoid), datums, converted)


def above_geoid(paths: tuple[Path, Path], datums: tuple[str | None, str | None], geoid: Path | None) -> Path | None:
    """The one of a surface and a reference to whose heights those of the geoid are to be added; None for neither.

    paths : of both, for messages. datums : their vertical datums, see `Compared`.

    Raises
    ------
    InputError, ConfigError
        See `same_heights`.
    """
    surface, reference = paths
    mine, theirs = datums
    if geoid is None:
        if mine is not None and theirs is not None and mine != theirs:
            raise InputError(
                f"The heights of {surface} are above {above(mine)} and those of {reference} above {above(theirs)}. Add "
                "the geoid's heights with --geoid RASTER, or convert one of them (gdalwarp -t_srs)."
            )
        return None
    if mine is not None and mine == theirs:
        raise ConfigError(
            f"--geoid {geoid} is not needed: the heights of {surface} and {reference} are both above {above(mine)}. "
            "Leave it out."
        )
    if mine not in (None, ELLIPSOID) and theirs not in (None, ELLIPSOID):
        raise InputError(
            f"The heights of {surface} are above {mine} and those of {reference} above {theirs}: one geoid "
            "is not enough. Convert one of them to the ellipsoid first (gdalwarp -t_srs)."
        )
    return surface if theirs == ELLIPSOID or mine not in (None, ELLIPSOID) else reference


def datum_of(raster: HeightRaster) -> str | None:
    """Vertical datum that a file states: `ELLIPSOID`, the name of a vertical CRS, or None.

    Raises
    ------
    InputError
        Heights are not in metres, or count downwards.
    """
    return stated_datum(raster.spatial, raster.path, raster.description)


def stated_datum(crs: CRS | None, path: Path, description: str = "") -> str | None:
    """Vertical datum that a CRS, or else the description of a band, states; see `datum_of`. path : for messages."""
    if crs is not None:
        check_heights(crs, path)
        vertical = vertical_part(crs)
        if vertical is not None:
            # A geoid raster's datum carries the name of its file, which may contain any word.
            is_ellipsoid = ELLIPSOID in vertical.name.lower() and "geoid" not in vertical.name.lower()
            return ELLIPSOID if is_ellipsoid else vertical.name
        if len(crs.axis_info) == 3 and (crs.is_geographic or crs.is_projected):
            return ELLIPSOID
    return ELLIPSOID if description == ELLIPSOIDAL_DESCRIPTION else None


def above(datum: str | None) -> str:
    """The vertical datum of heights as a sentence names it. datum : see `datum_of`."""
    return f"the {ELLIPSOID}" if datum == ELLIPSOID else str(datum).removeprefix("height above ")


def _raised(raster: HeightRaster, geoid: Path) -> HeightRaster:
    """The raster with heights above the ellipsoid."""
    if raster.horizontal is None:
        raise InputError(f"{raster.path} has no CRS, so no geoid can be added to it. Assign one (gdal_edit -a_srs).")
    geobox = GeoBox(raster.z.shape, raster.transform, raster.horizontal.to_wkt())
    return replace(raster, z=geoid_datum(geoid).ellipsoidal_from_heights(raster.z, geobox))


def geoid_datum(geoid: Path) -> VerticalDatum:
    """The vertical datum of --geoid.

    Raises
    ------
    ConfigError
        It is the ellipsoid, or the grid of the geoid is not installed.
    InputError
        The file is not a geoid.
    """
    vertical_datum = named_vertical_datum(str(geoid), "--geoid")
    if vertical_datum.geoid is None:
        raise ConfigError(f"--geoid {geoid} is no geoid. Give egm96, egm2008 or the raster of one, or leave it out.")
    return vertical_datum
