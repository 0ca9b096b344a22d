"""The base surface of a level: heights are searched along it, so that a slope is level to windows and penalties.

Level windows see a slope as a step per cell, and the semi-global constraint makes stairs of it. The base surface takes
the slopes of the coarser level's surface (medians over patches, which jumps do not touch) and none of its jumps; height
index k then means k steps above the base. It is continuous and bilinear between the corners of patches, so neighbours
are still compared by height. It follows no building: where slopes are small it is nearly level.

It must not depend on how far a tile's halo reaches either, for where it lies decides at which heights views are
compared. So a level takes the base of the level above and mends it with the patches nearby alone, and corners lie whole
steps high: what differs a little in two tiles makes no difference then.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.smooth import slopes
from zlocus.matching.median import median
from zlocus.matching.tile_views import TileViews

PATCH = 8
SLOPE_REACH = 4
ROUNDS, DAMPING = 6, 0.8
# Patches to every side of a corner whose heights say how high it lies at the coarsest level.
LEVELLED = 3
STEEP_STEPS = 8.0


@dataclass(frozen=True)
class CoarserSlope:
    """The base of the level above, in its own cells and steps. row, col : of its window's first cell, less half of the
    finer one's."""

    base: SlopeSurface
    row: float
    col: float

    def corners(self, n_patches: tuple[int, int], patch: int) -> NDArray[np.float64]:
        """Height indices of the finer level at the corners of its patches, (p + 1, q + 1)."""
        rows, cols = (
            (np.arange(n + 1) * patch + 0.5) / 2 - 0.5 - first
            for n, first in zip(n_patches, (self.row, self.col), strict=True)
        )
        return 2 * self.base.at(rows, cols)


@dataclass(frozen=True)
class SlopeSurface:
    """Height indices (fractions too) of a continuous surface over the cells of a tile.

    patches : (p + 1, q + 1) float64, at the corners of patches of `patch` cells; shape : (r, c), cells of the tile;
    block : cells along the side of a block, a multiple of `patch`.
    """

    patches: NDArray[np.float64]
    patch: int
    shape: tuple[int, int]
    block: int

    @classmethod
    def level(cls, shape: tuple[int, int], block: int) -> SlopeSurface:
        """No slope anywhere."""
        return cls(np.zeros((-(-shape[0] // block) + 1, -(-shape[1] // block) + 1)), block, shape, block)

    @classmethod
    def along(cls, surface: NDArray[np.float32], block: int, coarser: CoarserSlope | None = None) -> SlopeSurface:
        """With the slopes of a smooth surface, (r, c) float32 height indices.

        coarser : the base of the level above, whose slopes are kept where they are longer than a few patches; None at
        the coarsest, where those of the surface are (none, if it is hardly wider than what a slope is taken over).
        Patches are no smaller in small blocks, whose medians would follow noise: they are divided afterwards.
        """
        if block < PATCH and PATCH % block == 0:
            every = PATCH // block
            corners = divided(cls.along(surface, PATCH, coarser).patches, every)
            return cls(
                corners[: -(-surface.shape[0] // block) + 1, : -(-surface.shape[1] // block) + 1],
                block,
                surface.shape,
                block,
            )
        if coarser is None and min(surface.shape) <= 2 * SLOPE_REACH:
            return cls.level(surface.shape, block)
        patch = PATCH if block % PATCH == 0 else block
        rows, cols = surface.shape
        whole = ((0, -rows % block), (0, -cols % block))
        n_patches = [(n + more) // patch for n, (_, more) in zip(surface.shape, whole, strict=True)]
        down, across = (
            np.pad(medians, [(0, m - n) for m, n in zip(n_patches, medians.shape, strict=True)], mode="edge")
            for medians in (patch_medians(values, patch) for values in known_slopes(surface))
        )
        if coarser is None:
            medians = patch_medians(np.pad(surface, whole, mode="reflect", reflect_type="odd"), patch)
            start = levelled(medians, down, across, patch)
        else:
            start = coarser.corners(down.shape, patch)
        return cls(np.rint(relaxed(start, down, across, patch)), patch, surface.shape, block)

    @cached_property
    def nodes(self) -> NDArray[np.float64]:
        """(b + 1, d + 1) float64, at the corners of blocks."""
        every = self.block // self.patch
        return np.ascontiguousarray(self.patches[::every, ::every])

    @cached_property
    def cells(self) -> NDArray[np.float32]:
        """(r, c) float32, of every cell."""
        return self.padded(0)

    def padded(self, half: int) -> NDArray[np.float32]:
        """(r + 2 half, c + 2 half) float32, of every cell and of a border, over which the outermost patches go on."""
        r, c = (np.arange(-half, n + half) for n in self.shape)
        b, d = (np.clip(k // self.patch, 0, n - 2) for k, n in zip((r, c), self.patches.shape, strict=True))
        fr, fc = (r - b * self.patch) / self.patch, (c - d * self.patch) / self.patch
        along = (self.patches[:, d] * (1 - fc) + self.patches[:, d + 1] * fc).astype(np.float32)
        cells = np.diff(along, axis=0)[b]
        cells *= fr[:, None].astype(np.float32)
        cells += along[b]
        return cells

    def at(self, rows: NDArray[np.float64], cols: NDArray[np.float64]) -> NDArray[np.float64]:
        """(r, c), at fractional rows and columns of cells; the outermost patches go on."""
        (b, fr), (d, fc) = (
            (low := np.clip(k // self.patch, 0, n - 2).astype(int), k / self.patch - low)
            for k, n in zip((rows, cols), self.patches.shape, strict=True)
        )
        along = self.patches[:, d] * (1 - fc) + self.patches[:, d + 1] * fc
        return np.asarray(along[b] * (1 - fr[:, None]) + along[b + 1] * fr[:, None])

    @cached_property
    def relief(self) -> NDArray[np.float32]:
        """(r, c) float32: the cells less the bilinear surface through the corners of their blocks."""
        blocks = SlopeSurface(self.nodes, self.block, self.shape, self.block)
        return np.asarray(self.cells - blocks.cells)

    def is_steep(self, part: tuple[slice, slice]) -> bool:
        """Whether it rises anywhere among some cells by so much from a block's corner to the next that level windows
        would suffer. part : their rows and columns."""
        nodes = self.nodes[tuple(slice(s.start // self.block, -(-s.stop // self.block) + 1) for s in part)]
        return bool(max(np.abs(np.diff(nodes, axis=axis)).max(initial=0.0) for axis in (0, 1)) > STEEP_STEPS)

    def shear(self, views: TileViews) -> TileViews:
        """The views with nodes that project height index k of the base instead of the lattice.

        A polynomial in t at a node, taken at t + delta, is another in t: c'_j = sum_i C(i, j) c_i delta^(i - j).
        """
        delta = self.nodes * views.heights[1]
        moved = np.zeros_like(views.nodes)
        n = moved.shape[-1]
        for j in range(n):
            for i in range(j, n):
                moved[..., j] += comb(i, j) * views.nodes[..., i] * (delta ** (i - j))[None, :, :, None]
        corners = np.stack([self.nodes[i:n, j:m] for i, n in ((0, -1), (1, None)) for j, m in ((0, -1), (1, None))])
        ends = views.ends - np.stack([corners.min(axis=0), corners.max(axis=0)], axis=-1)
        return replace(views, nodes=moved, ends=ends)


def divided(corners: NDArray[np.float64], times: int) -> NDArray[np.float64]:
    """Corners of the same bilinear surface's patches, `times` as many along both axes."""
    for axis in (0, 1):
        n = corners.shape[axis]
        at = np.arange((n - 1) * times + 1) / times
        low = np.minimum(at.astype(int), n - 2)
        share = np.expand_dims(at - low, 1 - axis)
        corners = corners.take(low, axis) * (1 - share) + corners.take(low + 1, axis) * share
    return np.ascontiguousarray(corners)


def known_slopes(surface: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slopes per cell along rows and columns, each (r, c); at the border, where none are known, those next to it."""
    by_axis = (np.empty_like(surface), np.empty_like(surface))
    slopes(surface, SLOPE_REACH, *by_axis)
    for axis, values in enumerate(by_axis):
        along, n = values if axis == 0 else values.T, values.shape[axis]
        if n > 2 * SLOPE_REACH:
            along[:SLOPE_REACH], along[n - SLOPE_REACH :] = along[SLOPE_REACH], along[n - SLOPE_REACH - 1]
    return by_axis


def patch_medians(values: NDArray[np.float32], patch: int) -> NDArray[np.float64]:
    """Median of every patch of (r, c) values; patches at the border may be smaller."""
    rows, cols = values.shape
    out = np.empty((-(-rows // patch), -(-cols // patch)))
    # The whole patches first, then those that the last row, the last column and the corner cut.
    for b in _spans(rows, patch):
        for d in _spans(cols, patch):
            height, width = min(patch, rows - b.start), min(patch, cols - d.start)
            part = values[b, d].reshape(-1, height, (d.stop - d.start) // width, width)
            by_patch = part.transpose(0, 2, 1, 3).reshape(len(part), part.shape[2], height * width)
            first_b, first_d = b.start // patch, d.start // patch
            out[first_b : first_b + len(part), first_d : first_d + part.shape[2]] = median(by_patch)
    return out


def _spans(n: int, patch: int) -> list[slice]:
    """The cells of all whole patches along an axis, and those of the cut one, if any of each."""
    whole = n // patch * patch
    return [part for part in (slice(0, whole), slice(whole, n)) if part.stop > part.start]


def relaxed(
    corners: NDArray[np.float64], by_row: NDArray[np.float64], by_col: NDArray[np.float64], patch: int
) -> NDArray[np.float64]:
    """Heights of the corners of patches, drawn towards the slopes of the patches. (p + 1, q + 1).

    A few damped Jacobi steps of the least squares over all edges, each as steep as the patches beside it. They settle
    what a coarser level is blind to and leave what it knows, as in nested iteration (Brandt 1977, section 1); a corner
    hears of no patch that is more than `ROUNDS` away, so heights do not depend on what is far away in a halo.
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


def levelled(
    heights: NDArray[np.float64], by_row: NDArray[np.float64], by_col: NDArray[np.float64], patch: int
) -> NDArray[np.float64]:
    """Heights (p + 1, q + 1) of the corners of patches (p, q) without what stands on the ground: medians of what the
    patches around each corner say, continued to it by the mean of their slopes and its own."""
    n, m = np.add(heights.shape, 1)
    known = np.pad(heights, LEVELLED, constant_values=np.nan)
    slopes_there = [np.pad(slope, LEVELLED, mode="edge") for slope in (by_row, by_col)]
    slopes_here = [_beside(_beside(slope, 0), 1) for slope in (by_row, by_col)]
    said = []
    for i, j in np.ndindex(2 * LEVELLED, 2 * LEVELLED):
        part = slice(i, i + n), slice(j, j + m)
        rise = sum(
            patch * (LEVELLED - 0.5 - at) * (there[part] + here) / 2
            for at, there, here in zip((i, j), slopes_there, slopes_here, strict=True)
        )
        said.append(known[part] + rise)
    return np.asarray(np.nanmedian(said, axis=0), np.float64)


def _beside(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Means of the patches before and after every line between them; at the border, of the one there is."""
    wide = np.pad(values, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
    n = wide.shape[axis]
    return np.asarray((wide.take(range(n - 1), axis) + wide.take(range(1, n), axis)) / 2)
