"""Slanted support surface of a level: heights are searched along it, so that windows and penalties see a slope as
level.

Level correlation windows see a slope as a step from cell to cell, and the semi-global constraint makes stairs of it.
The slanted support surface has the slopes of the coarser level's surface (medians over patches, which jumps do not
affect) and none of its jumps. A slope index of k means k steps above it (`zlocus.matching.height_lattice`). The surface
is continuous, and bilinear between the corners of patches, so that neighbours are still compared by height. It does not
follow buildings: where the ground is level the surface is nearly level.

It must not depend on how far the halo of a tile reaches, because it decides at which heights views are compared. So a
level starts from the slanted support surface of the coarser level and corrects it from patches nearby only, and its
corners lie whole steps high: small differences between two tiles then make no difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.polynomials import shift_bends, shift_nodes
from zlocus.matching.kernels.smooth import slopes
from zlocus.matching.median import median
from zlocus.matching.tile_views import TileViews

PATCH = 8  # cells along the side of a patch
SLOPE_REACH = 4  # cells to both sides over which a slope is measured
ROUNDS, DAMPING = 6, 0.8  # of the relaxation
# The height of a corner at the coarsest level is a median over this many patches on each side of it.
PATCHES_AROUND_CORNER = 3
# A surface is steep where it rises by more than this many steps from one corner of a block to the next.
STEEP_STEPS = 8.0


@dataclass(frozen=True)
class CoarserSlope:
    """The slanted support surface of the coarser level under a window of the finer level.

    slope_surface : in cells and level indices of the coarser level; row, col : of the coarser window, minus half the
    row and column of the finer window.
    """

    slope_surface: SlopeSurface
    row: float
    col: float

    def corners(self, n_patches: tuple[int, int], patch: int) -> NDArray[np.float64]:
        """Level indices of the finer level at the corners of its patches, (p + 1, q + 1)."""
        rows, cols = (
            (np.arange(n + 1) * patch + 0.5) / 2 - 0.5 - first
            for n, first in zip(n_patches, (self.row, self.col), strict=True)
        )
        return 2 * self.slope_surface.at(rows, cols)


@dataclass(frozen=True)
class SlopeSurface:
    """Slanted support surface over the cells of a tile: level indices of a continuous surface, with fractions.

    patch_corners : (p + 1, q + 1) float64, level indices at the corners of patches; patch : cells along the side of a
    patch; shape : (r, c) cells of the tile; block : cells along the side of a block, a multiple of `patch`.
    """

    patch_corners: NDArray[np.float64]
    patch: int
    shape: tuple[int, int]
    block: int

    @classmethod
    def flat(cls, shape: tuple[int, int], block: int) -> SlopeSurface:
        """A surface without any slope: its slope indices are level indices."""
        return cls(np.zeros((-(-shape[0] // block) + 1, -(-shape[1] // block) + 1)), block, shape, block)

    @classmethod
    def from_surface(
        cls, surface: NDArray[np.float32], block: int, coarser_slope: CoarserSlope | None = None
    ) -> SlopeSurface:
        """The slanted support surface with the slopes of a smooth surface, (r, c) float32 level indices.

        coarser_slope : that of the coarser level, whose slopes are kept over distances of more than a few patches. None
        at the coarsest level, which takes all slopes from the surface (none, if the surface is hardly wider than what a
        slope is measured over). Blocks smaller than a patch get the surface of whole patches, divided afterwards,
        because medians over few cells would follow noise.
        """
        if block < PATCH and PATCH % block == 0:
            every = PATCH // block
            corners = divided(cls.from_surface(surface, PATCH, coarser_slope).patch_corners, every)
            return cls(
                corners[: -(-surface.shape[0] // block) + 1, : -(-surface.shape[1] // block) + 1],
                block,
                surface.shape,
                block,
            )
        if coarser_slope is None and min(surface.shape) <= 2 * SLOPE_REACH:
            return cls.flat(surface.shape, block)
        patch = PATCH if block % PATCH == 0 else block
        rows, cols = surface.shape
        whole = ((0, -rows % block), (0, -cols % block))
        n_patches = [(n + more) // patch for n, (_, more) in zip(surface.shape, whole, strict=True)]
        down, across = (
            np.pad(medians, [(0, m - n) for m, n in zip(n_patches, medians.shape, strict=True)], mode="edge")
            for medians in (patch_medians(values, patch) for values in known_slopes(surface))
        )
        if coarser_slope is None:
            medians = patch_medians(np.pad(surface, whole, mode="reflect", reflect_type="odd"), patch)
            start = ground_corners(medians, down, across, patch)
        else:
            start = coarser_slope.corners(down.shape, patch)
        return cls(np.rint(relaxed(start, down, across, patch)), patch, surface.shape, block)

    @cached_property
    def nodes(self) -> NDArray[np.float64]:
        """Level indices at the corners of blocks, (b + 1, d + 1) float64."""
        every = self.block // self.patch
        return np.ascontiguousarray(self.patch_corners[::every, ::every])

    @cached_property
    def cells(self) -> NDArray[np.float32]:
        """Level index of the surface at every cell, (r, c) float32."""
        return self.padded(0)

    def slope_index(self, level_index: NDArray[np.float32]) -> NDArray[np.float32]:
        """Slope indices (r, c) of level indices (r, c)."""
        return level_index - self.cells

    def padded(self, half: int) -> NDArray[np.float32]:
        """Level indices at every cell and at `half` cells around the tile, (r + 2 half, c + 2 half) float32; outside
        the tile the outermost patches are extrapolated."""
        r, c = (np.arange(-half, n + half) for n in self.shape)
        b, d = (np.clip(k // self.patch, 0, n - 2) for k, n in zip((r, c), self.patch_corners.shape, strict=True))
        fr, fc = (r - b * self.patch) / self.patch, (c - d * self.patch) / self.patch
        along = (self.patch_corners[:, d] * (1 - fc) + self.patch_corners[:, d + 1] * fc).astype(np.float32)
        cells = np.diff(along, axis=0)[b]
        cells *= fr[:, None].astype(np.float32)
        cells += along[b]
        return cells

    def at(self, rows: NDArray[np.float64], cols: NDArray[np.float64]) -> NDArray[np.float64]:
        """Level indices at fractional rows and columns of cells, (r, c); outside, the outermost patches are
        extrapolated."""
        (b, fr), (d, fc) = (
            (low := np.clip(k // self.patch, 0, n - 2).astype(int), k / self.patch - low)
            for k, n in zip((rows, cols), self.patch_corners.shape, strict=True)
        )
        along = self.patch_corners[:, d] * (1 - fc) + self.patch_corners[:, d + 1] * fc
        return np.asarray(along[b] * (1 - fr[:, None]) + along[b + 1] * fr[:, None])

    @cached_property
    def relief(self) -> NDArray[np.float32]:
        """Height of the surface above the bilinear surface through the corners of the blocks, steps, (r, c) float32."""
        blocks = SlopeSurface(self.nodes, self.block, self.shape, self.block)
        return np.asarray(self.cells - blocks.cells)

    def is_steep(self, part: tuple[slice, slice]) -> bool:
        """Whether the surface is so steep somewhere that level windows would blur it (see `STEEP_STEPS`). part : rows
        and columns of the cells that count."""
        nodes = self.nodes[tuple(slice(s.start // self.block, -(-s.stop // self.block) + 1) for s in part)]
        return bool(max(np.abs(np.diff(nodes, axis=axis)).max(initial=0.0) for axis in (0, 1)) > STEEP_STEPS)

    def along(self, tile_views: TileViews) -> TileViews:
        """The views with projections that take slope indices instead of level indices."""
        delta, nodes, bends = self.nodes * tile_views.t_of_index[1], tile_views.nodes.copy(), tile_views.bends.copy()
        if bends.shape[-1]:
            shift_bends(nodes, delta, tile_views.block, bends)
        shift_nodes(nodes, delta)
        corners = np.stack([self.nodes[i:n, j:m] for i, n in ((0, -1), (1, None)) for j, m in ((0, -1), (1, None))])
        index_range = tile_views.index_range - np.stack([corners.min(axis=0), corners.max(axis=0)], axis=-1)
        return replace(tile_views, nodes=nodes, bends=bends, index_range=index_range)


def divided(corners: NDArray[np.float64], times: int) -> NDArray[np.float64]:
    """Corners of patches of the same bilinear surface that are `times` smaller along both axes."""
    for axis in (0, 1):
        n = corners.shape[axis]
        at = np.arange((n - 1) * times + 1) / times
        low = np.minimum(at.astype(int), n - 2)
        share = np.expand_dims(at - low, 1 - axis)
        corners = corners.take(low, axis) * (1 - share) + corners.take(low + 1, axis) * share
    return np.ascontiguousarray(corners)


def known_slopes(surface: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slopes along rows and columns, steps per cell, each (r, c); at the border, where none are known, the nearest
    ones."""
    by_axis = (np.empty_like(surface), np.empty_like(surface))
    slopes(surface, SLOPE_REACH, *by_axis)
    for axis, values in enumerate(by_axis):
        along, n = values if axis == 0 else values.T, values.shape[axis]
        if n > 2 * SLOPE_REACH:
            along[:SLOPE_REACH], along[n - SLOPE_REACH :] = along[SLOPE_REACH], along[n - SLOPE_REACH - 1]
    return by_axis


def patch_medians(values: NDArray[np.float32], patch: int) -> NDArray[np.float64]:
    """Median of every patch of (r, c) values, (p, q) float64; patches at the border may be smaller."""
    rows, cols = values.shape
    out = np.empty((-(-rows // patch), -(-cols // patch)))
    # Whole patches first, then those that the border of the last rows and columns cuts.
    for b in _spans(rows, patch):
        for d in _spans(cols, patch):
            height, width = min(patch, rows - b.start), min(patch, cols - d.start)
            part = values[b, d].reshape(-1, height, (d.stop - d.start) // width, width)
            by_patch = part.transpose(0, 2, 1, 3).reshape(len(part), part.shape[2], height * width)
            first_b, first_d = b.start // patch, d.start // patch
            out[first_b : first_b + len(part), first_d : first_d + part.shape[2]] = median(by_patch)
    return out


def _spans(n: int, patch: int) -> list[slice]:
    """Cells of all whole patches along an axis, and cells of the last one that the border cuts, where there are any."""
    whole = n // patch * patch
    return [part for part in (slice(0, whole), slice(whole, n)) if part.stop > part.start]


def relaxed(
    corners: NDArray[np.float64], by_row: NDArray[np.float64], by_col: NDArray[np.float64], patch: int
) -> NDArray[np.float64]:
    """Heights of the corners of patches, (p + 1, q + 1), adjusted towards the slopes of the patches, by_row and by_col
    (p, q).

    A few damped Jacobi steps of the least squares over all edges; the slope of an edge is that of the patches beside
    it. They correct what the coarser level could not resolve and keep the rest, as in nested iteration (Brandt 1977,
    section 1). A corner depends on no patch that is more than `ROUNDS` away, so that heights do not depend on what lies
    far away in a halo.
    """
    rise_down, rise_across = patch * _beside(by_row, 1), patch * _beside(by_col, 0)
    n = np.full(corners.shape, 4.0)
    n[[0, -1]] -= 1
    n[:, [0, -1]] -= 1
    for _ in range(ROUNDS):
        down, across = np.diff(corners, axis=0) - rise_down, np.diff(corners, axis=1) - rise_across
        away = np.zeros_like(corners)
        away[:-1] += down
        away[1:] -= down
        away[:, :-1] += across
        away[:, 1:] -= across
        corners = corners + DAMPING * away / n
    return corners


def ground_corners(
    heights: NDArray[np.float64], by_row: NDArray[np.float64], by_col: NDArray[np.float64], patch: int
) -> NDArray[np.float64]:
    """Heights (p + 1, q + 1) of the corners of patches (p, q), without what stands on the ground.

    Each corner is the median of the heights of the patches around it. Every height is continued to the corner by the
    mean of the patch's slope and the corner's own.
    """
    n, m = np.add(heights.shape, 1)
    known = np.pad(heights, PATCHES_AROUND_CORNER, constant_values=np.nan)
    slopes_there = [np.pad(slope, PATCHES_AROUND_CORNER, mode="edge") for slope in (by_row, by_col)]
    slopes_here = [_beside(_beside(slope, 0), 1) for slope in (by_row, by_col)]
    estimates = []
    for i, j in np.ndindex(2 * PATCHES_AROUND_CORNER, 2 * PATCHES_AROUND_CORNER):
        part = slice(i, i + n), slice(j, j + m)
        rise = sum(
            patch * (PATCHES_AROUND_CORNER - 0.5 - at) * (there[part] + here) / 2
            for at, there, here in zip((i, j), slopes_there, slopes_here, strict=True)
        )
        estimates.append(known[part] + rise)
    return np.asarray(np.nanmedian(estimates, axis=0), np.float64)


def _beside(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Means of the two patches on both sides of every line between patches; at the border, the value of the one."""
    wide = np.pad(values, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
    n = wide.shape[axis]
    return np.asarray((wide.take(range(n - 1), axis) + wide.take(range(1, n), axis)) / 2)
