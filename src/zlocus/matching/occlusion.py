"""Between which heights each view sees each cell: inside the image, on valid pixels, not hidden by the surface."""

from __future__ import annotations

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import HIDDEN
from zlocus.matching.kernels.coverage import tile_reach
from zlocus.matching.kernels.occlusion import count_seeing, hide_below, lowest_visible
from zlocus.matching.slope_surface import BaseSurface
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_directions import cells_per_step, parts_of_one_direction

IntVolume = NDArray[np.int32]
BORDER_PX = 3.0
NOTHING_HIDDEN = -(2**29)
# Views that a height takes.
PAIR = 2


def coverage(views: TileViews, base: BaseSurface, lattice: HeightLattice, border_px: float = BORDER_PX) -> IntVolume:
    """(3, i, r, c) int32: lowest and highest height index at which each image covers each cell, and from where on
    nothing hides it (everywhere, for now).

    A view takes part over the longest run of heights whose windows lie inside the image and on valid pixels; at other
    heights it counts like a hidden one. (Asking for the whole range would empty the borders of every image by the
    parallax of the range.) views : whose nodes follow `base`, from which heights are counted; border_px : of the images
    that is not looked at.
    """
    seen = np.empty((3, len(views.layout), *lattice.shape), np.int32)
    seen[2] = NOTHING_HIDDEN
    tile_reach(
        views.blocked, views.has_blocked, views.layout, views.nodes, views.heights, lattice.ranges, views.limits,
        lattice.block, border_px, base.relief, seen[0], seen[1],
    )  # fmt: skip
    return seen


def left_out(views: TileViews, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Cells (r, c) of which a view that may show them was left out: see `TileViews.lost`."""
    return _cells_of(np.asarray(views.lost.any(axis=0)), views.block, shape)


def _cells_of(blocks: NDArray[np.bool_], block: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """What holds for blocks (..., b, d), for cells (..., r, c)."""
    rows, cols = shape
    return blocks.repeat(block, axis=-2).repeat(block, axis=-1)[..., :rows, :cols]


def hide(
    seen: IntVolume,
    views: TileViews,
    surface: NDArray[np.float32],
    base: NDArray[np.float32],
    margin_steps: float,
    first: tuple[int, int] = (0, 0),
) -> None:
    """Set the lowest visible height of every view to what `surface` lets it see; changes `seen`.

    surface : float32 height indices of what may stand in the way, a lower bound of it, on the cells of the tile and,
    where some are known, of those around it; base : (r, c) float32, the base surface that the indices of `seen` are
    counted from; first : row and column of the tile's first cell in `surface`.
    """
    lowest, begin = np.empty(surface.shape, np.float32), np.array(first)
    for i in range(len(views.layout)):
        for part in parts_of_one_direction(views, i):
            lowest_visible(surface, *cells_per_step(views, i, part), lowest)
            ends = np.array([span.indices(n)[:2] for span, n in zip(part, base.shape, strict=True)])
            hide_below(lowest, begin, base, np.float32(margin_steps), np.float32(NOTHING_HIDDEN), ends, seen[2, i])


def spare_pairs(seen: IntVolume) -> None:
    """Take back what hides a view from cells that two views cover; changes `seen`.

    There neither can be spared: hidden by a false height as likely as by a true one, nothing is left that could tell.
    """
    seen[2][:, covers(seen).sum(axis=0) <= PAIR] = NOTHING_HIDDEN


def sees(seen: IntVolume, height: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which views see the cells at the given height indices. seen : (3, ..., r, c); height : (..., r, c)."""
    return np.asarray((seen[0] <= height) & (height <= seen[1]) & (seen[2] <= height))


def n_seeing(seen: IntVolume, height: NDArray[np.float32]) -> NDArray[np.int32]:
    """How many views see each cell at its height index, (r, c). seen : (3, i, r, c); height : (r, c)."""
    count = np.empty(height.shape, np.int32)
    count_seeing(seen, height, count)
    return count


def covers(seen: IntVolume) -> NDArray[np.bool_]:
    """Which views cover the cells at any height. seen : (3, ..., r, c)."""
    return np.asarray(seen[0] <= seen[1])


def above_base(seen: IntVolume, base: NDArray[np.float32]) -> IntVolume:
    """`seen`, counted from a base surface (r, c), counted from the lattice's origin, to half a step; changes `seen`."""
    never = ~covers(seen)
    seen += np.rint(base).astype(np.int32)
    seen[0][never], seen[1][never] = HIDDEN, NOTHING_HIDDEN
    return seen


def metres_per_cell(transform: Affine) -> float:
    """Side of a cell."""
    return float(np.hypot(transform.a, transform.d))
