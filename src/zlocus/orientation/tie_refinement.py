"""Ties measured again in the images as they are, by correlation of patches, to a fraction of a pixel."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import OrientationOptions
from zlocus.core.parallel import run_all
from zlocus.core.scene import View, held_window
from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.kernels.patches import patch_shifts
from zlocus.orientation.sift import parts, reduction
from zlocus.orientation.triangulate import Observations

# A view with fewer observations that could be measured keeps them all as SIFT found them: another season, haze.
MIN_REFINED_OF_VIEW = 50
BORDER_PX = 4  # that cubic interpolation and the last steps need around what is searched


@dataclass(frozen=True)
class PixelSquares:
    """Pixels around whole pixels of one part of an image.

    rows : (k,) which points; pixels : (k, s, s) float32; valid : (k,) bool, whether all of them are valid.
    """

    rows: NDArray[np.int64]
    pixels: NDArray[np.float32]
    valid: NDArray[np.bool_]


def refined_ties(
    views: Sequence[View],
    observations: Observations,
    by_ground: FloatArray,
    options: OrientationOptions,
    threads: int = 1,
) -> Observations:
    """The observations, each put where its image correlates best with that of the tie's reference.

    by_ground : (m, 2, 3) px per m of each observation, from which follows how level ground looks in one image against
    another. The reference of a tie is the image that sees it the least slanted; what SIFT found there stays. What
    correlates less than `min_ncc` is dropped, and ties that keep no two images with it.
    """
    if not len(observations):
        return observations
    reference = reference_rows(observations, by_ground, len(views))
    other = np.flatnonzero(reference != np.arange(len(observations)))
    whole = np.rint(observations.xy).astype(np.int64)
    patches, usable = reference_patches(views, observations.view, whole, np.unique(reference), options, threads)
    warp = np.zeros((len(observations), 2, 2))
    warp[other] = warps(by_ground[reference[other]], by_ground[other])
    # Where the whole pixel of the reference is expected.
    expected = observations.xy + np.einsum("mij,mj->mi", warp, (whole - observations.xy)[reference])
    found = np.zeros((len(observations), 3))
    reach = math.ceil(max(reduction(held_window(view.image)[2:], options) for view in views) / 2.0)
    half = 2 * (options.patch_px // 2) + reach + BORDER_PX

    def measure(i: int) -> None:
        """Observations of one view."""
        for squares in squares_around(views[i], whole, other[observations.view[other] == i], half):
            rows, of = squares.rows, reference[squares.rows]
            out = np.empty((len(rows), 3))
            centres = expected[rows] - whole[rows] + half
            patch_shifts(patches[of], squares.pixels, warp[rows], centres, reach, out)
            out[:, 2] *= squares.valid & usable[of]
            found[rows] = out

    deque(run_all(measure, range(len(views)), threads), maxlen=0)
    is_good = found[:, 2] >= options.min_ncc
    n_good = np.bincount(observations.view[is_good], minlength=len(views))
    as_found = (n_good < MIN_REFINED_OF_VIEW)[observations.view]
    moved = is_good & ~as_found
    xy = observations.xy + np.where(moved[:, None], found[:, :2], 0.0)
    keep = moved | as_found | (reference == np.arange(len(observations)))
    keep &= np.bincount(observations.point[keep], minlength=int(observations.point.max()) + 1)[observations.point] >= 2
    return Observations(observations.view[keep], observations.point[keep], xy[keep])


def reference_rows(observations: Observations, by_ground: FloatArray, n_views: int) -> NDArray[np.int64]:
    """For each observation (m,) that of the same tie in the view that looks the least slanted at the ground."""
    along = np.einsum("mij,mj->mi", inverses(by_ground[:, :, :2]), by_ground[:, :, 2])
    slant = np.nan_to_num(np.hypot(*along.T), nan=np.inf)
    of_view = np.array(
        [np.median(slant[observations.view == i]) if (observations.view == i).any() else np.inf for i in range(n_views)]
    )
    order = np.lexsort((observations.view, of_view[observations.view], observations.point))
    _, first = np.unique(observations.point[order], return_index=True)
    row_of = np.zeros(int(observations.point.max()) + 1, np.int64)
    row_of[observations.point[order[first]]] = order[first]
    return np.asarray(row_of[observations.point])


def inverses(matrix: FloatArray) -> FloatArray:
    """Inverses (n, 2, 2); not finite where there is none."""
    (a, b), (c, d) = np.moveaxis(matrix, 0, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), -1, 0))


def warps(reference: FloatArray, other: FloatArray) -> FloatArray:
    """Pixels of the others per pixel of the references (n, 2, 2) on level ground; 0 where unknown.

    reference, other : (n, 2, 3) px per m.
    """
    with np.errstate(invalid="ignore"):
        warp = other[:, :, :2] @ inverses(reference[:, :, :2])
    return np.where(np.isfinite(warp).all(axis=(1, 2), keepdims=True), warp, 0.0)


def reference_patches(
    views: Sequence[View],
    view: NDArray[np.int64],
    whole: NDArray[np.int64],
    rows: NDArray[np.int64],
    options: OrientationOptions,
    threads: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Patches around some of the observations, (m, p, p) float32 with a border for slopes, and which are valid (m,)."""
    half = options.patch_px // 2 + 1
    patches, usable = np.zeros((len(view), 2 * half + 1, 2 * half + 1), np.float32), np.zeros(len(view), bool)

    def read(i: int) -> None:
        for squares in squares_around(views[i], whole, rows[view[rows] == i], half):
            patches[squares.rows], usable[squares.rows] = squares.pixels, squares.valid

    deque(run_all(read, range(len(views)), threads), maxlen=0)
    return patches, usable


def squares_around(view: View, whole: NDArray[np.int64], rows: NDArray[np.int64], half: int) -> Iterator[PixelSquares]:
    """PixelSquares of 2 half + 1 px around whole pixels, read part by part; those that leave the image are left out.

    whole : (m, 2) column and row of all points; rows : (k,) which of them.
    """
    n_rows, n_cols = view.image.shape
    inside = ((whole[rows] >= half) & (whole[rows] < np.array([n_cols, n_rows]) - half)).all(axis=1)
    rows, offset = rows[inside], np.arange(-half, half + 1)
    col, row = whole[rows].T
    for _, (top, left, bottom, right) in parts(view.image):
        here = np.flatnonzero((row >= top) & (row < bottom) & (col >= left) & (col < right))
        if not len(here):
            continue
        row0, col0 = int(row[here].min()) - half, int(col[here].min()) - half
        size = int(row[here].max()) + half + 1 - row0, int(col[here].max()) + half + 1 - col0
        window = view.image.read(row0, col0, *size)
        at = (row[here] - row0)[:, None, None] + offset[:, None], (col[here] - col0)[:, None, None] + offset
        valid = np.ones(len(here), bool) if window.valid.all() else window.valid[at].all(axis=(1, 2))
        yield PixelSquares(rows[here], window.pixels[at], valid)
