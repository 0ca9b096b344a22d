"""How a surface is compared with a reference: the request of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.evaluation import coregistration
from zlocus.evaluation.slopes import SLOPE_EDGES_DEG, check_slope_edges

COREGISTRATIONS = (coregistration.METHOD,)


@dataclass(frozen=True)
class Comparison:
    """A reference surface and the options of the comparison with it.

    reference : raster of heights. classes : raster of classes on the reference's grid, or None. align : the main
    figures are those after the shift was removed. coregister : method that finds the shift from slope and aspect
    ("nuth-kaab") instead of by a search, which makes the aligned figures the main ones too, or None. margin_m : width
    of the strip along the reference's edge that is left out. threshold_m : errors below it count as within.
    more_thresholds_m : further thresholds. slope_edges_deg : limits between the bands of slope; none: no bands.
    geoid : geoid raster or name that converts heights where the vertical datums differ, see `same_heights`.

    Raises
    ------
    ConfigError
        A margin, threshold or slope out of range, an unknown co-registration, or both kinds of alignment.
    """

    reference: Path
    classes: Path | None = None
    align: bool = False
    margin_m: float = 10.0
    threshold_m: float = 1.0
    more_thresholds_m: Sequence[float] = ()
    slope_edges_deg: Sequence[float] = SLOPE_EDGES_DEG
    coregister: str | None = None
    geoid: Path | None = None

    @property
    def removes_shift(self) -> bool:
        """Whether the main figures are those after the shift was removed."""
        return self.align or self.coregister is not None

    def __post_init__(self) -> None:
        if not self.margin_m >= 0:
            raise ConfigError(f"--margin {self.margin_m:g} is negative. Give 0 or more metres.")
        for threshold_m in (self.threshold_m, *self.more_thresholds_m):
            if not threshold_m > 0:
                raise ConfigError(f"--threshold {threshold_m:g} is not a size. Give a number of metres above 0.")
        if self.coregister is not None and self.coregister not in COREGISTRATIONS:
            raise ConfigError(f"--coregister {self.coregister} is not known. Give {' or '.join(COREGISTRATIONS)}.")
        if self.align and self.coregister is not None:
            raise ConfigError(f"--align and --coregister {self.coregister} both look for the shift. Leave one out.")
        check_slope_edges(self.slope_edges_deg)
