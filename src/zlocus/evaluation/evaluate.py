"""A surface against a reference surface: how complete, how accurate, per class, shifted or as it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.crs import CRS
from rasterio.warp import transform as warp_points

from zlocus.errors import ConfigError, InputError
from zlocus.evaluation.alignment import best_shift
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.statistics import ErrorStatistics, error_statistics
from zlocus.evaluation.truth import CLASS_NAMES, TruthBlocks, read_classes, truth_blocks
from zlocus.sensors.model import FloatArray


@dataclass(frozen=True)
class Shift:
    """What was removed before judging: the surface lies this much east, north and above the reference, in m."""

    east_m: float
    north_m: float
    up_m: float


@dataclass(frozen=True)
class Evaluation:
    """Errors of a surface against a reference: over all blocks, and per class where classes were given.

    shift : removed first, None where the surface was judged as it is. threshold_m : limit of `within`.
    """

    all: ErrorStatistics
    classes: dict[str, ErrorStatistics]
    shift: Shift | None
    threshold_m: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        shift = self.shift
        return {
            "threshold_m": self.threshold_m,
            "shift_m": None if shift is None else {"east": shift.east_m, "north": shift.north_m, "up": shift.up_m},
            "all": self.all.as_dict(),
            **{name: figures.as_dict() for name, figures in self.classes.items()},
        }


def evaluate(
    dsm: Path,
    reference: Path,
    *,
    classes: Path | None = None,
    align: bool = False,
    margin_m: float = 10.0,
    threshold_m: float = 1.0,
) -> Evaluation:
    """Judge a surface by a reference surface, whose heights decide the area.

    The reference is taken in blocks of about 0.5 m, the surface looked up at their centres (nearest cell, reprojected
    where the CRS differ). A block's true height is its mean; where it holds an edge, either side is right. A cell
    without height counts as missing, and as not within the threshold. With `align`, the best shift is found and
    removed first, and heights are then looked up between cells.

    Raises
    ------
    InputError
        A file is missing, is not a raster of heights, or the two do not overlap.
    ConfigError
        A margin or threshold out of range, or classes on another grid.
    """
    if not margin_m >= 0:
        raise ConfigError(f"--margin {margin_m:g} is negative. Give 0 or more metres.")
    if not threshold_m > 0:
        raise ConfigError(f"--threshold {threshold_m:g} is not a size. Give a number of metres above 0.")
    surface, heights = read_heights(dsm), read_heights(reference)
    truth = truth_blocks(heights, margin_m, None if classes is None else read_classes(classes, heights))
    xy = _in_crs_of(surface, heights, truth.xy)
    shift, errors = None, truth.errors(surface.nearest(xy))
    if align:
        shift, errors = _aligned(surface, truth, xy)
    figures = {} if classes is None else {
        name: error_statistics(errors[truth.members(name)], threshold_m) for name in CLASS_NAMES
    }  # fmt: skip
    return Evaluation(error_statistics(errors, threshold_m), figures, shift, threshold_m)


def _aligned(surface: HeightRaster, truth: TruthBlocks, xy: FloatArray) -> tuple[Shift, FloatArray]:
    """The shift found, and the errors (n,) m once it is removed."""
    east, north = best_shift(surface, truth, xy)
    z = surface.bilinear(xy + np.array([east, north]))
    up = float(np.nanmedian(truth.errors(z)))
    return Shift(east, north, up), truth.errors(z - up)


def _in_crs_of(surface: HeightRaster, reference: HeightRaster, xy: FloatArray) -> FloatArray:
    """Points of the reference in the surface's CRS. (n, 2) -> (n, 2)."""
    if surface.crs and reference.crs and surface.crs != reference.crs:
        x, y = warp_points(reference.crs, surface.crs, xy[:, 0], xy[:, 1])
        xy = np.column_stack([x, y])
    cell = surface.cells(xy)
    if not ((cell >= 0) & (cell < surface.z.shape)).all(axis=1).any():
        raise InputError(
            f"{surface.path} ({_name(surface.crs)}) and {reference.path} ({_name(reference.crs)}) do not overlap. "
            "Check the CRS of both."
        )
    return xy


def _name(crs: CRS | None) -> str:
    return crs.to_string()[:60] if crs else "no CRS"
