"""Options of sub-step heights, of planes through plain segments, and of the checks that leave cells empty."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option, option_by_method


@dataclass(frozen=True)
class RefineOptions(Checked):
    """The last stage: sub-step heights from windows that follow the surface (method section 9)."""

    window: int | None = option(
        None,
        "Side of the correlation window. Unset: 9 where a height step is higher than two cells (narrow bases, where "
        "noise prevails), else 7 (wide bases, where the relief within the window prevails).",
        choices=(3, 5, 7, 9, 11, 13),
        unit="cells",
    )
    rounds: int = option(2, "Number of times that the surface is smoothed and refined again.", low=0, high=10)
    jump_steps: float = option(
        2.0, "Height difference from which on the surface is not smoothed across.", low=0.5, high=100.0, unit="steps"
    )
    max_correction_steps: float = option(
        1.5, "Largest difference between a refined height and the semi-global height. Beyond it the semi-global height "
        "is kept.", low=0.1, high=10.0, unit="steps",
    )  # fmt: skip
    max_plane_side: int | None = option_by_method(
        17, 0, "Side of the largest windows whose heights are smoothed by a plane where it explains them within their "
        "precision. 0: no smoothing.",
        choices=(0, 5, 9, 17, 33), unit="cells",
    )  # fmt: skip
    median_sigma_steps: float = option(
        2.0, "Standard deviation above which a height is replaced by the weighted median of those around it. "
        "1e6: never.",
        low=0.0, high=1e6, unit="steps",
    )  # fmt: skip


@dataclass(frozen=True)
class PlaneOptions(Checked):
    """Planes that replace the heights of plain segments, such as roofs without texture (method section 8)."""

    texture: float = option(
        0.4, "Grey deviation below which a cell is plain, as a share of the tile's median deviation. 0: no planes.",
        low=0.0, high=1.0,
    )  # fmt: skip
    min_cells: int = option(60, "Smallest number of cells of a plain segment.", low=10, high=100000)
    max_cells: int = option(20000, "Largest number of cells of a plain segment.", low=10, high=1000000)
    max_length_cells: float = option(
        160.0, "Longest side of a plain segment. Longer ones are streets, which follow the ground.",
        low=4.0, high=1e4, unit="cells",
    )  # fmt: skip
    min_filled_share: float = option(
        0.6, "Smallest share of its enclosing rectangle that a plain segment fills.", low=0.0, high=1.0
    )
    noise: float = option(
        0.3, "Grey difference between images that is noise, as a share of the tile's median deviation.",
        low=0.01, high=10.0,
    )  # fmt: skip
    max_cost: float = option(
        0.2, "A segment is plain, and a plane fits it, where the images differ by less than this within the segment. "
        "In units of the noise squared.",
        low=0.0, high=10.0,
    )  # fmt: skip
    max_cost_increase: float | None = option_by_method(
        0.02, 0.05, "By how much worse the images may agree on a plane than on the matched heights: one plane through "
        "a roof of two pitches is only a little worse. In units of the noise squared.",
        low=0.0, high=10.0,
    )  # fmt: skip
    near_steps: float = option(
        3.0, "A matched height supports a plane that is closer than this.", low=0.1, high=100.0, unit="steps"
    )
    min_near_share: float = option(
        0.8, "Smallest share of the cells that have to support a plane. Half of the cells are enough where the images "
        "agree better on the plane than on the matched heights.",
        low=0.5, high=1.0,
    )  # fmt: skip
    min_share_below: float | None = option_by_method(
        0.5, 0.0, "Smallest share of the cells around a segment that lies 3 steps or more below its plane. Roofs stand "
        "above their surroundings; on roads and on the ground a plane is worse than the matched heights. 0: planes "
        "replace the heights of plain segments everywhere.",
        low=0.0, high=1.0,
    )  # fmt: skip
    max_slope_steps: float = option(
        0.8, "Largest slope of a plane, in height steps per cell.", low=0.0, high=100.0, unit="steps per cell"
    )


@dataclass(frozen=True)
class CheckOptions(Checked):
    """Limits beyond which a cell has no height, or is marked as doubtful."""

    min_ncc: float = option(
        -0.2, "A cell has no height where the mean NCC of the images over 9 x 9 cells is below this; next to a jump "
        "in height, where its own is. Ground without texture has a higher one; below it the images contradict each "
        "other.",
        low=-1.0, high=1.0,
    )  # fmt: skip
    weak_ncc: float = option(0.3, "A cell is marked as WEAK below this mean NCC.", low=-1.0, high=1.0)
    disputed_steps: float = option(
        1.0, "A cell is marked as DISPUTED where the heights of two groups of image pairs differ by more than this "
        "around it.", low=0.0, high=100.0, unit="steps",
    )  # fmt: skip
    uncertain_sigma_steps: float = option(
        1.0, "A cell is marked as DISPUTED or UNREFINED only where its standard deviation is larger than this: the "
        "standard deviation weighs all signs of a wrong height, these two among them.",
        low=0.0, high=100.0, unit="steps",
    )  # fmt: skip
    min_uniqueness: int = option(
        64, "A cell is marked as AMBIGUOUS when the path costs of another height, summed over the eight paths, are "
        "larger by less than this.",
        low=0, high=10000,
    )  # fmt: skip
    max_overlap_edge_sigma_steps: float = option(
        8.0, "At the edge of the overlap of the images, a cell has no height where the standard deviations around it "
        "(geometric mean over 5 x 5 cells) are larger than this: such heights are noise.",
        low=0.1, high=1e4, unit="steps",
    )  # fmt: skip
    max_sigma_m: float | None = option(
        None, "A cell of the surface has no height where its standard deviation is larger. Unset: 40 sides of a cell, "
        "where two thirds of the heights are wrong; no limit without the semi-global constraint, and for depths in "
        "image space.",
        low=1e-6, high=1e5, unit="m",
    )  # fmt: skip
