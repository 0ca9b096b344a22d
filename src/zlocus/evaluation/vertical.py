"""Heights above the same thing: refused where two files say that theirs are not, converted where a geoid is given."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from odc.geo.geobox import GeoBox

from zlocus.core.errors import ConfigError, InputError
from zlocus.evaluation.heights import HeightRaster
from zlocus.io.vertical import ELLIPSOID, ELLIPSOIDAL_DESCRIPTION, check_heights, named_vertical_datum, vertical_part


@dataclass(frozen=True)
class Compared:
    """Two rasters whose heights may be subtracted.

    datums : what the files say that the heights of surface and reference are above, None for nothing. converted : that
    of the two to whose heights the geoid's were added, None for neither.
    """

    surface: HeightRaster
    reference: HeightRaster
    datums: tuple[str | None, str | None]
    converted: Path | None = None

    @property
    def assumed(self) -> str | None:
        """What had to be taken for granted, as a sentence; None for nothing."""
        mine, theirs = self.datums
        if self.converted is not None or (mine is None) == (theirs is None):
            return None
        silent, datum = (self.reference, mine) if theirs is None else (self.surface, theirs)
        return f"{silent.path} does not say what its heights are above: taken to be {_above(datum)}, as of the other"


def same_heights(surface: HeightRaster, reference: HeightRaster, geoid: Path | None) -> Compared:
    """The two rasters above the same thing.

    geoid : raster of its heights above the ellipsoid, m. They are added to the heights that are above a geoid: by its
    CRS, or, where no CRS says it, those of the reference.

    Raises
    ------
    InputError
        The files say that their heights are above different things and no geoid is given that helps; heights that
        are not in metres; or a geoid that does not reach as far as the heights.
    ConfigError
        A geoid where both heights are above the same thing.
    """
    mine, theirs = datum_of(surface), datum_of(reference)
    if geoid is not None:
        return _with_geoid(surface, reference, (mine, theirs), geoid)
    if mine is not None and theirs is not None and mine != theirs:
        raise InputError(
            f"The heights of {surface.path} are above {_above(mine)} and those of {reference.path} above "
            f"{_above(theirs)}. Add the geoid's heights with --geoid RASTER, or convert one of them (gdalwarp -t_srs)."
        )
    return Compared(surface, reference, (mine, theirs))


def datum_of(raster: HeightRaster) -> str | None:
    """What a file says that its heights are above: `ELLIPSOID`, the name of a vertical CRS, or None for nothing.

    Raises
    ------
    InputError
        Heights that are not in metres, or go down.
    """
    crs = raster.spatial
    if crs is not None:
        check_heights(crs, raster.path)
        vertical = vertical_part(crs)
        if vertical is not None:
            # Geoids of files carry the file's name, whatever that is.
            is_ellipsoid = ELLIPSOID in vertical.name.lower() and "geoid" not in vertical.name.lower()
            return ELLIPSOID if is_ellipsoid else vertical.name
        if len(crs.axis_info) == 3 and (crs.is_geographic or crs.is_projected):
            return ELLIPSOID
    return ELLIPSOID if raster.description == ELLIPSOIDAL_DESCRIPTION else None


def _above(datum: str | None) -> str:
    return f"the {ELLIPSOID}" if datum == ELLIPSOID else str(datum).removeprefix("height above ")


def _with_geoid(
    surface: HeightRaster, reference: HeightRaster, datums: tuple[str | None, str | None], geoid: Path
) -> Compared:
    mine, theirs = datums
    if mine is not None and mine == theirs:
        raise ConfigError(
            f"--geoid {geoid} is not needed: the heights of {surface.path} and {reference.path} are both above "
            f"{_above(mine)}. Leave it out."
        )
    if mine not in (None, ELLIPSOID) and theirs not in (None, ELLIPSOID):
        raise InputError(
            f"The heights of {surface.path} are above {mine} and those of {reference.path} above {theirs}: one geoid "
            "is not enough. Convert one of them to the ellipsoid first (gdalwarp -t_srs)."
        )
    if theirs == ELLIPSOID or mine not in (None, ELLIPSOID):
        return Compared(_raised(surface, geoid), reference, datums, surface.path)
    return Compared(surface, _raised(reference, geoid), datums, reference.path)


def _raised(raster: HeightRaster, geoid: Path) -> HeightRaster:
    """The same heights above the ellipsoid."""
    if raster.horizontal is None:
        raise InputError(f"{raster.path} has no CRS, so no geoid can be added to it. Assign one (gdal_edit -a_srs).")
    datum = named_vertical_datum(str(geoid), "--geoid")
    if datum.geoid is None:
        raise ConfigError(f"--geoid {geoid} is no geoid. Give egm96, egm2008 or the raster of one, or leave it out.")
    geobox = GeoBox(raster.z.shape, raster.transform, raster.horizontal.to_wkt())
    return replace(raster, z=datum.ellipsoidal_from_heights(raster.z, geobox))
