"""Co-registration of two surfaces by slope and aspect (Nuth and Kääb 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.relief import MIN_BLOCKS, MIN_SLOPE_SPREAD, has_slope, slope_spread
from zlocus.evaluation.statistics import NORMAL_SIGMA_FROM_MAD
from zlocus.evaluation.truth import TruthBlocks

METHOD = "nuth-kaab"
# The iterations end where the next shift is smaller than this.
CONVERGED_SHIFT_M = 0.001
MAX_ITERATIONS = 50
# Tukey's biweight: 95 % efficient for normal errors (Beaton and Tukey 1974).
TUKEY_SIGMAS = 4.685
WEIGHT_ROUNDS = 5
MIN_SIGMA_M = 1e-6
# Even where a surface has nothing to do with the reference, some shift fits a little better than its neighbours. Its
# standard error then exceeds this.
MAX_SIGMA_CELLS = 0.5


@dataclass(frozen=True)
class Coregistration:
    """Position of a surface east and north of the reference, in metres of the common frame.

    steps : iterations. sigma_m : standard error of the shift in its least certain direction, m, if the errors of the
    blocks are independent.
    """

    east_m: float
    north_m: float
    steps: int
    sigma_m: float


def coregister(surface: HeightRaster, truth: TruthBlocks, points: Points) -> Coregistration:
    """Horizontal shift of a surface against the reference.

    Where a surface lies a metres in direction b (clockwise from north) of the reference, its height differences dh
    follow slope alpha and aspect psi of the ground: dh = a cos(b - psi) tan(alpha) + c. Nuth and Kääb (2011, The
    Cryosphere 5, eq. 1 to 3) divide this by tan(alpha). Here it is fitted without the division: blocks then count by
    their slope, c is the vertical offset itself, and gentle slopes, where the quotient is mostly noise, need not be
    left out. Outliers get no weight (Tukey's biweight at 4.685 times the NMAD of the residuals). The surface is then
    sampled at the shifted places and the rest is fitted, until it is below `CONVERGED_SHIFT_M`.

    points : centres of the blocks in the surface's CRS.

    Raises
    ------
    InputError
        There are too few common heights, the ground is too flat, the iterations do not converge, or the standard error
        of the shift exceeds half a cell.
    """
    rise, height = truth.gradient, truth.mean
    usable = has_slope(truth)
    _check_enough(surface, int(np.count_nonzero(usable)))
    _check_relief(surface, truth)
    # (east, north) of the shift and the vertical offset, to heights.
    design = np.column_stack([-rise[usable], np.ones(np.count_nonzero(usable))])
    usable_points, height = points.where(usable), height[usable]
    shift, moved = np.zeros(2), np.inf
    for step in range(1, MAX_ITERATIONS + 1):
        difference = usable_points.heights(surface, HeightRaster.between_cells, shift) - height
        known = np.isfinite(difference)
        n = int(np.count_nonzero(known))
        if step == 1:
            _check_enough(surface, n)
        if n < MIN_BLOCKS:
            break
        rest, sigma_m = _robust_fit(design[known], difference[known])
        shift, moved = shift + rest, float(np.hypot(*rest))
        if moved < CONVERGED_SHIFT_M:
            _check_certain(surface, points, sigma_m)
            return Coregistration(float(shift[0]), float(shift[1]), step, sigma_m)
    raise InputError(
        f"The co-registration of {surface.path} did not converge: after {step} steps it had moved it by "
        f"{shift[0]:+.3g} m east and {shift[1]:+.3g} m north, the last time by {moved:.3g} m. Align it another way "
        "(--align finds shifts of up to 4 m), or judge it as it is."
    )


def _nmad(values: FloatArray) -> float:
    return NORMAL_SIGMA_FROM_MAD * float(np.median(np.abs(values - np.median(values))))


def _robust_fit(design: FloatArray, difference: FloatArray) -> tuple[FloatArray, float]:
    """Shift (2,) m that fits height differences (n,) m robustly, and its largest standard error, m.

    design : (n, 3), change of height per metre of shift to the east, to the north and up.
    """
    weight = np.ones(len(difference))
    for _ in range(WEIGHT_ROUNDS + 1):
        normal = design.T @ (design * weight[:, None])
        parameters = np.linalg.lstsq(normal, design.T @ (difference * weight), rcond=None)[0]
        residual = difference - design @ parameters
        sigma = max(_nmad(residual), MIN_SIGMA_M)
        weight = np.clip(1 - (residual / (TUKEY_SIGMAS * sigma)) ** 2, 0, None) ** 2
        if not weight.any():
            break
    covariance = sigma**2 * np.linalg.pinv(normal)[:2, :2]
    return np.asarray(parameters[:2]), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def _check_certain(surface: HeightRaster, points: Points, sigma_m: float) -> None:
    per_metre = 1.0 if points.per_metre is None else float(np.hypot(*points.per_metre[0, :, 0]))
    cell = abs(surface.transform.a)
    if points.areas is not None:
        # Where cells are averaged over larger areas, these limit what can be known.
        cell = max(cell, float(np.hypot(*np.moveaxis(points.areas.steps[..., 0], -1, 0)).max()))
    max_sigma_m = MAX_SIGMA_CELLS * cell / per_metre
    if sigma_m > max_sigma_m:
        raise InputError(
            f"{surface.path} differs too much from the reference to co-register: the shift would be known to "
            f"{sigma_m:.2g} m, and {max_sigma_m:.2g} m are needed. Check that both show the same ground."
        )


def _check_enough(surface: HeightRaster, n: int) -> None:
    if n < MIN_BLOCKS:
        raise InputError(
            f"{surface.path} and the reference have {n} blocks with a slope in common, fewer than the {MIN_BLOCKS} "
            "that co-registration needs. Compare a larger surface or a finer reference, or judge it as it is."
        )


def _check_relief(surface: HeightRaster, truth: TruthBlocks) -> None:
    """Refuse flat ground and a tilted plane: their slopes do not differ in some direction."""
    relief = slope_spread(truth)
    _check_enough(surface, relief.n_pairs)
    if relief.least < MIN_SLOPE_SPREAD:
        raise InputError(
            f"The ground under {surface.path} is too flat to co-register: in one direction its slopes differ by "
            f"{100 * relief.least:.1f} %, and {100 * MIN_SLOPE_SPREAD:g} % are needed. Judge it as it is, or remove "
            "its height alone (--align)."
        )
