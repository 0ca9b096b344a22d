"""Heights of a patch for the view in three dimensions, and where its surface is broken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.inspector.folder import Patch, SurfaceFolder, read_patch
from zlocus.matching.height_checks import MAX_DIFFERENCE_WITHOUT_JUMP_STEPS

# Neighbouring places are not joined where their heights differ by more than a jump, as for the flag JUMP, and by more
# than this slope explains, m per m: places may be many cells apart.
MAX_SLOPE = 1.5
# Bits of a place: the surface is broken between it and the next one in its row, and in its column.
TO_RIGHT, TO_BELOW = np.uint8(1), np.uint8(2)


@dataclass(frozen=True)
class BrokenRelief:
    """Heights (r, c) float32 m, NaN where there is none, and breaks (r, c) uint8, see `TO_RIGHT` and `TO_BELOW`."""

    heights: NDArray[np.float32]
    breaks: NDArray[np.uint8]

    @property
    def content(self) -> bytes:
        """Heights, then breaks, row by row, as the page reads them."""
        return self.heights.astype("<f4").tobytes() + self.breaks.tobytes()


def relief_of(folder: SurfaceFolder, patch: Patch) -> BrokenRelief:
    """Heights and breaks of a patch of a surface."""
    heights = read_patch(folder.path("dsm"), patch, average=True).values[0].astype(np.float32)
    spacing_m = folder.cell_m * patch.cols / patch.width, folder.cell_m * patch.rows / patch.height
    return BrokenRelief(heights, breaks_of(heights, spacing_m, jump_m(folder)))


def jump_m(folder: SurfaceFolder) -> float:
    """Height difference of neighbouring cells from which on they are at a jump, m."""
    step_m = folder.run.get("heights", {}).get("step_m", folder.cell_m)
    return MAX_DIFFERENCE_WITHOUT_JUMP_STEPS * float(step_m)


def breaks_of(heights: NDArray[np.float32], spacing_m: tuple[float, float], jump_m: float) -> NDArray[np.uint8]:
    """Where a surface is broken, (r, c) uint8, see `BrokenRelief`.

    heights : (r, c) m; spacing_m : between places along a row and along a column; jump_m : see `jump_m`.
    """
    breaks = np.zeros(heights.shape, np.uint8)
    for axis, spacing, bit in ((1, spacing_m[0], TO_RIGHT), (0, spacing_m[1], TO_BELOW)):
        here, there = (np.s_[:, :-1], np.s_[:, 1:]) if axis else (np.s_[:-1], np.s_[1:])
        with np.errstate(invalid="ignore"):
            is_broken = np.abs(heights[here] - heights[there]) > max(jump_m, MAX_SLOPE * spacing)
        breaks[here] |= np.where(is_broken, bit, np.uint8(0))
    return breaks
