"""Options of water surfaces: their levels, and where water is possible."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class WaterOptions(Checked):
    """Levels of water surfaces, and areas in which the images say nothing and whose surroundings are flat."""

    shore_cells: float = option(
        5.0, "The level is found from heights this close to the outline, on both sides: within about half of a "
        "correlation window, which therefore holds the edge between water and land. Farther out on the water, heights "
        "are noise.",
        low=1.0, high=50.0, unit="cells",
    )  # fmt: skip
    min_shore_cells: int = option(
        60, "Fewest cells with a confident height from which a level is found: a pond of 3 m across has as many at "
        "its shore, with cells of 0.5 m.",
        low=5, high=100000, unit="cells",
    )  # fmt: skip
    min_inside_share: float = option(
        0.5, "Share of a water surface that must have confident heights for the level to be their median: ice and "
        "plants on the water are matched like ground, moving water never is.",
        low=0.05, high=1.0,
    )  # fmt: skip
    min_area_m2: float = option(
        400.0, "Possible water: least area. Smaller ones are mostly shadows, cars and single crowns.",
        low=0.0, high=1e9, unit="m2",
    )  # fmt: skip
    min_unmatched_share: float = option(
        0.9, "Possible water: share of the cells around a place where the images do not agree at any height. In "
        "forests it is about a half, on water nearly all.",
        low=0.5, high=1.0,
    )  # fmt: skip
    max_rim_m: float = option(
        1.0, "Possible water: most of its surroundings lie at most this much lower than its rim, whose lowest heights "
        "differ by half as much, and most of the area stands at most this much above it. Roofs and slopes do not.",
        low=0.01, high=100.0, unit="m",
    )  # fmt: skip
