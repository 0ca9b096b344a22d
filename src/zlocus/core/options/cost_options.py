"""Options of the matching cost."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option, option_by_method, value_of

WINDOW_SIDES = (3, 5, 7, 9, 11)


@dataclass(frozen=True)
class CostOptions(Checked):
    """How images are compared: windows, grey differences and occluded images (method sections 4 and 5)."""

    small_window: int = option(3, "Side of the smaller correlation window.", choices=WINDOW_SIDES, unit="cells")
    large_window: int | None = option_by_method(
        5, 3, "Side of the larger correlation window. The cost takes the mean of its correlation and of the smaller "
        "window's.", choices=WINDOW_SIDES, unit="cells",
    )  # fmt: skip
    max_images_for_large_window: int = option(
        3, "Blocks that more images cover are matched with the smaller window only.", low=1, high=255
    )
    noise_deviation: float = option(
        0.0, "Standard deviation of the noise that is added to every window, as a share of the image's own standard "
        "deviation. It lowers the correlation of windows with little texture.",
        low=0.0, high=1.0,
    )  # fmt: skip
    grey_weight: float = option(
        1.0, "Weight of the grey differences between images beside the correlation, which finds nothing on roofs "
        "without texture. Times 0.3 in blocks that only two of three or more images cover: the grey values of one pair "
        "agree by chance at many heights.",
        low=0.0, high=1.5,
    )  # fmt: skip
    max_grey_difference: float = option(
        0.3, "Grey difference at which two images do not agree at all; larger differences cost no more. A share of the "
        "image's standard deviation.",
        low=0.01, high=10.0,
    )  # fmt: skip
    occluded_pairs_excluded: float | None = option_by_method(
        0.5, 1.0, "How far pairs with an occluded image are excluded from the mean: with 1 the sum over the pairs "
        "that see a cell is divided by their number, with 0 by that of all pairs, else by the geometric mean of both, "
        "with this weight.",
        low=0.0, high=1.0,
    )  # fmt: skip
    occlusion_margin_steps: float | None = option_by_method(
        2.0, 24.0, "An image counts as occluded at heights that lie more than this below its lowest visible height.",
        low=0.0, high=1000.0, unit="steps",
    )  # fmt: skip


def large_window_side(options: CostOptions) -> int:
    """Side of the larger correlation window, in cells: as set, else that of the ground grid."""
    return int(value_of(options, "large_window"))
