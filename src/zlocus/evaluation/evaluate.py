"""Evaluation of a surface against a reference surface: completeness and accuracy, per class and per band of slope."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.alignment import best_shift
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.coregistration import coregister
from zlocus.evaluation.frame import Points, frame_of, points_on
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.mvs3dm import Mvs3dm, mvs3dm_figures
from zlocus.evaluation.slopes import slope_bands
from zlocus.evaluation.statistics import ErrorStatistics, error_statistics
from zlocus.evaluation.truth import CLASS_NAMES, TruthBlocks, read_classes, truth_blocks
from zlocus.evaluation.vertical import same_heights

SEARCH = "search"


@dataclass(frozen=True)
class Shift:
    """Position of the surface relative to the reference, m; it is removed before errors are computed.

    method : that found it. steps, sigma_m : iterations until convergence, and standard error, m; None for a search.
    """

    east_m: float
    north_m: float
    up_m: float
    method: str = SEARCH
    steps: int | None = None
    sigma_m: float | None = None

    @property
    def enu_m(self) -> tuple[float, float, float]:
        """East, north and up, m."""
        return self.east_m, self.north_m, self.up_m


@dataclass(frozen=True)
class ErrorMap:
    """Errors of the blocks on their grid. errors : (r, c) float32, surface less reference, m; NaN where unknown."""

    geobox: GeoBox
    errors: NDArray[np.float32]


@dataclass(frozen=True)
class Evaluation:
    """Errors of a surface against a reference, over all blocks and over groups of them.

    statistics : of all blocks. class_statistics : by class, empty where no classes were given. shift : that was removed
    first, None where none was. threshold_m : limit of `within`. slope_statistics : by band of the reference's slope,
    degrees. mvs3dm : figures by the definitions of that benchmark. unshifted_statistics : of all blocks before the
    shift was removed. vertical_datums : of surface and reference as their files state them, None where one does not.
    assumed_datum, assumed_crs : what had to be assumed about the vertical datum and the coordinates, as sentences.
    geoid_added_to : raster to whose heights the geoid's were added. places_per_block : rows and columns of places in a
    block over which the surface was averaged, where the reference is coarser; None where each block has one place.
    error_map : None of an evaluation without files.
    """

    statistics: ErrorStatistics
    class_statistics: dict[str, ErrorStatistics]
    shift: Shift | None
    threshold_m: float
    slope_statistics: dict[str, ErrorStatistics] = field(default_factory=dict)
    mvs3dm: Mvs3dm | None = None
    unshifted_statistics: ErrorStatistics | None = None
    vertical_datums: tuple[str | None, str | None] = (None, None)
    assumed_datum: str | None = None
    assumed_crs: str | None = None
    geoid_added_to: Path | None = None
    places_per_block: tuple[int, int] | None = None
    error_map: ErrorMap | None = field(default=None, repr=False, compare=False)

    def as_dict(self) -> dict[str, Any]:
        """The evaluation as JSON holds it."""
        shift, mvs3dm = self.shift, self.mvs3dm
        record: dict[str, Any] = {
            "threshold_m": self.threshold_m,
            "shift_m": None if shift is None else {"east": shift.east_m, "north": shift.north_m, "up": shift.up_m},
            "shift_method": None if shift is None else shift.method,
            "shift_steps": None if shift is None else shift.steps,
            "shift_sigma": None if shift is None else shift.sigma_m,
            "dsm_heights": self.vertical_datums[0],
            "reference_heights": self.vertical_datums[1],
            "assumed": self.assumed_datum,
            "places_assumed": self.assumed_crs,
            "geoid_added_to": None if self.geoid_added_to is None else str(self.geoid_added_to),
            "mean_of": None if self.places_per_block is None else list(self.places_per_block),
            "all": self.statistics.as_dict(),
            **{name: statistics.as_dict() for name, statistics in self.class_statistics.items()},
            "slopes_deg": {name: statistics.as_dict() for name, statistics in self.slope_statistics.items()},
        }
        if self.unshifted_statistics is not None:
            record["unshifted"] = self.unshifted_statistics.as_dict()
        if mvs3dm is not None:
            for name, value in (("completeness", mvs3dm.completeness), ("median_error", mvs3dm.median_error_m)):
                record[f"mvs3dm_{name}"] = None if math.isnan(value) else value
        return record


def evaluate(dsm: Path, comparison: Comparison) -> Evaluation:
    """Compare a surface with a reference surface; cells of the reference with a height are the area that counts.

    The reference is divided into blocks of about 0.5 m. The surface is sampled at the centre of each block (nearest
    cell, reprojected where the CRS differ). Where the reference's cells are at least twice as large as the surface's,
    the mean of the surface over the block is compared instead. The true height of a block is the mean of its cells; in
    a block that holds an edge, either side counts as right. A cell without height counts as missing, and as not within
    the threshold. A shift that the comparison asks for is removed first; heights are then interpolated between cells.

    Raises
    ------
    InputError
        A file is missing or is not a raster of heights; or the two do not overlap, have different vertical datums, or
        cannot be co-registered.
    ConfigError
        The raster of classes is on another grid, or a geoid is given that is not needed.
    """
    compared = same_heights(read_heights(dsm), read_heights(comparison.reference), comparison.geoid)
    surface, reference = compared.surface, compared.reference
    frame = frame_of(surface, reference)
    classes = None if comparison.classes is None else read_classes(comparison.classes, reference)
    truth = truth_blocks(reference, comparison.margin_m, classes, frame)
    points = points_on(surface, reference, frame, truth.xy, truth.size, truth.is_edge)
    _check_overlap(surface, reference, points)
    errors_unshifted = truth.errors(points.heights(surface.nearest))
    aligned = _aligned(surface, truth, points, comparison)
    shift, errors = (None, errors_unshifted) if aligned is None else aligned

    def statistics(errors: FloatArray) -> ErrorStatistics:
        return error_statistics(errors, comparison.threshold_m, comparison.more_thresholds_m)

    class_names = () if classes is None else tuple(CLASS_NAMES)
    bands = slope_bands(truth.slope_deg, comparison.slope_edges_deg)
    return Evaluation(
        statistics=statistics(errors),
        class_statistics={name: statistics(errors[truth.members(name)]) for name in class_names},
        shift=shift,
        threshold_m=comparison.threshold_m,
        slope_statistics={name: statistics(errors[band]) for name, band in bands.items()},
        mvs3dm=mvs3dm_figures(surface, reference, frame, comparison.margin_m, shift.enu_m if shift else None),
        unshifted_statistics=None if shift is None else statistics(errors_unshifted),
        vertical_datums=compared.datums,
        assumed_datum=compared.assumed,
        assumed_crs=_assumed_crs(surface, reference),
        geoid_added_to=compared.converted,
        places_per_block=None if points.areas is None else points.areas.shape,
        error_map=_error_map(truth, reference.horizontal, errors),
    )


def _aligned(
    surface: HeightRaster, truth: TruthBlocks, points: Points, comparison: Comparison
) -> tuple[Shift, FloatArray] | None:
    """The shift of the surface, and the errors (n,) m without it; None where the comparison asks for no shift."""
    if comparison.coregister is not None:
        fit = coregister(surface, truth, points)
        shift = Shift(fit.east_m, fit.north_m, 0.0, comparison.coregister, fit.steps, fit.sigma_m)
    elif comparison.align:
        shift = Shift(*best_shift(surface, truth, points), 0.0)
    else:
        return None
    z = points.heights(surface.bilinear, (shift.east_m, shift.north_m))
    up = float(np.nanmedian(truth.errors(z)))
    return replace(shift, up_m=up), truth.errors(z - up)


def _check_overlap(surface: HeightRaster, reference: HeightRaster, points: Points) -> None:
    cell = surface.cells(points.xy)
    if not ((cell >= 0) & (cell < surface.z.shape)).all(axis=1).any():
        raise InputError(
            f"{surface.path} ({_crs_name(surface)}) and {reference.path} ({_crs_name(reference)}) do not overlap. "
            "Check the CRS of both."
        )


def _error_map(truth: TruthBlocks, crs: CRS | None, errors: FloatArray) -> ErrorMap:
    values = np.full(truth.shape, np.nan, np.float32)
    values[tuple(truth.cells.T)] = errors
    return ErrorMap(GeoBox(truth.shape, truth.transform, None if crs is None else crs.to_wkt()), values)


def _assumed_crs(surface: HeightRaster, reference: HeightRaster) -> str | None:
    """What was assumed about coordinates, as a sentence; None where both files have a CRS."""
    without_crs = [str(raster.path) for raster in (surface, reference) if raster.horizontal is None]
    if not without_crs:
        return None
    verb = "has" if len(without_crs) == 1 else "have"
    return f"{' and '.join(without_crs)} {verb} no CRS: coordinates were compared as they are"


def _crs_name(raster: HeightRaster) -> str:
    return raster.crs.to_string()[:60] if raster.crs else "no CRS"
