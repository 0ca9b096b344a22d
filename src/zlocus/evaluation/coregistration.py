"""Co-registration of two surfaces by slope and aspect (Nuth and Kääb 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.statistics import NORMAL_SIGMA_FROM_MAD
from zlocus.evaluation.truth import TruthBlocks

METHOD = "nuth-kaab"
# It has converged when it would move the surface by less.
TOLERANCE_M = 0.001
MOST_ITERATIONS = 50
# Slopes must differ by this much in every direction: below, a shift of a metre changes heights by a centimetre.
LEAST_SLOPE_SPREAD = 0.01
# Walls: heights there say on which side a block lies, not how far.
STEEPEST_SLOPE = np.tan(np.radians(70.0))
LEAST_BLOCKS = 100
# The gradients of blocks that are this far apart share no height, so noise in the reference is no slope.
APART = 3
# Tukey's biweight: 95 % efficient for normal errors (Beaton and Tukey 1974).
TUKEY = 4.685
WEIGHT_ROUNDS = 5
LEAST_SIGMA_M = 1e-6
# Of a surface that has nothing to do with the reference, some shift fits a little better than those around it; but it
# is not known to half a cell.
MOST_SIGMA_CELLS = 0.5


@dataclass(frozen=True)
class Coregistration:
    """Where a surface lies: this much east and north of the reference, in m of the frame.

    steps : taken to find it. sigma_m : standard error of the shift in the direction that is known least, m, as if the
    errors of the blocks were independent.
    """

    east_m: float
    north_m: float
    steps: int
    sigma_m: float


def coregister(surface: HeightRaster, truth: TruthBlocks, points: Points) -> Coregistration:
    """The horizontal shift of a surface against the reference.

    Height differences dh of a surface that lies a metres in direction b (clockwise from north) of the reference follow
    its slope alpha and aspect psi: dh = a cos(b - psi) tan(alpha) + c. Nuth and Kääb (2011, The Cryosphere 5, eq. 1 to
    3) divide this by tan(alpha); here it is fitted as it stands, so that blocks count by their slope, c is the vertical
    offset itself, and gentle slopes, where the quotient is mostly noise, need not be left out. Outliers get no weight
    (Tukey's biweight at 4.685 times the NMAD of what the fit leaves). The surface is then looked up at the shifted
    places, and the rest found, until that is less than `TOLERANCE_M`.

    points : centres of the blocks as the surface has them.

    Raises
    ------
    InputError
        Too few heights in common, ground too flat, no convergence, or a shift that is known to half a cell only.
    """
    rise, height = truth.gradient, truth.mean
    usable = np.isfinite(rise).all(axis=1) & (np.hypot(*rise.T) < STEEPEST_SLOPE)
    _check_relief(surface, truth, usable)
    # (east, north) of the shift and the vertical offset, to heights.
    design = np.column_stack([-rise[usable], np.ones(np.count_nonzero(usable))])
    at, height = points.where(usable), height[usable]
    shift, moved = np.zeros(2), np.inf
    for step in range(1, MOST_ITERATIONS + 1):
        difference = at.heights(surface.between_cells, shift) - height
        found = np.isfinite(difference)
        n = int(np.count_nonzero(found))
        if step == 1:
            _check_enough(surface, n)
        if n < LEAST_BLOCKS:
            break
        rest, sigma_m = _robust_fit(design[found], difference[found])
        shift, moved = shift + rest, float(np.hypot(*rest))
        if moved < TOLERANCE_M:
            _check_known(surface, points, sigma_m)
            return Coregistration(float(shift[0]), float(shift[1]), step, sigma_m)
    raise InputError(
        f"The co-registration of {surface.path} did not converge: after {step} steps it had moved it by "
        f"{shift[0]:+.3g} m east and {shift[1]:+.3g} m north, the last time by {moved:.3g} m. Align it another way "
        "(--align finds shifts of up to 4 m), or judge it as it is."
    )


def _nmad(values: FloatArray) -> float:
    return NORMAL_SIGMA_FROM_MAD * float(np.median(np.abs(values - np.median(values))))


def _robust_fit(design: FloatArray, difference: FloatArray) -> tuple[FloatArray, float]:
    """The shift (2,) m that explains differences (n,) m, outliers without weight, and its largest standard error, m.

    design : (n, 3), heights per metre east and north, and per metre up.
    """
    weight = np.ones(len(difference))
    for _ in range(WEIGHT_ROUNDS + 1):
        normal = design.T @ (design * weight[:, None])
        parameters = np.linalg.lstsq(normal, design.T @ (difference * weight), rcond=None)[0]
        left = difference - design @ parameters
        sigma = max(_nmad(left), LEAST_SIGMA_M)
        weight = np.clip(1 - (left / (TUKEY * sigma)) ** 2, 0, None) ** 2
        if not weight.any():
            break
    covariance = sigma**2 * np.linalg.pinv(normal)[:2, :2]
    return np.asarray(parameters[:2]), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def _check_known(surface: HeightRaster, points: Points, sigma_m: float) -> None:
    per_metre = 1.0 if points.per_metre is None else float(np.hypot(*points.per_metre[0, :, 0]))
    cell = abs(surface.transform.a)
    if points.areas is not None:
        # Means of larger cells tell as little as those.
        cell = max(cell, float(np.hypot(*np.moveaxis(points.areas.steps[..., 0], -1, 0)).max()))
    most_m = MOST_SIGMA_CELLS * cell / per_metre
    if sigma_m > most_m:
        raise InputError(
            f"{surface.path} differs too much from the reference to co-register: the shift would be known to "
            f"{sigma_m:.2g} m, and {most_m:.2g} m are needed. Check that both show the same ground."
        )


def _check_enough(surface: HeightRaster, n: int) -> None:
    if n < LEAST_BLOCKS:
        raise InputError(
            f"{surface.path} and the reference have {n} blocks with a slope in common, fewer than the {LEAST_BLOCKS} "
            "that co-registration needs. Check that they overlap, or judge it as it is."
        )


def _check_relief(surface: HeightRaster, truth: TruthBlocks, usable: NDArray[np.bool_]) -> None:
    """Refuse ground whose slopes do not differ in some direction: flat, or one tilted plane."""
    _check_enough(surface, int(np.count_nonzero(usable)))
    rise = np.full((*truth.shape, 2), np.nan)
    rise[tuple(truth.cells[usable].T)] = truth.gradient[usable]
    rise -= np.nanmean(rise, axis=(0, 1))
    pairs = [(rise[:-APART], rise[APART:]), (rise[:, :-APART], rise[:, APART:])]
    one, other = (np.concatenate([pair[side].reshape(-1, 2) for pair in pairs]) for side in (0, 1))
    both = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    n = int(np.count_nonzero(both))
    _check_enough(surface, n)
    common = one[both].T @ other[both] / n
    least = float(np.linalg.eigvalsh((common + common.T) / 2)[0])
    spread = np.sqrt(max(least, 0.0))
    if spread < LEAST_SLOPE_SPREAD:
        raise InputError(
            f"The ground under {surface.path} is too flat to co-register: in one direction its slopes differ by "
            f"{100 * spread:.1f} %, and {100 * LEAST_SLOPE_SPREAD:g} % are needed. Judge it as it is, or try --align."
        )
