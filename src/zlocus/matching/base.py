"""The base surface of a level: heights are searched along it, so that a slope is level to windows and penalties.

Level windows see a slope as a step per cell, and the semi-global constraint makes stairs of it. The base surface takes
the slopes of the coarser level's surface (medians over patches, which jumps do not touch) and none of its jumps; height
index k then means k steps above the base. It is continuous and bilinear between the corners of patches, so neighbours
are still compared by height. It follows no building: where slopes are small it is nearly level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.smooth import slopes
from zlocus.matching.views import TileViews

PATCH = 8
SLOPE_REACH = 4
ANCHOR = 1e-3
STEEP_STEPS = 8.0


@dataclass(frozen=True)
class BaseSurface:
    """Height indices (fractions too) of a continuous surface over the cells of a tile.

    patches : (p + 1, q + 1) float64, at the corners of patches of `patch` cells; shape : (r, c), cells of the tile;
    block : cells along the side of a block, a multiple of `patch`.
    """

    patches: NDArray[np.float64]
    patch: int
    shape: tuple[int, int]
    block: int

    @classmethod
    def level(cls, shape: tuple[int, int], block: int) -> BaseSurface:
        """No slope anywhere."""
        return cls(np.zeros((-(-shape[0] // block) + 1, -(-shape[1] // block) + 1)), block, shape, block)

    @classmethod
    def along(cls, surface: NDArray[np.float32], block: int) -> BaseSurface:
        """With the slopes of a smooth surface, (r, c) float32 height indices.

        Patches are no smaller in small blocks, whose medians would follow noise: they are divided afterwards.
        """
        if block < PATCH and PATCH % block == 0:
            every = PATCH // block
            corners = divided(cls.along(surface, PATCH).patches, every)
            return cls(
                corners[: -(-surface.shape[0] // block) + 1, : -(-surface.shape[1] // block) + 1],
                block,
                surface.shape,
                block,
            )
        patch = PATCH if block % PATCH == 0 else block
        rows, cols = surface.shape
        whole = ((0, -rows % block), (0, -cols % block))
        by_row, by_col = known_slopes(surface)
        down, across, heights = (
            np.pad(patch_medians(values, patch), [(0, (n + more) // patch - -(-n // patch)) for n, (_, more) in
                   zip(surface.shape, whole, strict=True)], mode="edge")
            for values in (by_row, by_col, surface)
        )  # fmt: skip
        return cls(integrated(down, across, patch, heights), patch, surface.shape, block)

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

    @cached_property
    def relief(self) -> NDArray[np.float32]:
        """(r, c) float32: the cells less the bilinear surface through the corners of their blocks."""
        blocks = BaseSurface(self.nodes, self.block, self.shape, self.block)
        return np.asarray(self.cells - blocks.cells)

    @property
    def is_steep(self) -> bool:
        """Whether it rises anywhere by so much from a block's corner to the next that level windows would suffer."""
        return bool(max(np.abs(np.diff(self.nodes, axis=axis)).max(initial=0.0) for axis in (0, 1)) > STEEP_STEPS)

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
            out[first_b : first_b + len(part), first_d : first_d + part.shape[2]] = np.median(by_patch, axis=2)
    return out


def _spans(n: int, patch: int) -> list[slice]:
    """The cells of all whole patches along an axis, and those of the cut one, if any of each."""
    whole = n // patch * patch
    return [part for part in (slice(0, whole), slice(whole, n)) if part.stop > part.start]


def integrated(
    by_row: NDArray[np.float64], by_col: NDArray[np.float64], patch: int, heights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Heights of the corners of patches whose differences come closest to the slopes of the patches. (p + 1, q + 1).

    Least squares over all edges, each as steep as the patches beside it; a weak pull towards the patches' heights
    fixes the rest. The normal equations are a screened Poisson equation with free borders, which the cosine transform
    solves exactly (Simchony et al. 1990, section 3).
    """
    rise_down, rise_across = patch * _beside(by_row, 1), patch * _beside(by_col, 0)
    around = _beside(_beside(heights, 0), 1)
    right = ANCHOR * around
    right[1:] += rise_down
    right[:-1] -= rise_down
    right[:, 1:] += rise_across
    right[:, :-1] -= rise_across
    (waves_down, p), (waves_across, q) = (cosine_transform(n) for n in right.shape)
    spectrum = waves_down @ right @ waves_across.T / (p[:, None] + q[None, :] + ANCHOR)
    return np.asarray(waves_down.T @ spectrum @ waves_across, np.float64)


def cosine_transform(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Orthonormal cosine transform (n, n), a wave a row, and what second differences with free ends make of each wave:
    (n,) factors. (As a matrix: n is a few hundred at most, and importing a library's takes longer than all of them.)"""
    k = np.arange(n)
    waves = np.sqrt(2.0 / n) * np.cos(np.pi * k[:, None] * (k + 0.5) / n)
    waves[0] /= np.sqrt(2.0)
    return waves, 2.0 - 2.0 * np.cos(np.pi * k / n)


def _beside(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Means of the patches before and after every line between them; at the border, of the one there is."""
    wide = np.pad(values, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
    n = wide.shape[axis]
    return np.asarray((wide.take(range(n - 1), axis) + wide.take(range(1, n), axis)) / 2)
