"""Options of pyramid levels, tiles and search ranges."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class PyramidOptions(Checked):
    """Levels, tiles and the range of heights that each block of cells searches (method sections 1, 6 and 9)."""

    max_shift_px: float = option(
        0.5, "Shift per height step in the most sensitive image, at most.", low=0.05, high=2.0, unit="px"
    )
    coarsest_steps: int = option(
        128, "Levels are added until the whole height range has at most this many steps at the coarsest.",
        low=16, high=4096,
    )  # fmt: skip
    max_levels: int = option(6, "Levels of the pyramid, at most.", low=1, high=12)
    block: int = option(32, "Cells along the side of a block, which shares one range of heights.", low=8, high=128)
    tile: int = option(
        1024, "Cells along the side of a tile's core, about: up to half as many more.", low=64, high=8192
    )
    halo: int = option(32, "Cells around a tile's core at every level, matched for its sake.", low=8, high=512)
    margin_steps: int = option(
        3, "Steps added at both ends of what a coarser level found.", low=1, high=1000, unit="steps"
    )
    dem_up_m: float = option(100.0, "Searched above a DEM given as --dem.", low=0.0, high=1e4, unit="m")
    dem_down_m: float = option(50.0, "Searched below a DEM given as --dem.", low=0.0, high=1e4, unit="m")
    finest_rounds: int = option(
        1,
        "Times the finest level is matched where three views or more see a tile; the later know what hides what.",
        low=1,
        high=10,
    )
    reach: int = option(2, "Coarse cells around a block whose heights it searches too.", low=0, high=64, unit="cells")
