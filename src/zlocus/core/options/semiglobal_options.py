"""Options of the semi-global constraint."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option, option_by_method


@dataclass(frozen=True)
class SemiGlobalOptions(Checked):
    """Penalties of the semi-global constraint, in units in which NCC 0 costs 64 (method section 7)."""

    predecessors: int | None = option(
        None, "Neighbours on which each of the eight path costs depends: 1 (semi-global) or 2 (more global, slower). "
        "Unset: 1 where a height step is higher than two cells (narrow bases), else 2.", choices=(1, 2),
    )  # fmt: skip
    p1: int | None = option_by_method(
        100, 20, "Penalty P1 of a height difference of one step between neighbours that two images see. Match curves "
        "of n images are less noisy: there it is divided by n - 1, but not below 45. Where it is unset, it "
        "decreases with the square of the height of a step below 1.35 cells, and the 45 with that height below 1 cell.",
        low=0, high=1000,
    )  # fmt: skip
    p2: int | None = option_by_method(
        400,
        240,
        "Penalty P2 of a larger height difference where the ortho-image has no edge. Where it is unset, it "
        "becomes as low as half where the costs alone find most heights.",
        low=1,
        high=4000,
    )
    p2_edge: int | None = option_by_method(
        45, 100, "Penalty P2 across a strong edge of the ortho-image.", low=1, high=4000
    )
    penalty_factor_per_level: float = option(
        0.85, "Factor by which P2 decreases from each pyramid level to the next coarser one, where a roof has fewer "
        "cells.",
        low=0.1, high=1.0,
    )  # fmt: skip
    edge_contrast: float | None = option_by_method(
        1.0, 2.0, "Grey difference in the ortho-image that halves P2. In units of the tile's median grey difference. "
        "Four times as much in cells that only two images cover: a single pair agrees by chance at many heights.",
        low=0.01, high=1e3,
    )  # fmt: skip
