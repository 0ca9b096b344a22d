"""Open finished surfaces and rasters of heights as inputs of commands that join or compare them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.scene import is_local
from zlocus.io.crs import crs_label, is_in_metres, is_on_earth
from zlocus.io.height_values import check_unit
from zlocus.io.open_raster import existing_file, open_raster
from zlocus.io.run_folder import MANIFEST, RECORD, check_surface
from zlocus.io.vertical import (
    ELLIPSOID,
    ELLIPSOIDAL,
    ELLIPSOIDAL_DESCRIPTION,
    VerticalDatum,
    check_heights,
    declared_vertical_datum,
    named_vertical_datum,
    vertical_part,
)

# Cells that lie within this share of a cell of each other are the same.
SAME_GRID = 1e-3
# Rasters of a run beside its heights.
DSM, SIGMA, QUALITY, VIEWS, WATER, ORTHO = "dsm.tif", "sigma.tif", "quality.tif", "views.tif", "water.tif", "ortho.tif"
LAYERS = (SIGMA, QUALITY, VIEWS, WATER, ORTHO)
# Joins the raster of an input and its standard deviation on the command line.
SIGMA_SIGN = "="


@dataclass(frozen=True)
class SurfaceInput:
    """A surface among several: the folder of a run, or a raster of heights.

    path : as it was given; dsm : raster of the heights; layers : other rasters on its grid, by the names that a run
    gives them; sigma_m : standard deviation of all heights where no raster tells it, None: not known; transform, shape
    : of the grid; crs : horizontal CRS, None: not known; datum : name of the vertical datum that the file states, None:
    it states none; vertical_crs : WKT of the vertical CRS, "" without one; ortho_bands : type and number of bands of
    the ortho-image, None without one; images : digests of the images of the run.
    """

    path: Path
    dsm: Path
    layers: Mapping[str, Path]
    sigma_m: float | None
    transform: Affine
    shape: tuple[int, int]
    crs: CRS | None
    datum: str | None
    spatial_wkt: str = ""
    ortho_bands: tuple[str, int] | None = None
    images: frozenset[str] = field(default_factory=frozenset)

    @property
    def has_sigma(self) -> bool:
        """Whether the standard deviations of the heights are known."""
        return SIGMA in self.layers or self.sigma_m is not None

    @property
    def files(self) -> list[Path]:
        """All rasters that are read."""
        return [self.dsm, *self.layers.values()]

    @property
    def geobox(self) -> GeoBox:
        """The grid, with the horizontal CRS."""
        return GeoBox(self.shape, self.transform, None if self.crs is None else self.crs.to_wkt())

    @property
    def cell(self) -> float:
        """Mean side of a cell, in units of the CRS."""
        return math.sqrt(abs(self.transform.determinant))

    def vertical_datum(self, geoid: Path | None) -> VerticalDatum:
        """The vertical datum of the heights. geoid : raster or name of the geoid of heights that are not ellipsoidal.

        Raises
        ------
        InputError, ConfigError
            zlocus has no geoid of that datum, or PROJ's grid of it is not installed.
        """
        if self.datum in (None, ELLIPSOID):
            return ELLIPSOIDAL
        if geoid is not None:
            return named_vertical_datum(str(geoid), "--geoid")
        return declared_vertical_datum(CRS.from_wkt(self.spatial_wkt), self.dsm, "--geoid")


def surface_input(given: str | Path) -> SurfaceInput:
    """Open a surface: the folder of a run or of a mosaic, a raster, or RASTER=SIGMA with a raster or metres.

    Raises
    ------
    InputError
        There is no such surface, or it cannot be read.
    ConfigError
        A standard deviation that is no size, or one for the folder of a run, which has its own.
    """
    path, sigma = _parts(str(given))
    if path.is_dir():
        if sigma is not None:
            raise ConfigError(f"{path} is a folder with standard deviations of its own. Leave {SIGMA_SIGN}{sigma} out.")
        if not (path / DSM).is_file() or (path / MANIFEST).is_file():
            check_surface(path)
        layers = {name: path / name for name in LAYERS if (path / name).is_file()}
        return _opened(SurfaceInput(path, path / DSM, layers, None, Affine.identity(), (0, 0), None, None))
    dsm = existing_file(path, "surface")
    layers, sigma_m = {}, None
    if sigma is not None:
        try:
            sigma_m = float(sigma)
        except ValueError:
            layers = {SIGMA: existing_file(Path(sigma), "raster of standard deviations")}
        if sigma_m is not None and not (math.isfinite(sigma_m) and sigma_m > 0):
            raise ConfigError(f"{given}: {sigma} is no standard deviation. Give metres above 0, or a raster.")
    return _opened(SurfaceInput(path, dsm, layers, sigma_m, Affine.identity(), (0, 0), None, None))


def _parts(given: str) -> tuple[Path, str | None]:
    """Path of a surface, and what was given as its standard deviation."""
    if SIGMA_SIGN not in given or Path(given).exists():
        return Path(given), None
    path, _, sigma = given.rpartition(SIGMA_SIGN)
    return Path(path), sigma


def _opened(surface: SurfaceInput) -> SurfaceInput:
    """The surface with what its files say. Rasters that belong to it must have its grid."""
    with open_raster(surface.dsm, "surface") as source:
        check_unit(source.units[0], surface.dsm)
        spatial = None if source.crs is None else CRS.from_wkt(source.crs.to_wkt())
        transform, shape = source.transform, source.shape
        if source.dtypes[0].startswith("complex") or min(shape) < 2:
            raise InputError(f"{surface.dsm} is no raster of heights. Check the file.")
        if not transform.determinant or not all(map(math.isfinite, transform[:6])):
            raise InputError(f"The cells of {surface.dsm} lie nowhere: its transform is {tuple(transform)[:6]}.")
        description = source.descriptions[0] or ""
    datum = ELLIPSOID if description == ELLIPSOIDAL_DESCRIPTION else None
    if spatial is not None:
        check_heights(spatial, surface.dsm)
        vertical = vertical_part(spatial)
        if vertical is not None:
            datum = vertical.name
        elif len(spatial.axis_info) == 3 and not is_local(spatial):
            datum = ELLIPSOID
    bands = None
    for name, path in surface.layers.items():
        with open_raster(path, "raster") as source:
            same = source.shape == shape and source.transform.almost_equals(transform, SAME_GRID * abs(transform.a))
            if not same:
                raise InputError(f"{path} is not on the grid of {surface.dsm}. Give one that has the same cells.")
            if name == ORTHO:
                bands = (source.dtypes[0], source.count)
    return replace(
        surface, transform=transform, shape=shape, datum=datum, ortho_bands=bands,
        crs=None if spatial is None else spatial if is_local(spatial) else spatial.to_2d(),
        spatial_wkt="" if spatial is None else spatial.to_wkt(), images=_images(surface.path / RECORD),
    )  # fmt: skip


def _images(record: Path) -> frozenset[str]:
    """Digests of the inputs of a run; none where no record tells them."""
    try:
        inputs: Any = json.loads(record.read_text(encoding="utf-8"))["inputs"]
        return frozenset(str(each["sha256"]) for each in inputs if each.get("sha256"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return frozenset()


def check_not_inputs(out: Path, surfaces: Sequence[SurfaceInput]) -> None:
    """Refuse to write into a folder from which is read.

    Raises
    ------
    ConfigError
        A raster that is read lies in the folder.
    """
    for surface in surfaces:
        for path in surface.files:
            if path.resolve().parent == out.resolve():
                raise ConfigError(f"{path} is read, and might be written over. Choose another folder with -o.")


def has_same_cells(surface: SurfaceInput, geobox: GeoBox, crs: CRS | None) -> bool:
    """Whether the cells of a surface lie on those of a grid, as far as both reach. crs : of the grid."""
    if surface.crs != crs:
        return False
    offset = ~geobox.transform * surface.transform
    rows, cols = surface.shape
    moved = [(offset * corner, corner) for corner in ((0, 0), (cols, 0), (0, rows))]
    steps = [(x - corner[0], y - corner[1]) for (x, y), corner in moved]
    first = round(steps[0][0]), round(steps[0][1])
    return all(abs(x - first[0]) < SAME_GRID and abs(y - first[1]) < SAME_GRID for x, y in steps)


def check_joinable(surfaces: Sequence[SurfaceInput], geoid: Path | None = None) -> list[str]:
    """Check that surfaces can be brought onto the grid of the first, and say what has to be assumed or converted.

    The result is a list of sentences for the user. geoid : see `SurfaceInput.vertical_datum`.

    Raises
    ------
    InputError
        The grid of the first is not north-up, or its CRS is not in metres; a CRS cannot be converted to it; the
        vertical datums differ and one of them is not known.
    ConfigError
        PROJ's grid of a geoid that is needed is not installed.
    """
    first, said = surfaces[0], []
    t = first.transform
    if t.b or t.d or t.a <= 0 or t.e >= 0:
        raise InputError(f"{first.dsm} is rotated or not north-up, so it cannot be the grid. Warp it first (gdalwarp).")
    if first.crs is not None and (first.crs.is_geographic or not is_in_metres(first.crs)):
        raise InputError(
            f"{first.path} has the CRS {crs_label(first.crs)}, which is not in metres, and the others would be brought "
            "onto its grid. Name a surface with a projected CRS first, or warp this one (gdalwarp -t_srs)."
        )
    for other in surfaces[1:]:
        if (first.crs is None) != (other.crs is None):
            silent = first if first.crs is None else other
            raise InputError(f"{silent.dsm} has no CRS, and the others have one. Assign it (gdal_edit -a_srs).")
        if first.crs is not None and other.crs is not None and other.crs != first.crs:
            for one in (first, other):
                if one.crs is not None and not (is_on_earth(one.crs) and not is_local(one.crs)):
                    raise InputError(f"{one.path} is in a local frame, which the others are not. Leave it out.")
            said.append(
                f"{other.path} is in {crs_label(other.crs)} and is brought to {crs_label(first.crs)}, the CRS of "
                f"{first.path}."
            )
    stated = stating_datum(surfaces)
    for other in surfaces:
        said += _datum_sentences(stated, other, geoid)
    if geoid is not None and len({surface.datum for surface in surfaces if surface.datum is not None}) < 2:
        raise ConfigError(f"--geoid {geoid} is not needed: no two vertical datums differ. Leave it out.")
    return said


def stating_datum(surfaces: Sequence[SurfaceInput]) -> SurfaceInput:
    """The first surface that states its vertical datum, which the result gets; the first of all where none does."""
    return next((surface for surface in surfaces if surface.datum is not None), surfaces[0])


def _datum_sentences(first: SurfaceInput, other: SurfaceInput, geoid: Path | None) -> list[str]:
    """What has to be assumed about, or done with, the vertical datum of a surface beside that of another."""
    if first.datum == other.datum:
        return []
    if other.datum is None:
        return [f"{other.path} does not state its vertical datum: taken to be {_above(first.datum)}."]
    both = (
        f"The heights of {first.path} are above {_above(first.datum)} and those of {other.path} above "
        f"{_above(other.datum)}"
    )
    if geoid is not None and ELLIPSOID not in (first.datum, other.datum):
        raise InputError(f"{both}: one geoid is not enough. Convert one of them to the ellipsoid (gdalwarp -t_srs).")
    try:
        names = [surface.vertical_datum(geoid).name for surface in (first, other)]
    except InputError as error:
        if geoid is not None:
            raise
        raise InputError(
            f"{both}, and zlocus has no geoid between them. Give it with --geoid RASTER, or convert one of them "
            "(gdalwarp -t_srs)."
        ) from error
    if names[0] == names[1]:
        return []
    return [
        f"The heights of {other.path}, above {_above(other.datum)}, are converted to {_above(first.datum)}, as of "
        f"{first.path}."
    ]


def converted_datums(
    first: SurfaceInput, other: SurfaceInput, geoid: Path | None
) -> tuple[VerticalDatum, VerticalDatum] | None:
    """Vertical datum of a surface, and that of the first to which its heights have to be brought; None where they need
    not. geoid : see `SurfaceInput.vertical_datum`."""
    if None in (first.datum, other.datum) or first.datum == other.datum:
        return None
    datums = other.vertical_datum(geoid), first.vertical_datum(geoid)
    return None if datums[0].name == datums[1].name else datums


def _above(datum: str | None) -> str:
    return f"the {ELLIPSOID}" if datum == ELLIPSOID else str(datum)
