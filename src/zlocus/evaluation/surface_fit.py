"""Fit of a surface to its reference: shift east, north and up, and perhaps tilt, with their uncertainty."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.alignment import MAX_SHIFT_M, MIN_SPREAD_RISE
from zlocus.evaluation.coregistration import MIN_SIGMA_M, TUKEY_SIGMAS
from zlocus.evaluation.fit_sample import FitSample
from zlocus.evaluation.fit_uncertainty import area_cells, covariance_of
from zlocus.evaluation.relief import MAX_SLOPE, MIN_SLOPE_SPREAD
from zlocus.evaluation.spread import median_deviation

# Number of points that each kind of fit needs at least.
MIN_FOR_HEIGHT, MIN_FOR_TILT, MIN_FOR_SHIFT = 3, 10, 100
CONVERGED_M, MAX_STEPS, WEIGHT_ROUNDS = 0.0005, 30, 10
# After all steps, a last one below this share of a cell is good enough.
NEAR_CELLS = 0.02
# A step is at most so many times as long as the one that the equations give.
MAX_LENGTHENING = 4.0
# The search tries shifts on a grid of so many places to each side, with some of the points.
SEARCH_STEPS, SEARCH_POINTS = 5, 20_000
# Slopes of medians of 3 x 3 cells are measured over at least so many cells to each side, so that they share no cell
# with the height between four: noise of the height then does not pull the shift to where it is averaged most.
SLOPE_CELLS = 3.0
# A shift counts as known where its standard error is below half a cell, or below a fifth of the shift itself.
MAX_SIGMA_CELLS, MAX_SIGMA_SHARE = 0.5, 0.2
# Differences are compared with those of shifts some metres and some cells beside.
BESIDE_CELLS = 8
# Two halves of a scene, each a half of so many areas along a side, must give shifts that differ by at most so many
# standard deviations, or by a cell.
AREAS_OF_HALVES, MAX_APART_SIGMAS = 6, 3.0
# Where less than this share of the slopes' scatter is relief that the reference has too, it is noise.
MIN_RELIEF_SHARE = 0.1
# Points must spread across a scene by this share of its half length, or a tilt is not known.
MIN_TILT_SPREAD = 0.03
# Interpolation between cells moves shifts by up to this share of a cell, however many places are compared.
INTERPOLATION_CELLS = 0.01
# Derivatives are taken over steps that change heights by this share of their spread.
DIFFERENCE_SCALES = 0.2
EAST, NORTH, UP, TILT_EAST, TILT_NORTH = range(5)


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """Position of a surface relative to its reference.

    At a place (x, y) the surface is z(x + east, y + north) = true height + up + tilt, where tilt = (tilt_east (x - x0)
    + tilt_north (y - y0)) / half_length and (x0, y0) is the centre.

    values : (5,) m: east, north, up, and the two tilts at half a length from the centre. covariance : (5, 5) m2; 0 for
    what was held. n : number of places compared; n_used : of those whose weight is not 0; nmad_m : of what is left;
    undetermined : why the horizontal shift is not known, as a clause; then it is held at 0. has_tilt : whether a tilt
    was fitted. n_groups : number of areas or passes from which the uncertainty was found.
    """

    values: FloatArray
    covariance: FloatArray
    centre: tuple[float, float]
    half_length_m: float
    n: int
    n_used: int
    nmad_m: float
    steps: int
    n_groups: int
    has_tilt: bool
    undetermined: str | None

    @property
    def shift_m(self) -> tuple[float, float, float]:
        """East, north and up, m."""
        east, north, up = self.values[:3]
        return float(east), float(north), float(up)

    @property
    def sigma_m(self) -> FloatArray:
        """Standard deviations (5,) of the values, m."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def offset(self, xy: FloatArray) -> FloatArray:
        """By how much the moved surface is too high (n,), m, at places (n, 2)."""
        east, north = ((xy - self.centre) / self.half_length_m).T
        return np.asarray(self.values[UP] + self.values[TILT_EAST] * east + self.values[TILT_NORTH] * north)

    def as_dict(self) -> dict[str, Any]:
        """The fit as run.json holds it: None in place of what was held."""
        sigma_m = self.sigma_m
        known = {"east": self.undetermined is None, "north": self.undetermined is None, "up": True}
        shift = {name: float(self.values[k]) if known[name] else None for k, name in enumerate(known)}
        sigma = {name: float(sigma_m[k]) if known[name] else None for k, name in enumerate(known)}
        tilt = {
            "east_m_per_km": float(1e3 * self.values[TILT_EAST] / self.half_length_m),
            "north_m_per_km": float(1e3 * self.values[TILT_NORTH] / self.half_length_m),
            "sigma_east_m_per_km": float(1e3 * sigma_m[TILT_EAST] / self.half_length_m),
            "sigma_north_m_per_km": float(1e3 * sigma_m[TILT_NORTH] / self.half_length_m),
            "at_edge_m": {"east": float(self.values[TILT_EAST]), "north": float(self.values[TILT_NORTH])},
            "sigma_at_edge_m": {"east": float(sigma_m[TILT_EAST]), "north": float(sigma_m[TILT_NORTH])},
            "edge_m": self.half_length_m,
        }  # fmt: skip
        return {
            "offset_m": shift, "sigma_m": sigma, "tilt": tilt if self.has_tilt else None, "centre": list(self.centre),
            "horizontal_undetermined": self.undetermined, "n_compared": self.n, "n_used": self.n_used,
            "nmad_after_m": self.nmad_m, "steps": self.steps, "n_groups": self.n_groups,
        }  # fmt: skip


def fit_surface(sample: FitSample, max_shift_m: float, has_tilt: bool = False, is_vertical: bool = False) -> SurfaceFit:
    """Fit a surface to its reference.

    Shifts on a grid within `max_shift_m` are tried first: the one with the shortest interval that holds half of the
    height differences. From there the shift follows height differences and slopes (Nuth and Kääb 2011, eq. 1 to 3,
    without the division by the slope), with slopes of the surface over shorter and shorter distances. Trees, changed
    ground and gross errors get no weight (Tukey's biweight, started at the middle of that shortest half: Rousseeuw
    1984, so that up to half of the differences may lie on one side). Where the ground does not tell the horizontal
    shift, it is held at 0. is_vertical : it is held anyway.

    Raises
    ------
    InputError
        Too few places have a height in both; the points do not spread enough for a tilt; or the shift is larger than
        `max_shift_m`.
    """
    known = int(np.count_nonzero(np.isfinite(sample.differences((0.0, 0.0)))))
    needed = MIN_FOR_TILT if has_tilt else MIN_FOR_HEIGHT
    if known < needed:
        raise InputError(
            f"{known} places have a height in the surface and in the reference, and {needed} are needed"
            f"{' for a tilt' if has_tilt else ''}. Give more points, or a reference that covers more of the surface."
        )
    fitter = _Fitter.of(sample, has_tilt)
    if is_vertical:
        return fitter.result(fitter.solved(np.zeros(2), None), "it was not asked for")
    if known < MIN_FOR_SHIFT:
        return fitter.result(
            fitter.solved(np.zeros(2), None), f"{known} places are compared, and {MIN_FOR_SHIFT} are needed"
        )
    found = fitter.horizontal(max_shift_m)
    if isinstance(found, str):
        return fitter.result(fitter.solved(np.zeros(2), None), found)
    return found


@dataclass(frozen=True, eq=False)
class _State:
    """values : (5,) m; scale_m : robust standard deviation of the residuals; half_step_m : of the slopes, None where
    the horizontal shift is held."""

    values: FloatArray
    scale_m: float
    half_step_m: float | None
    steps: int = 1


class _Secant:
    """Steps to where a shift no longer changes (Broyden 1965, Mathematics of Computation 19, eq. 4.5, "good" method).

    Slopes that are partly noise make the steps of the equations too short, all by the same factor. What a step has
    changed says how much longer the next one must be.
    """

    def __init__(self) -> None:
        self._inverse: FloatArray = -np.eye(2)
        self._at: FloatArray = np.zeros(2)
        self._change: FloatArray | None = None

    def step(self, at: FloatArray, change: FloatArray) -> FloatArray:
        """The next step (2,) m from a shift, by the step that the equations give there."""
        if self._change is not None:
            moved, changed = at - self._at, change - self._change
            back = moved @ self._inverse
            if abs(back @ changed) > 1e-12:
                self._inverse = self._inverse + np.outer(moved - self._inverse @ changed, back) / (back @ changed)
        self._at, self._change = at, change
        step, limit = -self._inverse @ change, MAX_LENGTHENING * float(np.hypot(*change))
        length = float(np.hypot(*step))
        if not np.isfinite(length) or step @ change <= 0:
            self._inverse = -np.eye(2)
            return change
        return np.asarray(step * min(1.0, limit / length) if length else change)


@dataclass(frozen=True, eq=False)
class _Fitter:
    """A sample with its places about the centre, (n, 2), in units of half the length of the scene."""

    sample: FitSample
    has_tilt: bool
    centre: FloatArray
    half_length_m: float
    relative: FloatArray

    @classmethod
    def of(cls, sample: FitSample, has_tilt: bool) -> _Fitter:
        xy = sample.xy
        low, high = xy.min(axis=0), xy.max(axis=0)
        centre, half = (low + high) / 2, max(float((high - low).max()) / 2, sample.cell_m)
        relative = (xy - centre) / half
        spread = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(relative.T))[0], 0.0))) if len(xy) > 2 else 0.0
        if has_tilt and spread < MIN_TILT_SPREAD:
            raise InputError(
                "The points lie nearly on one line, so the tilt across it is not known. Leave --tilt out, or give "
                "points on both sides."
            )
        return cls(sample, has_tilt, centre, half, relative)

    def horizontal(self, max_shift_m: float) -> SurfaceFit | str:
        """The fit with a horizontal shift; or why that is not known, as a clause."""
        state = self.coarse_to_fine(max_shift_m)
        shift = state.values[:2]
        if not np.hypot(*shift) <= max_shift_m:
            return f"the shift leads further than {max_shift_m:g} m, up to which it is sought (--max-shift)"
        if state.steps > MAX_STEPS:
            return "it does not converge"
        reason = self._why_flat(shift)
        if reason is not None:
            return reason
        fit = self.result(state, None)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(fit.covariance[:2, :2])[-1]))
        limit_m = max(MAX_SIGMA_CELLS * self.sample.cell_m, MAX_SIGMA_SHARE * float(np.hypot(*shift)))
        if not sigma_m <= limit_m:
            return f"it would be known to {sigma_m:.2g} m, and {limit_m:.2g} m are needed"
        if not self._is_lowest(shift):
            return "the differences spread hardly less there than some metres beside"
        return fit if self._agrees(fit, max_shift_m) else "two halves of the scene give different shifts"

    def coarse_to_fine(self, max_shift_m: float) -> _State:
        """The fit from the searched shift on, with slopes over shorter and shorter distances."""
        start = self._searched(max_shift_m)
        least_m = SLOPE_CELLS * self.sample.cell_m
        half_step_m = max(max_shift_m / (2 * SEARCH_STEPS), least_m)
        while True:
            state = self.solved(start, half_step_m)
            if half_step_m == least_m or not np.isfinite(state.values).all():
                return state
            start, half_step_m = state.values[:2], max(half_step_m / 2, least_m)

    def _searched(self, max_shift_m: float) -> FloatArray:
        """The shift of a coarse grid at which half of the differences lie closest together."""
        some, steps = self.sample.some(SEARCH_POINTS), np.linspace(-max_shift_m, max_shift_m, 2 * SEARCH_STEPS + 1)
        shifts = sorted(itertools.product(steps, steps), key=lambda shift: math.hypot(*shift))
        differences = [some.differences(shift) for shift in shifts]
        enough = np.count_nonzero(np.isfinite(differences[0])) / 2
        spreads = [
            shortest_half(one[np.isfinite(one)])[1] if np.count_nonzero(np.isfinite(one)) >= enough else math.inf
            for one in differences
        ]
        return np.array(shifts[int(np.argmin(spreads))])

    def solved(self, shift: FloatArray, half_step_m: float | None) -> _State:
        """The fit from a first shift on. half_step_m : over which slopes are measured; None holds the shift."""
        values, secant = np.array([*shift, 0.0, 0.0, 0.0]), _Secant()
        for step in range(1, MAX_STEPS + 1):
            difference, design = self._equations(values[:2], half_step_m)
            found, scale_m = _robust(design, difference, 0 if half_step_m is None else 2)
            moved = np.zeros(2) if half_step_m is None else secant.step(values[:2], found[:2])
            free = found[2:] if half_step_m is not None else found
            values = np.array([*(values[:2] + moved), *free, *[0.0] * (3 - len(free))])
            if half_step_m is None or np.hypot(*moved) < CONVERGED_M:
                return _State(values, scale_m, half_step_m, step)
            if not np.isfinite(values).all() or np.abs(moved).max() > 1e4:
                break
        is_near = bool(np.hypot(*moved) < NEAR_CELLS * self.sample.cell_m)
        return _State(values, scale_m, half_step_m, MAX_STEPS if is_near else MAX_STEPS + 1)

    def _equations(self, shift: FloatArray, half_step_m: float | None) -> tuple[FloatArray, FloatArray]:
        """Height differences (n,) at a shift, NaN where unknown, and their change (n, k) by the unknowns."""
        difference = self.sample.differences(shift)
        columns = [np.ones((len(difference), 1))]
        if self.has_tilt:
            columns.append(self.relative)
        if half_step_m is not None:
            slope = self.sample.slopes(shift, half_step_m)
            usable = np.isfinite(slope).all(axis=1) & (np.hypot(*slope.T) < MAX_SLOPE)
            difference = np.where(usable, difference, np.nan)
            columns.insert(0, np.where(usable[:, None], -slope, 0.0))
        return difference, np.column_stack(columns)

    def _score(self, values: FloatArray, state: _State) -> tuple[FloatArray, FloatArray]:
        """What each place contributes (n, k) to the equations that the fit solves, and its weight (n,)."""
        difference, design = self._equations(values[:2], state.half_step_m)
        known = np.isfinite(difference)
        vertical = values[2 : 3 + 2 * self.has_tilt]
        residual = np.where(known, difference, 0.0) - design[:, -len(vertical) :] @ vertical
        weight = np.where(known, tukey_weight(residual, state.scale_m), 0.0)
        return design * (weight * residual)[:, None], weight

    def result(self, state: _State, undetermined: str | None) -> SurfaceFit:
        """The fit with its uncertainty."""
        free = [*(() if state.half_step_m is None else (EAST, NORTH)), UP, *((TILT_EAST, TILT_NORTH) * self.has_tilt)]
        score, weight = self._score(state.values, state)
        steps = np.where(np.arange(5) < UP, self._step_m(state), DIFFERENCE_SCALES * state.scale_m)
        jacobian = np.empty((len(free), len(free)))
        for k, unknown in enumerate(free):
            ahead, behind = (state.values + sign * steps * (np.arange(5) == unknown) for sign in (1, -1))
            change = self._score(ahead, state)[0].sum(axis=0) - self._score(behind, state)[0].sum(axis=0)
            jacobian[:, k] = change / (2 * steps[unknown])
        used = weight > 0
        some, n_groups = covariance_of(score[used], jacobian, self.relative[used], self.sample.time_s[used])
        covariance = np.zeros((5, 5))
        covariance[np.ix_(free, free)] = some
        if state.half_step_m is not None:
            covariance[[EAST, NORTH], [EAST, NORTH]] += (INTERPOLATION_CELLS * self.sample.cell_m) ** 2
        return SurfaceFit(
            state.values, covariance, (float(self.centre[0]), float(self.centre[1])), self.half_length_m,
            int(np.count_nonzero(np.isfinite(self.sample.differences(state.values[:2])))), int(np.count_nonzero(used)),
            state.scale_m, state.steps, n_groups, self.has_tilt, undetermined,
        )  # fmt: skip

    def _is_lowest(self, shift: FloatArray) -> bool:
        """Whether differences spread less at a shift than some metres beside it, in every direction.

        It is moved by whole cells, after which interpolation averages noise as much as before.
        """
        cell_m = self.sample.cell_m
        beside_m = cell_m * max(BESIDE_CELLS, round(MAX_SHIFT_M / cell_m))
        ways = np.array([(u, v) for u, v in itertools.product((-1, 0, 1), repeat=2) if u or v])
        return self._spread(shift) * (1 + MIN_SPREAD_RISE) < min(self._spread(shift + way * beside_m) for way in ways)

    def _spread(self, shift: FloatArray) -> float:
        differences = self.sample.differences(shift)
        return median_deviation(differences[np.isfinite(differences)])

    def _agrees(self, fit: SurfaceFit, max_shift_m: float) -> bool:
        """Whether two halves of the scene, a chequerboard of areas, give the same shift, each found on its own.

        Where both surfaces are noise, some shift solves the equations and even looks better than others; in the other
        half of the scene it is another one.
        """
        is_dark, found = area_cells(self.relative, AREAS_OF_HALVES).sum(axis=1) % 2 == 1, list[FloatArray]()
        for chosen in (is_dark, ~is_dark):
            if np.count_nonzero(chosen) < MIN_FOR_SHIFT / 4:
                return False
            half = replace(self, sample=self.sample.where(chosen), relative=self.relative[chosen])
            found.append(half.coarse_to_fine(max_shift_m).values[:2])
        apart_m = float(np.hypot(*(found[0] - found[1])))
        # The difference of two halves has twice the standard deviation of the whole.
        sigma_m = 2 * float(np.sqrt(np.trace(fit.covariance[:2, :2])))
        return apart_m < max(self.sample.cell_m, MAX_APART_SIGMAS * sigma_m)

    def _step_m(self, state: _State) -> float:
        """Step of the horizontal shift over which the equations are differentiated, m.

        It changes heights by a part of their spread, so that weights change little, and is half a cell at most.
        """
        if state.half_step_m is None:
            return self.sample.cell_m / 2
        _, design = self._equations(state.values[:2], state.half_step_m)
        slope = float(np.sqrt(np.mean(design[:, :2] ** 2)))
        return min(self.sample.cell_m / 2, DIFFERENCE_SCALES * state.scale_m / max(slope, 1e-6))

    def _why_flat(self, shift: FloatArray) -> str | None:
        """Why the ground is too flat to tell a horizontal shift, as a clause; None where it is not.

        Slopes over two distances share no cell, so that noise of single cells does not count as relief.
        """
        near, far = (self.sample.slopes(shift, half * SLOPE_CELLS * self.sample.cell_m) for half in (1.0, 2.0))
        known = np.isfinite(near).all(axis=1) & np.isfinite(far).all(axis=1) & (np.hypot(*near.T) < MAX_SLOPE)
        if np.count_nonzero(known) < MIN_FOR_SHIFT:
            return f"fewer than {MIN_FOR_SHIFT} places have a slope"
        one, other = (slope[known] - np.median(slope[known], axis=0) for slope in (near, far))
        common, own = one.T @ other / len(one), one.T @ one / len(one)
        least, direction = (part[..., 0] for part in np.linalg.eigh((common + common.T) / 2))
        spread = math.sqrt(max(float(least), 0.0))
        if spread < MIN_SLOPE_SPREAD:
            return (
                f"the ground is too flat: in one direction its slopes differ by {100 * spread:.1f} %, and "
                f"{100 * MIN_SLOPE_SPREAD:g} % are needed"
            )
        if least < MIN_RELIEF_SHARE * float(direction @ own @ direction):
            return "the slopes of the surface are mostly noise"
        return None


def shortest_half(values: FloatArray) -> tuple[float, float]:
    """Middle and length, m, of the shortest interval that holds half of the values (n,), n > 0 (Rousseeuw 1984)."""
    ordered, half = np.sort(values), len(values) // 2 + 1
    lengths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    # Of several that are equal, the middle one: on level ground all are.
    shortest = np.flatnonzero(lengths <= lengths.min())
    first = int(shortest[len(shortest) // 2])
    return float((ordered[first] + ordered[first + half - 1]) / 2), float(lengths[first])


def tukey_weight(residual: FloatArray, scale_m: float) -> FloatArray:
    """Tukey's biweight (n,) of residuals (n,), from 1 to 0."""
    return np.asarray(np.clip(1 - (residual / (TUKEY_SIGMAS * scale_m)) ** 2, 0, None) ** 2)


def robust_scale(residual: FloatArray) -> float:
    """Standard deviation of normal residuals (n,) by their shortest half: half of them lie within 0.6745 of it."""
    return max(shortest_half(residual)[1] / (2 * 0.6745), MIN_SIGMA_M)


def _robust(design: FloatArray, difference: FloatArray, n_horizontal: int) -> tuple[FloatArray, float]:
    """Unknowns (k,) that fit differences (n,) with a design (n, k), and the scale of the residuals, m."""
    known = np.isfinite(difference)
    if np.count_nonzero(known) <= design.shape[1]:
        return np.full(design.shape[1], np.nan), math.nan
    design, difference = design[known], difference[known]
    found: FloatArray = np.zeros(design.shape[1])
    found[n_horizontal] = shortest_half(difference)[0]
    for _ in range(WEIGHT_ROUNDS):
        residual = difference - design @ found
        scale_m = robust_scale(residual)
        weight = tukey_weight(residual, scale_m)
        normal = design.T @ (design * weight[:, None])
        found = np.asarray(np.linalg.lstsq(normal, design.T @ (difference * weight), rcond=None)[0], np.float64)
    return found, robust_scale(difference - design @ found)
