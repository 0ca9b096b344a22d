"""The reference of the page: compared as by `zlocus evaluate`, and made comparable cell by cell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from odc.geo.geobox import GeoBox

from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.shift import Shift
from zlocus.evaluation.vertical import same_heights
from zlocus.io.open_raster import existing_file, open_raster
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.vertical import named_vertical_datum
from zlocus.products.report.comparison import saturated_error_m
from zlocus.products.report.text import against_reference

# Every run calls its surface so.
DSM = "dsm.tif"


@dataclass(frozen=True)
class Reference:
    """Heights with which the surface can be compared cell by cell.

    path : raster on the reference's grid, with the surface's vertical datum and without a shift between the two; name :
    of the reference's file; saturated_m : size of a difference from which colours are saturated; sentence : the result
    of the comparison.
    """

    path: Path
    name: str
    saturated_m: float
    sentence: str


def check_comparison(comparison: Comparison) -> None:
    """Refuse a comparison at once that would fail later in the background.

    Raises
    ------
    InputError, ConfigError
        The reference does not exist, or the geoid is not known.
    """
    existing_file(comparison.reference, "reference")
    if comparison.geoid is not None:
        named_vertical_datum(str(comparison.geoid), "--geoid")


def reference_for(dsm: Path, comparison: Comparison, scratch: Path) -> Reference:
    """Compare a surface with a reference. scratch : folder to which the comparable heights are written.

    Raises
    ------
    InputError, ConfigError
        See `evaluate`.
    """
    evaluation, name = evaluate(dsm, comparison), name_of(comparison.reference)
    heights = comparable(dsm, comparison, evaluation.shift)
    crs = None if heights.horizontal is None else heights.horizontal.to_wkt()
    path, geobox = scratch / "reference.tif", GeoBox(heights.z.shape, heights.transform, crs)
    with RasterSink(path, geobox, RasterBands("float32", float("nan"), units="m")) as sink:
        sink.write(0, 0, heights.z.astype(np.float32))
    return Reference(path, name, saturated_error_m(evaluation), against_reference(evaluation, name))


def name_of(reference: Path) -> str:
    """Name of a reference; with that of its folder where it is the surface of another run."""
    return f"{reference.resolve().parent.name}/{DSM}" if reference.name == DSM else reference.name


def comparable(dsm: Path, comparison: Comparison, shift: Shift | None) -> HeightRaster:
    """The reference's heights with the surface's vertical datum, shifted as the surface is."""
    compared = same_heights(described(dsm), read_heights(comparison.reference), comparison.geoid)
    heights = compared.reference
    if compared.converted == dsm and heights.horizontal is not None:
        # The comparison converted the surface to the ellipsoid; here the reference is converted to the geoid instead.
        geobox = GeoBox(heights.z.shape, heights.transform, heights.horizontal.to_wkt())
        datum = named_vertical_datum(str(comparison.geoid), "--geoid")
        z = datum.heights_from_ellipsoidal(heights.z.astype(np.float32), geobox).astype(np.float64)
        heights = replace(heights, z=z)
    if shift is not None:
        moved = heights.transform.translation(shift.east_m, shift.north_m) * heights.transform
        heights = replace(heights, z=heights.z + shift.up_m, transform=moved)
    return heights


def described(dsm: Path) -> HeightRaster:
    """A surface without its heights: only its CRS and the description of the heights."""
    with open_raster(dsm, "raster of heights") as file:
        return HeightRaster(dsm, np.full((2, 2), np.nan), file.transform, file.crs, file.descriptions[0] or "")
