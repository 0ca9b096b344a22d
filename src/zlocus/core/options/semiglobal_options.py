"""Options of the semi-global constraint."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class SemiGlobalOptions(Checked):
    """Penalties of the semi-global constraint, in cost units: 64 is the cost of NCC 0 (method section 5)."""

    predecessors: int | None = option(
        None, "Neighbours that each of the eight paths draws on: 1 (semi-global) or 2 (more global, slower); unset: 1 "
        "where a height step is higher than two cells (narrow bases), else 2.", choices=(1, 2),
    )  # fmt: skip
    p1: int = option(45, "Penalty of a neighbour one step away.", low=0, high=1000)
    p1_two: int = option(
        110, "The same in scenes of two images: one pair's curves are noisy.",
        low=0, high=1000,
    )  # fmt: skip
    p2: int = option(400, "Penalty of a jump where the ortho-image is even.", low=1, high=4000)
    p2_edge: int = option(45, "Penalty of a jump across a strong edge of the ortho-image.", low=1, high=4000)
    level_easing: float = option(
        0.85, "Penalties of jumps are eased by this at every coarser level, where a roof has fewer cells.",
        low=0.1, high=1.0,
    )  # fmt: skip
    edge_contrast: float = option(
        1.0, "Grey difference that halves the penalty of a jump, in median differences of the tile.",
        low=0.01, high=1e3,
    )  # fmt: skip
    edge_contrast_two: float = option(
        4.0,
        "The same where only two views see a cell: one pair is alike by chance at many heights.",
        low=0.01,
        high=1e3,
    )
