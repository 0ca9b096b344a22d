"""Options of the choice of images."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.errors import ConfigError
from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class SelectionOptions(Checked):
    """Which search images a cell is matched with, in which order, and when they are enough (method section 6)."""

    rho1_high: float = option(
        0.90, "A match curve is good where its highest correlation is above this and its ratio of peaks is above "
        "`ratio_high`.", low=0.0, high=1.0,
    )  # fmt: skip
    ratio_high: float = option(1.2, "Ratio of peaks that goes with `rho1_high`.", low=1.0, high=100.0)
    rho1_middle: float = option(0.80, "The same with `ratio_middle`.", low=0.0, high=1.0)
    ratio_middle: float = option(1.4, "Ratio of peaks that goes with `rho1_middle`.", low=1.0, high=100.0)
    rho1_low: float = option(
        0.65, "The same with `ratio_low`. Above this correlation a curve is at least fair, whatever its ratio.",
        low=0.0, high=1.0,
    )  # fmt: skip
    ratio_low: float = option(1.6, "Ratio of peaks that goes with `rho1_low`.", low=1.0, high=100.0)
    rho1_fair: float = option(
        0.50, "A match curve is fair where its highest correlation is above this and its ratio of peaks is above "
        "`ratio_fair`.", low=0.0, high=1.0,
    )  # fmt: skip
    ratio_fair: float = option(1.4, "Ratio of peaks that goes with `rho1_fair`.", low=1.0, high=100.0)
    second_peak_distance_px: float = option(
        2.0, "A local maximum counts as the second peak from this equivalent disparity to the highest peak on.",
        low=0.0, high=100.0, unit="px",
    )  # fmt: skip
    negative_second_peak: str = option(
        "absolute", "Ratio of peaks where the second peak is negative: of the absolute values, or infinite.",
        choices=("absolute", "infinite"),
    )  # fmt: skip
    min_visible_share: float = option(
        0.5, "A match curve is never good where the image shows a smaller share of its heights.", low=0.0, high=1.0
    )
    neighbours: str = option(
        "radius", "Feature points that order the images of a cell: those within the radius, or the corners of the TIN "
        "triangle around the cell.", choices=("radius", "tin"),
    )  # fmt: skip
    radius_px: float = option(
        100.0, "Feature points within this distance order the images of a cell.", low=1.0, high=1e5, unit="px"
    )
    nearest: int = option(5, "Number of nearest feature points that count where none is within the radius.", low=1,
                          high=1000)  # fmt: skip
    max_radii: float = option(
        5.0, "The nearest feature points count up to this many times the radius; farther away the order of the whole "
        "scene applies.", low=1.0, high=1000.0,
    )  # fmt: skip
    accumulate: str = option(
        "sum", "Value that orders the images: the sum of their labels, or the number of their good labels.",
        choices=("sum", "count"),
    )  # fmt: skip
    stopped_share: float = option(
        0.75, "A block adds images until this share of its sampled cells needs no more.", low=0.0, high=1.0
    )
    max_sigma_steps: float = option(
        0.12, "A cell needs more images while the predicted standard deviation of its peak is larger than this; 1000: "
        "the label alone decides.", low=1e-3, high=1000.0, unit="steps",
    )  # fmt: skip
    reach_steps: int = option(
        40, "Height steps of the finest level, on each side of a point, over which match curves are judged.",
        low=4, high=1000, unit="steps",
    )  # fmt: skip
    feature_cells: int = option(
        24, "Side of the squares in which one tie point is used to order images.", low=1, high=1000, unit="cells"
    )
    min_label_share: float = option(
        0.45, "An image is not used where its accumulated label is below this share of the best image's label.",
        low=0.0, high=1.0,
    )  # fmt: skip
    order: str = option(
        "angle", "Which of the helpful images comes first: the one whose angle to the reference image is nearest to "
        "`best_angle_deg`, or the one with the highest accumulated label.", choices=("angle", "labels"),
    )  # fmt: skip
    min_images: int = option(
        2, "Number of search images that a cell uses, whatever their labels are.", low=1, high=254
    )  # fmt: skip
    max_images: int = option(
        5, "Largest number of search images that a cell is matched with; the refinement uses all helpful ones.",
        low=1, high=254,
    )  # fmt: skip
    max_candidates: int = option(
        24, "Largest number of search images that are considered for a tile.", low=1, high=254
    )  # fmt: skip
    max_images_of_point: int = option(
        6, "Largest number of search images of close cameras that are considered for a point of the ground. Each shows "
        "a part of a tile, so that `max_candidates` does not count for them.", low=1, high=254,
    )  # fmt: skip
    min_overlap: float = option(
        0.2, "Images that see a smaller share of a tile are considered last.", low=0.0, high=1.0
    )
    min_angle_deg: float = option(
        5.0, "Images at a smaller angle to the reference image are considered last.", low=0.0, high=90.0,
        unit="degrees",
    )  # fmt: skip
    best_angle_deg: float = option(
        20.0, "Images at about this angle to the reference image are considered first.", low=0.1, high=90.0,
        unit="degrees",
    )  # fmt: skip
    max_angle_deg: float = option(
        45.0, "Images at a larger angle to the reference image are considered last.", low=1.0, high=180.0,
        unit="degrees",
    )  # fmt: skip
    half_days: float = option(
        60.0, "Days between two exposures that halve the value of an image.", low=0.01, high=1e6, unit="days"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_angle_deg <= self.best_angle_deg <= self.max_angle_deg:
            raise ConfigError(
                f"SelectionOptions.best_angle_deg = {self.best_angle_deg!r} is outside min_angle_deg to "
                f"max_angle_deg = {self.min_angle_deg!r} to {self.max_angle_deg!r} degrees."
            )
