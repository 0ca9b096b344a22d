"""Standard deviation of every height, from uncertainty predictors that were calibrated on scenes of known truth.

The formula of `zlocus.matching.match_curve.predicted_sigma` (noise, curvature of the correlation, number of images)
does not include systematic errors, smoothing across edges, and wrong matches. Therefore further predictors are used
beside it. All are in height steps or without a unit, so that they mean the same for every sensor. An additive model
maps them to a standard deviation: its logarithm is a sum of curves, one for each predictor
(`zlocus.matching.precision_calibration`, made by benchmarks/precision.py). Cells that a single pair of images measured
have a model of their own, because no second pair contradicts their false heights.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.precision import add_curve
from zlocus.matching.local_contrast import deviation
from zlocus.matching.median import median
from zlocus.matching.precision_calibration import PAIR, SPLIT
from zlocus.matching.semiglobal import SemiGlobalHeights
from zlocus.matching.subpixel import MIN_PEAK_CURVATURE, RefinedHeights
from zlocus.matching.tile_views import TileViews
from zlocus.matching.true_ortho import ortho_image

FloatGrid = NDArray[np.float32]
# Sides of the windows around a cell from which predictors of the surface are computed.
NEAR_CELLS, WIDE_CELLS = 5, 9
# Side of the window from which the spread of heights and the distance of the groups of image pairs are computed.
AROUND_CELLS = 7
TEXTURE_WINDOW = (NEAR_CELLS, NEAR_CELLS)
# Constants that keep logarithms finite: roughness and spread, distance of groups, range, refinement (all steps), and
# uniqueness (path cost units).
MIN_ROUGHNESS_STEPS, MIN_GROUP_DISTANCE_STEPS, MIN_RANGE_STEPS, MIN_REFINEMENT_STEPS = 0.03, 0.01, 0.1, 0.05
MIN_UNIQUENESS, MAX_UNIQUENESS = 20, 2000.0
# The images agree around a cell where their mean correlation over WIDE_CELLS is at least this.
MIN_AGREEMENT = 0.4
# The same for texture, in standard deviations of the grey values of an image.
MIN_TEXTURE = 0.01


def sigma_steps(predictors: dict[str, FloatGrid], refined: RefinedHeights, line_shift_steps: float = 0.0) -> FloatGrid:
    """Standard deviation of the heights in steps, (r, c) float32.

    predictors : see `uncertainty_predictors`; line_shift_steps : see `MatchScene`: displacements of lines along the
    parallax, which nothing shows, are as large as those across it, and their errors come on top of all others.
    """
    sigma, split = np.empty(refined.height.shape, np.float32), is_split(predictors)
    for model, cells in ((SPLIT, split), (PAIR, ~split)):
        if cells.any():
            constant, not_refined, of_lines, curves = model
            # Most tiles need one model only; then no cells are selected, which saves copies.
            of_model = ... if cells.all() else cells
            is_refined = refined.is_refined[of_model]
            total = np.where(is_refined.ravel(), np.float32(constant), np.float32(constant + not_refined))
            for name, (first, spacing, curve) in curves.items():
                values = predictors[name][of_model].ravel()
                add_curve(values, np.float32(first), np.float32(spacing), np.array(curve, np.float32), total)
            of_cells = np.exp(total, out=total).reshape(is_refined.shape)
            sigma[of_model] = np.hypot(of_cells, np.float32(of_lines * line_shift_steps))
    return sigma


def spread_around(sigma: FloatGrid) -> FloatGrid:
    """Geometric mean (r, c) of the standard deviations around every cell, in the unit of `sigma`, (r, c) float32.

    A single cell may have a large or a small standard deviation by chance. Where all cells around have large ones, the
    heights are noise.
    """
    return np.exp(_mean(np.log(sigma), NEAR_CELLS))


def is_split(predictors: dict[str, FloatGrid]) -> NDArray[np.bool_]:
    """(r, c) bool: cells where two groups of image pairs found heights of their own.

    A single pair cannot be split, nor can images that do not agree.
    """
    return predictors["group_distance"] > np.float32(np.log(1.01 * MIN_GROUP_DISTANCE_STEPS))


def uncertainty_predictors(
    heights: SemiGlobalHeights,
    refined: RefinedHeights,
    n_seeing: NDArray[np.integer],
    texture: FloatGrid,
    max_distance: float,
) -> dict[str, FloatGrid]:
    """Predictors of the standard deviation of the heights, each (r, c) float32; logarithms but for `ncc` and `plane`.

    noise : `peak_variance` of the refined peak, as a standard deviation in steps; curvature : of the correlation there,
    per step squared; ncc : the correlation itself; group_distance : root mean square distance, in steps, of the peaks
    of two groups of image pairs around the cell; roughness, cell_roughness : distance of the heights from the smooth
    surface that the windows follow, around the cell and at the cell; spread : standard deviation of the heights around
    the cell; range_5, range_9 : highest minus lowest height within 5 and within 9 cells; uniqueness : by how much the
    path costs of the secondary minimum are larger; refinement : distance from the semi-global height; images : number
    of images that see the cell; plane : 1 for the height of a plane through a plain segment, else 0; texture : standard
    deviation of the grey values around the cell, (r, c) in units of that of an image, see `texture_around`; distance :
    cells to the nearest place where the images agree, see `distance_from_agreement`.
    """
    height, n_images = refined.height, np.maximum(n_seeing, 1).astype(np.float32)
    plain = cv2.medianBlur(height, NEAR_CELLS)
    off_surface, refinement = np.abs(height - refined.smooth), np.abs(height - heights.vertex)
    roughness = np.sqrt(np.maximum(_mean(off_surface * off_surface, NEAR_CELLS), 0))
    centred = height - median(height.ravel())
    spread = _mean(centred * centred, AROUND_CELLS) - _mean(centred, AROUND_CELLS) ** 2
    uniqueness = np.minimum(heights.uniqueness, np.float32(MAX_UNIQUENESS))
    predictors = {
        "noise": np.log(refined.variance) / 2,
        "curvature": np.log(np.maximum(refined.curvature, MIN_PEAK_CURVATURE)),
        "ncc": refined.ncc,
        "group_distance": np.log(np.maximum(_group_distance(refined), np.float32(MIN_GROUP_DISTANCE_STEPS))),
        "roughness": np.log(roughness + np.float32(MIN_ROUGHNESS_STEPS)),
        "cell_roughness": np.log(off_surface + np.float32(MIN_ROUGHNESS_STEPS)),
        "spread": np.log(np.sqrt(np.maximum(spread, 0)) + np.float32(MIN_ROUGHNESS_STEPS)),
        "range_5": np.log(_range(plain, NEAR_CELLS) + np.float32(MIN_RANGE_STEPS)),
        "range_9": np.log(_range(plain, WIDE_CELLS) + np.float32(MIN_RANGE_STEPS)),
        "uniqueness": np.log(uniqueness + np.float32(MIN_UNIQUENESS)),
        "refinement": np.log(refinement + np.float32(MIN_REFINEMENT_STEPS)),
        "images": np.log(n_images),
        "plane": refined.is_fixed,
        "texture": np.log(texture + np.float32(MIN_TEXTURE)),
        "distance": np.log1p(distance_from_agreement(refined.ncc, max_distance)),
    }
    return {name: values.astype(np.float32, copy=False) for name, values in predictors.items()}


def distance_from_agreement(ncc: FloatGrid, max_distance: float) -> FloatGrid:
    """Distance of every cell from the nearest cell around which the images agree, (r, c) float32 cells.

    Where they agree nowhere near, as on water or on plain ground, the height is that of a place so far away. ncc :
    (r, c), correlation of the images at the heights found; max_distance : a larger distance counts as this, so that it
    does not depend on how the ground is cut into tiles.
    """
    disagrees = (_mean(ncc, WIDE_CELLS) < np.float32(MIN_AGREEMENT)).astype(np.uint8)
    if disagrees.all():
        return np.full(ncc.shape, max_distance, np.float32)
    found = cv2.distanceTransform(disagrees, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.minimum(found, np.float32(max_distance)), np.float32)


def texture_around(tile_views: TileViews, height: FloatGrid, is_covered: NDArray[np.bool_]) -> FloatGrid:
    """Standard deviation of the grey values around every cell, (r, c), the mean of the views that cover it.

    height : (r, c) float32 level indices; is_covered : (i, r, c), cells that each view covers. 0 where none does.
    """
    total = np.zeros(height.shape, np.float32)
    for view, is_shown in enumerate(is_covered):
        total += np.where(is_shown, deviation(ortho_image(tile_views, height, view), TEXTURE_WINDOW), np.float32(0.0))
    return np.asarray(total / np.maximum(is_covered.sum(axis=0, dtype=np.float32), np.float32(1.0)), np.float32)


def _group_distance(refined: RefinedHeights) -> FloatGrid:
    """Root mean square distance of the peaks of two groups of image pairs around every cell, (r, c) steps."""
    known = np.isfinite(refined.group_distance)
    squares = np.maximum(_mean(np.where(known, refined.group_distance, np.float32(0)) ** 2, AROUND_CELLS), 0)
    share_known = np.maximum(_mean(known.astype(np.float32), AROUND_CELLS), np.float32(1e-3))
    return np.asarray(np.sqrt(squares / share_known), np.float32)


def _mean(values: FloatGrid, side: int) -> FloatGrid:
    """Mean of the window around every cell, (r, c)."""
    return np.asarray(cv2.blur(values, (side, side), borderType=cv2.BORDER_REFLECT), np.float32)


def _range(values: FloatGrid, side: int) -> FloatGrid:
    """Largest minus smallest value of the window around every cell, (r, c)."""
    window = np.ones((side, side), np.uint8)
    return np.asarray(cv2.dilate(values, window) - cv2.erode(values, window), np.float32)
