"""A surface against a reference surface: how complete, how accurate, per class and slope, shifted or as it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation import coregistration
from zlocus.evaluation.alignment import best_shift
from zlocus.evaluation.frame import Points, frame_of, points_on
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.mvs3dm import Mvs3dm, mvs3dm_figures
from zlocus.evaluation.slopes import SLOPE_EDGES_DEG, slope_bands
from zlocus.evaluation.statistics import ErrorStatistics, error_statistics
from zlocus.evaluation.truth import CLASS_NAMES, TruthBlocks, read_classes, truth_blocks
from zlocus.evaluation.vertical import same_heights

COREGISTRATIONS = (coregistration.METHOD,)
SEARCH = "search"


@dataclass(frozen=True)
class Shift:
    """What was removed before judging: the surface lies this much east, north and above the reference, in m.

    method : that found it. steps, sigma_m : it took to converge, and its standard error, m; None for a search.
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
    """Errors of the blocks, where they lie. errors : (r, c) float32, surface less reference, m; NaN where unknown."""

    geobox: GeoBox
    errors: NDArray[np.float32]


@dataclass(frozen=True)
class Evaluation:
    """Errors of a surface against a reference: over all blocks, and per class where classes were given.

    shift : removed first, None where the surface was judged as it is. threshold_m : limit of `within`.
    slopes : figures by band of slope of the reference, degrees. mvs3dm : figures by the definitions of that benchmark.
    unshifted : figures of all blocks before the shift was removed. heights : what those of surface and reference are
    above by their files, None where one does not say; assumed : what was taken for granted of that, as a sentence;
    places_assumed : of their coordinates. geoid_added_to : raster that a geoid's heights were added to. mean_of : of so
    many places along the rows and columns of a block the mean was compared, the reference being coarser; None: of one.
    error_map : for files.
    """

    all: ErrorStatistics
    classes: dict[str, ErrorStatistics]
    shift: Shift | None
    threshold_m: float
    slopes: dict[str, ErrorStatistics] = field(default_factory=dict)
    mvs3dm: Mvs3dm | None = None
    unshifted: ErrorStatistics | None = None
    heights: tuple[str | None, str | None] = (None, None)
    assumed: str | None = None
    places_assumed: str | None = None
    geoid_added_to: Path | None = None
    mean_of: tuple[int, int] | None = None
    error_map: ErrorMap | None = field(default=None, repr=False, compare=False)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        shift, mvs3dm = self.shift, self.mvs3dm
        record: dict[str, Any] = {
            "threshold_m": self.threshold_m,
            "shift_m": None if shift is None else {"east": shift.east_m, "north": shift.north_m, "up": shift.up_m},
            "shift_method": None if shift is None else shift.method,
            "shift_steps": None if shift is None else shift.steps,
            "shift_sigma": None if shift is None else shift.sigma_m,
            "dsm_heights": self.heights[0],
            "reference_heights": self.heights[1],
            "assumed": self.assumed,
            "places_assumed": self.places_assumed,
            "geoid_added_to": None if self.geoid_added_to is None else str(self.geoid_added_to),
            "mean_of": None if self.mean_of is None else list(self.mean_of),
            "all": self.all.as_dict(),
            **{name: figures.as_dict() for name, figures in self.classes.items()},
            "slopes_deg": {name: figures.as_dict() for name, figures in self.slopes.items()},
        }
        if self.unshifted is not None:
            record["unshifted"] = self.unshifted.as_dict()
        if mvs3dm is not None:
            for name, value in (("completeness", mvs3dm.completeness), ("median_error", mvs3dm.median_error_m)):
                record[f"mvs3dm_{name}"] = None if math.isnan(value) else value
        return record


def evaluate(
    dsm: Path,
    reference: Path,
    *,
    classes: Path | None = None,
    align: bool = False,
    margin_m: float = 10.0,
    threshold_m: float = 1.0,
    more_thresholds_m: Sequence[float] = (),
    slope_edges_deg: Sequence[float] = SLOPE_EDGES_DEG,
    coregister: str | None = None,
    geoid: Path | None = None,
) -> Evaluation:
    """Judge a surface by a reference surface, whose heights decide the area.

    The reference is taken in blocks of about 0.5 m, the surface looked up at their centres (nearest cell, reprojected
    where the CRS differ); where the reference's cells are twice as large as its own or larger, its mean over the block.
    A block's true height is its mean; where it holds an edge, either side is right. A cell
    without height counts as missing, and as not within the threshold. With `align` the best shift, with
    `coregister="nuth-kaab"` that of slope and aspect, is removed first, and heights are then looked up between cells.
    geoid : see `vertical.same_heights`.

    Raises
    ------
    InputError
        A file is missing, is not a raster of heights, or the two do not overlap, are above different things, or cannot
        be co-registered.
    ConfigError
        A margin, threshold or slope out of range, classes on another grid, or both kinds of alignment.
    """
    check_options(margin_m, (threshold_m, *more_thresholds_m), align, coregister)
    slope_bands(np.zeros(0), slope_edges_deg)
    compared = same_heights(read_heights(dsm), read_heights(reference), geoid)
    surface, heights = compared.surface, compared.reference
    frame = frame_of(surface, heights)
    truth = truth_blocks(heights, margin_m, None if classes is None else read_classes(classes, heights), frame)
    points = points_on(surface, heights, frame, truth.xy, truth.size, truth.is_edge)
    _check_overlap(surface, heights, points)
    as_it_lies = truth.errors(points.heights(surface.nearest))
    shift, errors = _aligned(surface, truth, points, align, coregister) or (None, as_it_lies)

    def figures(members: NDArray[np.bool_] | slice) -> ErrorStatistics:
        return error_statistics(errors[members], threshold_m, more_thresholds_m)

    return Evaluation(
        all=figures(slice(None)),
        classes={} if classes is None else {name: figures(truth.members(name)) for name in CLASS_NAMES},
        shift=shift,
        threshold_m=threshold_m,
        slopes={name: figures(band) for name, band in slope_bands(truth.slope_deg, slope_edges_deg).items()},
        mvs3dm=mvs3dm_figures(surface, heights, frame, margin_m=margin_m, shift=shift.enu_m if shift else None),
        unshifted=None if shift is None else error_statistics(as_it_lies, threshold_m, more_thresholds_m),
        heights=compared.datums,
        assumed=compared.assumed,
        places_assumed=_places_assumed(surface, heights),
        geoid_added_to=compared.converted,
        mean_of=None if points.areas is None else points.areas.shape,
        error_map=_error_map(truth, heights.horizontal, errors),
    )  # fmt: skip


def check_options(margin_m: float, thresholds_m: Sequence[float], align: bool, coregister: str | None) -> None:
    """Refuse what no evaluation can be asked.

    Raises
    ------
    ConfigError
        A margin or threshold out of range, a co-registration that is not known, or both kinds of alignment.
    """
    if not margin_m >= 0:
        raise ConfigError(f"--margin {margin_m:g} is negative. Give 0 or more metres.")
    for threshold_m in thresholds_m:
        if not threshold_m > 0:
            raise ConfigError(f"--threshold {threshold_m:g} is not a size. Give a number of metres above 0.")
    if coregister is not None and coregister not in COREGISTRATIONS:
        raise ConfigError(f"--coregister {coregister} is not known. Give {' or '.join(COREGISTRATIONS)}.")
    if align and coregister is not None:
        raise ConfigError(f"--align and --coregister {coregister} both look for the shift. Leave one out.")


def _aligned(
    surface: HeightRaster, truth: TruthBlocks, points: Points, align: bool, coregister: str | None
) -> tuple[Shift, FloatArray] | None:
    """The shift found, and the errors (n,) m once it is removed; None where none was asked for."""
    if coregister is not None:
        found = coregistration.coregister(surface, truth, points)
        shift = Shift(found.east_m, found.north_m, 0.0, coregister, found.steps, found.sigma_m)
    elif align:
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
            f"{surface.path} ({_name(surface)}) and {reference.path} ({_name(reference)}) do not overlap. "
            "Check the CRS of both."
        )


def _error_map(truth: TruthBlocks, crs: CRS | None, errors: FloatArray) -> ErrorMap:
    values = np.full(truth.shape, np.nan, np.float32)
    values[tuple(truth.cells.T)] = errors
    return ErrorMap(GeoBox(truth.shape, truth.transform, None if crs is None else crs.to_wkt()), values)


def _places_assumed(surface: HeightRaster, reference: HeightRaster) -> str | None:
    """What was taken for granted of coordinates, as a sentence."""
    silent = [str(raster.path) for raster in (surface, reference) if raster.horizontal is None]
    if not silent:
        return None
    return (
        f"{' and '.join(silent)} {'has' if len(silent) == 1 else 'have'} no CRS: coordinates were compared as they are"
    )


def _name(raster: HeightRaster) -> str:
    return raster.crs.to_string()[:60] if raster.crs else "no CRS"
