"""Evaluation of a surface that is an array, against a reference on the same grid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.argument_checks import numeric_array, positive_number
from zlocus.core.errors import ConfigError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import Evaluation, evaluate_rasters
from zlocus.evaluation.heights import HeightRaster

# What messages call the two arrays.
SURFACE, REFERENCE = Path("the surface"), Path("the reference")


def evaluate(
    height: NDArray[np.floating],
    reference: NDArray[np.floating],
    resolution: float,
    *,
    classes: NDArray[np.integer] | None = None,
    align: bool = False,
    margin_m: float = 0.0,
    threshold_m: float = 1.0,
) -> Evaluation:
    """Completeness and accuracy of a surface against reference heights on the same grid, as `zlocus evaluate` has them.

    height, reference : (r, c) m, NaN where there is none; rows from north to south, columns from west to east.
    resolution : side of a cell, m. classes : (r, c) of the reference's cells (0 and 1 ground, 2 building, 3 tree), or
    None. align : whether the main figures are those after the best shift was removed. margin_m : width of the strip
    along the edge that is left out. threshold_m : errors below it count as within. Cells are judged in blocks of about
    0.5 m. `statistics` of the result are the main figures, in m; a cell without a height counts as missing.

    Raises
    ------
    ConfigError
        The arrays do not fit each other, or an option is out of range.
    InputError
        The reference has no height inside its margin, or there is nothing to align.
    """
    surface, truth = (
        _raster(height, "height", resolution, SURFACE),
        _raster(reference, "reference", resolution, REFERENCE),
    )
    _check_grid("reference", truth.z, surface.z)
    comparison = Comparison(REFERENCE, align=align, margin_m=margin_m, threshold_m=threshold_m)
    return evaluate_rasters(surface, truth, comparison, _classes(classes, surface.z))


def _raster(values: Any, name: str, resolution: float, path: Path) -> HeightRaster:
    z = np.asarray(numeric_array(name, values, "rows, columns"), np.float64)
    if min(z.shape) < 2:
        raise ConfigError(f"{name} has {z.shape[0]} x {z.shape[1]} cells, too few for a surface. Give 2 x 2 or more.")
    cell_m = positive_number("resolution", resolution, "m")
    return HeightRaster(path, np.where(np.isfinite(z), z, np.nan), Affine.scale(cell_m, -cell_m), None)


def _classes(classes: Any, z: FloatArray) -> NDArray[np.uint8] | None:
    if classes is None:
        return None
    values = numeric_array("classes", classes, "rows, columns")
    _check_grid("classes", values, z)
    return values.astype(np.uint8)


def _check_grid(name: str, values: NDArray[Any], z: FloatArray) -> None:
    if values.shape != z.shape:
        raise ConfigError(f"{name} has {values.shape} cells, and height {z.shape}. Give both on one grid.")
