"""Evaluation of a surface against a reference surface: completeness and accuracy, per class and per band of slope."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.accuracy import Accuracy
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.filling import share_ground, why_nothing_compared
from zlocus.evaluation.frame import Points, frame_of, points_on
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.mvs3dm import Mvs3dm, mvs3dm_figures
from zlocus.evaluation.shift import Shift, heights_without, horizontal_shift, shift_record
from zlocus.evaluation.slopes import slope_bands
from zlocus.evaluation.statistics import ErrorStatistics, error_statistics
from zlocus.evaluation.truth import CLASS_NAMES, TruthBlocks, read_classes, truth_blocks
from zlocus.evaluation.vertical import same_heights

NOTHING_IN_COMMON = "no cell has a height in both the surface and the reference"


@dataclass(frozen=True)
class ErrorMap:
    """Errors of the blocks on their grid. errors : (r, c) float32, surface less reference, m; NaN where unknown."""

    geobox: GeoBox
    errors: NDArray[np.float32]


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Accuracy of a surface against a reference, as it lies and after the best shift was removed.

    absolute_accuracy : as the surface lies. threshold_m : limit of `within`. aligned_accuracy : after the shift was
    removed; None where no shift is known. found_shift : the shift that is removed for the aligned figures; None where
    none is known. no_shift : why not, as a clause. nothing_compared : why no error is known, as a sentence with advice;
    None where one is. is_aligned : whether the aligned figures are the main ones, of which
    the error map is. vertical_datums : of surface and reference as their files state them, None where one does not.
    assumed_datum, assumed_crs : what had to be assumed about the vertical datum and the coordinates, as sentences.
    geoid_added_to : raster to whose heights the geoid's were added. places_per_block : rows and columns of places in a
    block over which the surface was averaged, where the reference is coarser; None where each block has one place.
    error_map : None of an evaluation without files.
    """

    absolute_accuracy: Accuracy
    threshold_m: float
    aligned_accuracy: Accuracy | None = None
    found_shift: Shift | None = None
    no_shift: str | None = None
    nothing_compared: str | None = None
    is_aligned: bool = False
    vertical_datums: tuple[str | None, str | None] = (None, None)
    assumed_datum: str | None = None
    assumed_crs: str | None = None
    geoid_added_to: Path | None = None
    places_per_block: tuple[int, int] | None = None
    error_map: ErrorMap | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        """One line: the main figures, without those of classes and slopes."""
        found = self.statistics
        kind = "aligned" if self.is_aligned else "absolute"
        return (
            f"Evaluation({kind}: {found.n} cells, {100 * found.completeness:.1f} % with a height, "
            f"{100 * found.within:.1f} % within {self.threshold_m:g} m, median {found.median:.3f} m, "
            f"NMAD {found.nmad:.3f} m, RMSE {found.rmse:.3f} m)"
        )

    @property
    def main_accuracy(self) -> Accuracy:
        """The figures that the comparison asks for: aligned with `align` or `coregister`, else absolute."""
        return (
            self.aligned_accuracy if self.is_aligned and self.aligned_accuracy is not None else self.absolute_accuracy
        )

    @property
    def statistics(self) -> ErrorStatistics:
        """Main figures of all blocks."""
        return self.main_accuracy.statistics

    @property
    def class_statistics(self) -> dict[str, ErrorStatistics]:
        """Main figures by class; empty where no classes were given."""
        return self.main_accuracy.class_statistics

    @property
    def slope_statistics(self) -> dict[str, ErrorStatistics]:
        """Main figures by band of the reference's slope, degrees."""
        return self.main_accuracy.slope_statistics

    @property
    def mvs3dm(self) -> Mvs3dm | None:
        """Main figures by the definitions of that benchmark."""
        return self.main_accuracy.mvs3dm

    @property
    def shift(self) -> Shift | None:
        """The shift that was removed before the main figures; None where they are the absolute ones."""
        return self.found_shift if self.is_aligned else None

    @property
    def unshifted_statistics(self) -> ErrorStatistics | None:
        """Absolute figures of all blocks where the aligned ones are the main ones, else None."""
        return self.absolute_accuracy.statistics if self.is_aligned else None

    def as_dict(self) -> dict[str, Any]:
        """The evaluation as JSON holds it: the main figures, then the absolute and the aligned ones side by side."""
        record: dict[str, Any] = {
            "threshold_m": self.threshold_m,
            **shift_record(self.shift),
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
        aligned = (
            {"all": None, "classes": {}, "slopes_deg": {}}
            if self.aligned_accuracy is None
            else self.aligned_accuracy.as_dict()
        )
        reason = self.no_shift if self.found_shift is None else self.found_shift.undetermined
        return record | self.main_accuracy.mvs3dm_record() | {
            "absolute": self.absolute_accuracy.as_dict(),
            "aligned": {**shift_record(self.found_shift), "reason": reason, **aligned},
        }  # fmt: skip


def evaluate(dsm: Path, comparison: Comparison) -> Evaluation:
    """Compare a surface with a reference surface; cells of the reference with a height are the area that counts.

    The reference is divided into blocks of about 0.5 m. The surface is sampled at the centre of each block (nearest
    cell, reprojected where the CRS differ). Where the reference's cells are at least twice as large as the surface's,
    the mean of the surface over the block is compared instead. The true height of a block is the mean of its cells; in
    a block that holds an edge, either side counts as right. A cell without height counts as missing, and as not within
    the threshold. The errors are given as the surface lies, and after its best shift was removed; heights are then
    interpolated between cells. Where no horizontal shift is determined, only the height is removed.

    Raises
    ------
    InputError
        A file is missing or is not a raster of heights; or the two do not overlap, have different vertical datums, or
        cannot be aligned although the comparison asks for it.
    ConfigError
        The raster of classes is on another grid, or a geoid is given that is not needed.
    """
    surface, reference = read_heights(dsm), read_heights(comparison.reference)
    classes = None if comparison.classes is None else read_classes(comparison.classes, reference)
    return evaluate_rasters(surface, reference, comparison, classes)


def evaluate_rasters(
    surface: HeightRaster, reference: HeightRaster, comparison: Comparison, classes: NDArray[np.uint8] | None = None
) -> Evaluation:
    """The same for rasters that are in memory already. classes : (r, c) on the reference's grid, or None.

    Raises
    ------
    InputError, ConfigError
        See `evaluate`.
    """
    compared = same_heights(surface, reference, comparison.geoid)
    surface, reference = compared.surface, compared.reference
    frame = frame_of(surface, reference)
    truth = truth_blocks(reference, comparison.margin_m, classes, frame)
    points = points_on(surface, reference, frame, truth.xy, truth.size, truth.is_edge)
    _check_overlap(surface, reference, points)
    bands = slope_bands(truth.slope_deg, comparison.slope_edges_deg)
    members = {} if classes is None else {name: truth.members(name) for name in CLASS_NAMES}

    def accuracy(errors: FloatArray, shift: Shift | None) -> Accuracy:
        def statistics(chosen: NDArray[np.bool_] | slice) -> ErrorStatistics:
            return error_statistics(errors[chosen], comparison.threshold_m, comparison.more_thresholds_m)

        return Accuracy(
            statistics=statistics(slice(None)),
            class_statistics={name: statistics(chosen) for name, chosen in members.items()},
            slope_statistics={name: statistics(chosen) for name, chosen in bands.items()},
            mvs3dm=mvs3dm_figures(surface, reference, frame, comparison.margin_m, shift),
        )

    errors = truth.errors(heights_without(None, surface, points))
    aligned = _aligned(surface, truth, points, comparison)
    nothing_compared = None
    if aligned is None and not np.isfinite(errors).any():
        nothing_compared = why_nothing_compared(surface, reference, truth, points, comparison.margin_m)
        if comparison.removes_shift:
            raise InputError(nothing_compared)
    is_aligned = comparison.removes_shift and aligned is not None
    return Evaluation(
        absolute_accuracy=accuracy(errors, None),
        threshold_m=comparison.threshold_m,
        aligned_accuracy=None if aligned is None else accuracy(aligned.errors, aligned.shift),
        found_shift=None if aligned is None else aligned.shift,
        no_shift=NOTHING_IN_COMMON if aligned is None else None,
        nothing_compared=nothing_compared,
        is_aligned=is_aligned,
        vertical_datums=compared.datums,
        assumed_datum=compared.assumed,
        assumed_crs=_assumed_crs(surface, reference),
        geoid_added_to=compared.converted,
        places_per_block=None if points.areas is None else points.areas.shape,
        error_map=_error_map(truth, reference.horizontal, aligned.errors if aligned and is_aligned else errors),
    )


class AlignedErrors(NamedTuple):
    """Errors (n,) m after the shift of the surface was removed."""

    shift: Shift
    errors: FloatArray


def _aligned(surface: HeightRaster, truth: TruthBlocks, points: Points, comparison: Comparison) -> AlignedErrors | None:
    """Errors after the shift was removed; None where there is none, because no cell has a height in both rasters."""
    shift = horizontal_shift(surface, truth, points, comparison)
    # The height is measured as the horizontal shift was: between cells.
    look_up = HeightRaster.nearest if shift.undetermined else HeightRaster.bilinear
    z = points.heights(surface, look_up, shift.enu_m[:2])
    errors = truth.errors(z)
    if not np.isfinite(errors).any():
        return None
    shift = replace(shift, up_m=float(np.nanmedian(errors)))
    return AlignedErrors(shift, truth.errors(heights_without(shift, surface, points)))


def _check_overlap(surface: HeightRaster, reference: HeightRaster, points: Points) -> None:
    cell = surface.cells(points.xy)
    if not ((cell >= 0) & (cell < surface.z.shape)).all(axis=1).any() and not share_ground(surface, reference):
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
