"""Standard deviation of every height: what the measure says of its own precision, calibrated on scenes of known truth.

The formula of `zlocus.matching.match_curve.predicted_sigma` (noise, bend of the measure, number of images) knows
nothing of systematic errors, smoothing across edges and wrong matches. Signs of these are laid beside it, all in height
steps or without a unit, so that they mean the same for every sensor, and an additive model maps them to a standard
deviation: its logarithm is a sum of curves, one per sign (`zlocus.matching.precision_calibration`, made by
benchmarks/precision.py). A single pair of images has a model of its own: no second pair contradicts its false heights.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.precision import add_curve
from zlocus.matching.median import median
from zlocus.matching.precision_calibration import PAIR, SPLIT
from zlocus.matching.semiglobal import SemiGlobalHeights
from zlocus.matching.subpixel import LEAST_PEAK, RefinedHeights

FloatGrid = NDArray[np.float32]
# Cells around one that speak for it, of surface and of groups of images.
NEAR, AROUND = 5, 7
# Steps below which nothing is told apart.
LEAST_STEPS, LEAST_APART = 0.03, 0.01
MOST_MARGIN = 2000.0


def sigma_steps(signs: dict[str, FloatGrid], refined: RefinedHeights) -> FloatGrid:
    """Standard deviation of heights in steps, (r, c) float32. signs : see `signs_of_precision`."""
    sigma, split = np.empty(refined.height.shape, np.float32), is_split(signs)
    for model, cells in ((SPLIT, split), (PAIR, ~split)):
        if cells.any():
            constant, not_refined, curves = model
            # Most tiles have one model: then nothing is picked out.
            of_model = ... if cells.all() else cells
            is_refined = refined.is_refined[of_model]
            total = np.where(is_refined.ravel(), np.float32(constant), np.float32(constant + not_refined))
            for name, (first, spacing, curve) in curves.items():
                values = signs[name][of_model].ravel()
                add_curve(values, np.float32(first), np.float32(spacing), np.array(curve, np.float32), total)
            sigma[of_model] = np.exp(total, out=total).reshape(is_refined.shape)
    return sigma


def spread_around(sigma: FloatGrid) -> FloatGrid:
    """Geometric mean (r, c) of the standard deviations around every cell, in the unit of `sigma`, (r, c) float32.

    One cell may be uncertain by chance, and so may one that is certain; where all cells around are uncertain, their
    heights are noise.
    """
    return np.exp(_mean(np.log(sigma), NEAR))


def is_split(signs: dict[str, FloatGrid]) -> NDArray[np.bool_]:
    """Where two groups of images could be told apart; a single pair cannot, nor images that agree to nothing."""
    return signs["apart"] > np.float32(np.log(1.01 * LEAST_APART))


def signs_of_precision(
    heights: SemiGlobalHeights, refined: RefinedHeights, n_seeing: NDArray[np.integer]
) -> dict[str, FloatGrid]:
    """Signs of how precise heights are, each (r, c) float32, logarithms but for `ncc` and `plane`.

    noise : `peak_variance` of the refined peak, as a standard deviation in steps; bend : of the measure there, per step
    squared; ncc : the measure itself; apart : root mean square distance of the peaks of two groups of pairs of images,
    steps, around the cell; rough, own : of the heights from the smooth surface that windows follow, around the cell and
    its own; uneven : standard deviation of heights around; jump, ledge : highest less lowest within 5 and 9 cells;
    rival : how much worse the second best height is; moved : from the semi-global height; images : that see it;
    plane : 1 for heights of a plane through a plain segment, else 0.
    """
    height, n_images = refined.height, np.maximum(n_seeing, 1).astype(np.float32)
    plain = cv2.medianBlur(height, NEAR)
    off, moved = np.abs(height - refined.smooth), np.abs(height - heights.vertex)
    known = np.isfinite(refined.apart)
    squares = np.maximum(_mean(np.where(known, refined.apart, np.float32(0)) ** 2, AROUND), 0)
    apart = np.sqrt(squares / np.maximum(_mean(known.astype(np.float32), AROUND), np.float32(1e-3)))
    centred = height - median(height.ravel())
    spread = _mean(centred * centred, AROUND) - _mean(centred, AROUND) ** 2
    signs = {
        "noise": np.log(refined.variance) / 2,
        "bend": np.log(np.maximum(refined.bend, LEAST_PEAK)),
        "ncc": refined.ncc,
        "apart": np.log(np.maximum(apart, np.float32(LEAST_APART))),
        "rough": np.log(np.sqrt(np.maximum(_mean(off * off, NEAR), 0)) + np.float32(LEAST_STEPS)),
        "own": np.log(off + np.float32(LEAST_STEPS)),
        "uneven": np.log(np.sqrt(np.maximum(spread, 0)) + np.float32(LEAST_STEPS)),
        "jump": np.log(_range(plain, NEAR) + np.float32(0.1)),
        "ledge": np.log(_range(plain, 9) + np.float32(0.1)),
        "rival": np.log(np.minimum(heights.margin, np.float32(MOST_MARGIN)) + np.float32(20)),
        "moved": np.log(moved + np.float32(0.05)),
        "images": np.log(n_images),
        "plane": refined.is_fixed,
    }
    return {name: values.astype(np.float32, copy=False) for name, values in signs.items()}


def _mean(values: FloatGrid, side: int) -> FloatGrid:
    return np.asarray(cv2.blur(values, (side, side), borderType=cv2.BORDER_REFLECT), np.float32)


def _range(values: FloatGrid, side: int) -> FloatGrid:
    window = np.ones((side, side), np.uint8)
    return np.asarray(cv2.dilate(values, window) - cv2.erode(values, window), np.float32)
