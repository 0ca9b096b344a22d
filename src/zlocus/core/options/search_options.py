"""Options of pyramid levels, tiles and search ranges."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class PyramidOptions(Checked):
    """Levels, tiles and the range of heights that each block of cells searches (method sections 2 and 3)."""

    max_shift_px: float = option(
        0.5, "Largest shift of the most sensitive image for one height step.", low=0.05, high=2.0, unit="px"
    )
    max_coarsest_steps: int = option(
        128, "Levels are added until the whole height range has at most this many steps at the coarsest level.",
        low=16, high=4096,
    )  # fmt: skip
    max_levels: int = option(6, "Largest number of pyramid levels.", low=1, high=12)
    block: int = option(
        32, "Cells along the side of a block. All cells of a block search the same range of heights.", low=8, high=128
    )
    tile: int = option(
        1024, "Approximate number of cells along the side of a tile, without its halo; up to half as many more.",
        low=64, high=8192,
    )  # fmt: skip
    halo: int = option(
        32, "Cells around a tile that are matched with it at every level and then dropped.", low=8, high=512
    )
    margin_steps: int = option(
        3, "Steps that are added to a search range at both ends.", low=1, high=1000, unit="steps"
    )
    dem_up_m: float = option(
        100.0, "Height above the terrain model of `--dem` up to which is searched.", low=0.0, high=1e4, unit="m"
    )
    dem_down_m: float = option(
        50.0, "Depth below the terrain model of `--dem` down to which is searched.", low=0.0, high=1e4, unit="m"
    )
    finest_level_rounds: int = option(
        1, "Number of times the finest level is matched where three images or more see a tile. Every round after the "
        "first finds occlusions from the heights of the round before.", low=1, high=10,
    )  # fmt: skip
    neighbour_cells: int = option(
        2, "Coarse cells around a block whose heights its search range includes.", low=0, high=64, unit="cells"
    )
