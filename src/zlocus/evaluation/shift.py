"""Shift of a surface against its reference, by the method that a comparison asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.alignment import determined_shift
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.coregistration import CONVERGED_SHIFT_M, coregister
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.truth import TruthBlocks

SEARCH = "search"


@dataclass(frozen=True)
class Shift:
    """Position of the surface relative to the reference, m; it is removed before aligned errors are computed.

    method : that found it. steps, sigma_m : iterations until convergence, and standard error, m; None for a search.
    undetermined : why the horizontal part is not known, as a clause; then it is 0, and only the height is removed.
    """

    east_m: float
    north_m: float
    up_m: float
    method: str = SEARCH
    steps: int | None = None
    sigma_m: float | None = None
    undetermined: str | None = None

    @property
    def enu_m(self) -> tuple[float, float, float]:
        """East, north and up, m."""
        return self.east_m, self.north_m, self.up_m

    @property
    def is_horizontal(self) -> bool:
        """Whether the surface lies beside the reference by a millimetre or more, so that heights are interpolated."""
        return math.hypot(self.east_m, self.north_m) >= CONVERGED_SHIFT_M

    def as_dict(self) -> dict[str, float | None]:
        """East, north and up as JSON holds them: None in place of what is not determined."""
        is_known = self.undetermined is None
        return {
            "east": self.east_m if is_known else None, "north": self.north_m if is_known else None, "up": self.up_m,
        }  # fmt: skip


def shift_record(shift: Shift | None) -> dict[str, Any]:
    """A shift and how it was found, as JSON holds them; None for no shift."""
    return {
        "shift_m": None if shift is None else shift.as_dict(),
        "shift_method": None if shift is None else shift.method,
        "shift_steps": None if shift is None else shift.steps,
        "shift_sigma": None if shift is None else shift.sigma_m,
    }


def horizontal_shift(surface: HeightRaster, truth: TruthBlocks, points: Points, comparison: Comparison) -> Shift:
    """Shift of the surface east and north; its height is 0 here. points : centres of the blocks in the surface's CRS.

    Raises
    ------
    InputError
        See `coregister`, where the comparison asks for it.
    """
    if comparison.coregister is not None:
        fit = coregister(surface, truth, points)
        return Shift(fit.east_m, fit.north_m, 0.0, comparison.coregister, fit.steps, fit.sigma_m)
    found = determined_shift(surface, truth, points)
    return Shift(0.0, 0.0, 0.0, undetermined=found) if isinstance(found, str) else Shift(*found, 0.0)


def heights_without(shift: Shift | None, surface: HeightRaster, points: Points) -> FloatArray:
    """Heights (n,) m of a surface at points, after its shift was removed: those between cells where it is horizontal.

    Where there is no horizontal shift, the surface is looked up as it lies, in the cell that holds the point.
    """
    if shift is None:
        return points.heights(surface, HeightRaster.nearest)
    if not shift.is_horizontal:
        return points.heights(surface, HeightRaster.nearest) - shift.up_m
    return points.heights(surface, HeightRaster.bilinear, (shift.east_m, shift.north_m)) - shift.up_m
