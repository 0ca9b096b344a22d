"""Options of the matching cost."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class MeasureOptions(Checked):
    """How views are compared (method sections 1 and 5)."""

    small_window: int = option(3, "Side of the smaller correlation window.", choices=(3, 5, 7, 9, 11), unit="cells")
    large_window: int = option(
        5, "Side of the larger correlation window, whose NCC is averaged with the smaller's.",
        choices=(3, 5, 7, 9, 11), unit="cells",
    )  # fmt: skip
    few_views: int = option(
        3, "Blocks that more images see are matched with the smaller window alone.", low=1, high=255
    )
    noise: float = option(
        0.0, "Standard deviation added to every window, as a share of the image's own: damps plain windows.",
        low=0.0, high=1.0,
    )  # fmt: skip
    grey_weight: float = option(
        1.0, "Weight of grey differences between views beside the correlation, which is blind on plain roofs.",
        low=0.0, high=1.5,
    )  # fmt: skip
    grey_weight_two: float = option(
        0.3, "The same where two of more views see a block: a pair's grey values are alike by chance at many heights.",
        low=0.0, high=1.5,
    )  # fmt: skip
    grey_reach: float = option(
        0.3, "Grey difference from which on two views are strangers, as a share of the image's deviation.",
        low=0.01, high=10.0,
    )  # fmt: skip
    hidden_excused: float = option(
        0.5, "Share of the pairs with a hidden view that is left out; the others count as uncorrelated.",
        low=0.0, high=1.0,
    )  # fmt: skip
    hidden_margin_steps: float = option(
        2.0, "A view counts as hidden this far below what hides it.", low=0.0, high=1000.0, unit="steps"
    )
