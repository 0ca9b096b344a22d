"""Options of sub-step heights, of planes through plain segments, and of the checks that leave cells empty."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class RefineOptions(Checked):
    """The last pass: sub-step heights from windows that follow the surface (method section 6)."""

    window: int | None = option(
        None,
        "Side of the correlation window; unset: 9 where a height step is higher than two cells (narrow bases, noise "
        "rules), else 7 (relief within the window rules).",
        choices=(3, 5, 7, 9, 11, 13),
        unit="cells",
    )
    rounds: int = option(2, "Times the surface is smoothed and measured again.", low=0, high=10)
    jump_steps: float = option(
        2.0, "Height difference that smoothing does not bridge.", low=0.5, high=100.0, unit="steps"
    )
    reach_steps: float = option(
        1.5, "A refined height stays this close to the semi-global one, else that is kept.", low=0.1, high=10.0,
        unit="steps",
    )  # fmt: skip


@dataclass(frozen=True)
class PlaneOptions(Checked):
    """Planes in place of the heights of plain segments, such as roofs without texture (method section 6)."""

    texture: float = option(
        0.4, "Grey deviation below which a cell is plain, as a share of the tile's median; 0: no planes.",
        low=0.0, high=1.0,
    )  # fmt: skip
    least_cells: int = option(60, "Cells of a plain segment, at least.", low=10, high=100000)
    most_cells: int = option(20000, "Cells of a plain segment, at most.", low=10, high=1000000)
    longest_cells: float = option(
        160.0, "Longer side of a plain segment, at most: a street follows the ground.", low=4.0, high=1e4, unit="cells"
    )
    least_filled: float = option(
        0.6, "Share of a rectangle of its extent that a plain segment fills, at least.", low=0.0, high=1.0
    )
    noise: float = option(
        0.3, "Grey difference between views that says little, as a share of the tile's median deviation.",
        low=0.01, high=10.0,
    )  # fmt: skip
    most_cost: float = option(
        0.2, "A segment is plain, and a plane right, where views differ by less than this within, in noise squared.",
        low=0.0, high=10.0,
    )  # fmt: skip
    near_steps: float = option(
        3.0, "A height confirms a plane that is nearer than this.", low=0.1, high=100.0, unit="steps"
    )
    least_near: float = option(
        0.8, "Share of the cells that confirm a plane, at least; half of them where the views agree better on it.",
        low=0.5, high=1.0,
    )  # fmt: skip
    most_slope_steps: float = option(0.8, "Slope of a plane, at most, in steps per cell.", low=0.0, high=100.0)


@dataclass(frozen=True)
class CheckOptions(Checked):
    """When a cell stays empty, or is marked as doubtful."""

    least_ncc: float = option(
        -0.2, "A cell is left empty below this mean NCC: less than plain roofs give, where noise decides.",
        low=-1.0, high=1.0,
    )  # fmt: skip
    doubtful_ncc: float = option(0.3, "A cell is marked as weak below this mean NCC.", low=-1.0, high=1.0)
    disputed_steps: float = option(
        1.0, "A cell is marked as disputed where the heights of two groups of pairs of images are farther apart around "
        "it.", low=0.0, high=100.0, unit="steps",
    )  # fmt: skip
    rival_cost: int = option(
        64, "A cell is marked as ambiguous when another height costs less than this more over the eight paths.",
        low=0, high=10000,
    )  # fmt: skip
    most_spread_steps: float = option(
        8.0, "At the border of the ground that images share, a cell is left empty where the standard deviations of the "
        "heights around it (geometric mean over 5 x 5 cells) are larger than this: such heights are noise.",
        low=0.1, high=1e4, unit="steps",
    )  # fmt: skip
    most_sigma_m: float | None = option(
        None, "A cell of a surface is left empty where the standard deviation of its height is larger; unset: none is.",
        low=1e-6, high=1e5, unit="m",
    )  # fmt: skip
