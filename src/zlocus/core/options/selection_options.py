"""Options of the choice of images."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.errors import ConfigError
from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class SelectionOptions(Checked):
    """Which search images a cell is matched with, in which order, and when they are enough (method sections 2 to 4)."""

    rho1_high: float = option(0.90, "Good above this largest correlation and `ratio_high`.", low=0.0, high=1.0)
    ratio_high: float = option(1.2, "Good above this ratio of peaks and `rho1_high`.", low=1.0, high=100.0)
    rho1_middle: float = option(0.80, "Good above this largest correlation and `ratio_middle`.", low=0.0, high=1.0)
    ratio_middle: float = option(1.4, "Good above this ratio of peaks and `rho1_middle`.", low=1.0, high=100.0)
    rho1_low: float = option(
        0.65, "Good above this largest correlation and `ratio_low`, fair above it at any ratio.", low=0.0, high=1.0
    )
    ratio_low: float = option(1.6, "Good above this ratio of peaks and `rho1_low`.", low=1.0, high=100.0)
    rho1_fair: float = option(0.50, "Fair above this largest correlation and `ratio_fair`.", low=0.0, high=1.0)
    ratio_fair: float = option(1.4, "Fair above this ratio of peaks and `rho1_fair`.", low=1.0, high=100.0)
    rival_px: float = option(
        2.0, "Equivalent disparity from the peak at which another maximum is a rival.", low=0.0, high=100.0, unit="px"
    )
    negative_rival: str = option(
        "absolute", "Ratio to a rival of no positive correlation: of absolute values, or infinite.",
        choices=("absolute", "infinite"),
    )  # fmt: skip
    least_seen: float = option(
        0.5, "A curve seen over a smaller share of its heights is never good.", low=0.0, high=1.0
    )
    neighbours: str = option(
        "radius", "Feature points that order the images of a cell: those within the radius, or the corners of the TIN "
        "triangle around it.", choices=("radius", "tin"),
    )  # fmt: skip
    radius_px: float = option(
        100.0, "Distance within which feature points order the images of a cell.", low=1.0, high=1e5, unit="px"
    )
    nearest: int = option(5, "Feature points taken where none is within the radius.", low=1, high=1000)
    widest: float = option(
        5.0, "Those are looked for within so many radii; beyond, the order of the whole scene holds.",
        low=1.0, high=1000.0,
    )  # fmt: skip
    accumulate: str = option(
        "sum", "What orders images: the sum of their labels, or the count of those that are good.",
        choices=("sum", "count"),
    )  # fmt: skip
    stopped_share: float = option(
        0.75, "A block adds images until this share of its sampled cells has stopped.", low=0.0, high=1.0
    )
    sigma_steps: float = option(
        0.12, "A cell stops only where its peak is predicted to this standard deviation; 1000: by its label alone.",
        low=1e-3, high=1000.0, unit="steps",
    )  # fmt: skip
    reach_steps: int = option(
        40, "Labels are judged over so many heights of the finest level to both sides.", low=4, high=1000, unit="steps"
    )
    feature_cells: int = option(
        24, "One tie point ranks the images in a square of this side.", low=1, high=1000, unit="cells"
    )
    least_worth: float = option(
        0.45, "An image is left out where its accumulated label is below this share of the best one's.",
        low=0.0, high=1.0,
    )  # fmt: skip
    order: str = option(
        "angle", "Which of the images that help comes first: that whose angle to the reference is nearest to "
        "`best_angle_deg`, or that of the highest accumulated label.", choices=("angle", "labels"),
    )  # fmt: skip
    fewest_views: int = option(7, "Where fewer images see a tile, all are used.", low=3, high=255)
    least_images: int = option(2, "Search images that are kept whatever their labels say.", low=1, high=254)
    most_images: int = option(
        5, "Search images a cell is matched with at most; the refinement takes all that help.", low=1, high=254
    )
    candidates: int = option(12, "Search images considered for a block, at most.", low=1, high=254)
    least_overlap: float = option(
        0.2, "Images that see a smaller share of a block are considered last.", low=0.0, high=1.0
    )
    least_angle_deg: float = option(
        5.0, "Images at a smaller angle to the reference are considered last.", low=0.0, high=90.0, unit="degrees"
    )
    best_angle_deg: float = option(
        20.0, "Images at about this angle to the reference are considered first.", low=0.1, high=90.0, unit="degrees"
    )
    most_angle_deg: float = option(
        45.0, "Images at a larger angle to the reference are considered last.", low=1.0, high=180.0, unit="degrees"
    )
    half_days: float = option(
        60.0, "Days between two images that halve the worth of matching them.", low=0.01, high=1e6, unit="days"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.least_angle_deg <= self.best_angle_deg <= self.most_angle_deg:
            raise ConfigError(
                f"SelectionOptions.best_angle_deg = {self.best_angle_deg!r} is outside least_angle_deg to "
                f"most_angle_deg = {self.least_angle_deg!r} to {self.most_angle_deg!r} degrees."
            )
