"""Options of the matching cost."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option

WINDOW_SIDES = (3, 5, 7, 9, 11)
# Side of the larger correlation window on the ground grid where the option leaves it to the method.
GROUND_LARGE_WINDOW = 5


@dataclass(frozen=True)
class CostOptions(Checked):
    """How images are compared: windows, grey differences and occluded images (method sections 4 and 5)."""

    small_window: int = option(3, "Side of the smaller correlation window.", choices=WINDOW_SIDES, unit="cells")
    large_window: int | None = option(
        None, "Side of the larger correlation window. The cost takes the mean of its correlation and of the smaller "
        "window's. Unset: decided by the method, 5 on the ground grid, 3 for depths in image space.",
        choices=WINDOW_SIDES, unit="cells",
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
        "without texture.",
        low=0.0, high=1.5,
    )  # fmt: skip
    grey_weight_two_images: float = option(
        0.3, "The same weight in blocks that only two of three or more images cover: the grey values of one pair agree "
        "by chance at many heights.",
        low=0.0, high=1.5,
    )  # fmt: skip
    max_grey_difference: float = option(
        0.3, "Grey difference at which two images do not agree at all; larger differences cost no more. A share of the "
        "image's standard deviation.",
        low=0.01, high=10.0,
    )  # fmt: skip
    occluded_pairs_excluded: float = option(
        0.5, "Share of the pairs with an occluded image that is excluded from the mean; the other such pairs count as "
        "uncorrelated.",
        low=0.0, high=1.0,
    )  # fmt: skip
    occlusion_margin_steps: float = option(
        2.0, "An image counts as occluded at heights that lie more than this below its lowest visible height.",
        low=0.0, high=1000.0, unit="steps",
    )  # fmt: skip


def large_window_side(options: CostOptions) -> int:
    """Side of the larger correlation window, in cells: as set, else `GROUND_LARGE_WINDOW`.

    Depths in image space have a default of their own, which `image_space.depth_options` fills in where the option is
    unset.
    """
    return GROUND_LARGE_WINDOW if options.large_window is None else options.large_window
