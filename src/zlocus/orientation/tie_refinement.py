"""Least-squares refinement of ties: each tie is measured in the full-resolution images to a fraction of a pixel."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import OrientationOptions
from zlocus.core.parallel import run_all
from zlocus.core.scene import View, held_window
from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.kernels.patches import patch_shifts
from zlocus.orientation.sift import parts, reduction
from zlocus.orientation.ties import Ties
from zlocus.orientation.triangulate import Observations, rows_by_view, rows_of_views

# A view with fewer observations that could be refined (another season, haze) keeps them all as SIFT found them.
MIN_REFINED_OF_VIEW = 50
# Side of the patch by which each tie is refined in the full-resolution images.
PATCH_PX = 9
# Pixels around the searched positions that cubic interpolation and the last steps need.
BORDER_PX = 4


@dataclass(frozen=True)
class PixelSquares:
    """Squares of pixels around some observations, from one part of an image.

    rows : (k,) numbers of the observations; pixels : (k, s, s) float32; valid : (k,) bool, squares without an invalid
    pixel.
    """

    rows: NDArray[np.int64]
    pixels: NDArray[np.float32]
    valid: NDArray[np.bool_]


def refine_ties(
    views: Sequence[View],
    observations: Observations,
    by_ground: FloatArray,
    options: OrientationOptions,
    threads: int = 1,
) -> Observations:
    """Observations moved to where their image correlates best with the reference image of their tie.

    by_ground : (m, 2, 3) px per m of each observation, from which follows how a patch of level ground is distorted from
    one image to another. The reference image of a tie is the one that looks at it most steeply; its observation keeps
    the position of SIFT. Observations that correlate less than `min_ncc` are dropped, and with them ties that keep
    fewer than two images.
    """
    if not len(observations):
        return observations
    reference = reference_rows(observations, by_ground, len(views))
    other = np.flatnonzero(reference != np.arange(len(observations)))
    whole = np.rint(observations.xy).astype(np.int64)
    patches, usable = reference_patches(views, observations.view, whole, np.unique(reference), options, threads)
    warp = np.zeros((len(observations), 2, 2))
    warp[other] = warps(by_ground[reference[other]], by_ground[other])
    # Positions at which the whole pixel of the reference is expected.
    expected = observations.xy + np.einsum("mij,mj->mi", warp, (whole - observations.xy)[reference])
    found = np.zeros((len(observations), 3))
    reach = math.ceil(max(reduction(held_window(view.image)[2:], options) for view in views) / 2.0)
    half = 2 * (PATCH_PX // 2) + reach + BORDER_PX
    of_view = rows_by_view(observations.view[other], len(views))

    def refine_view(i: int) -> None:
        """Refine the observations of one view."""
        for squares in squares_around(views[i], whole, other[of_view[i]], half):
            rows, of = squares.rows, reference[squares.rows]
            out = np.empty((len(rows), 3))
            centres = expected[rows] - whole[rows] + half
            patch_shifts(patches[of], squares.pixels, warp[rows], centres, reach, out)
            out[:, 2] *= squares.valid & usable[of]
            found[rows] = out

    deque(run_all(refine_view, range(len(views)), threads), maxlen=0)
    is_good = found[:, 2] >= options.min_ncc
    n_good = np.bincount(observations.view[is_good], minlength=len(views))
    as_found = (n_good < MIN_REFINED_OF_VIEW)[observations.view]
    moved = is_good & ~as_found
    xy = observations.xy + np.where(moved[:, None], found[:, :2], 0.0)
    keep = moved | as_found | (reference == np.arange(len(observations)))
    keep &= np.bincount(observations.point[keep], minlength=int(observations.point.max()) + 1)[observations.point] >= 2
    return Observations(observations.view[keep], observations.point[keep], xy[keep])


def reference_rows(observations: Observations, by_ground: FloatArray, n_views: int) -> NDArray[np.int64]:
    """For each observation (m,) the observation of the same tie in the view that looks at the ground most steeply.

    by_ground : (m, 2, 3) px per m. Views are compared by their median parallax rate, in the ground plane.
    """
    along = np.einsum("mij,mj->mi", inverses(by_ground[:, :, :2]), by_ground[:, :, 2])
    parallax_rate = np.nan_to_num(np.hypot(*along.T), nan=np.inf)
    rows = rows_of_views(observations, n_views)
    of_view = np.array([np.median(parallax_rate[mine]) if len(mine) else np.inf for mine in rows])
    order = np.lexsort((observations.view, of_view[observations.view], observations.point))
    _, first = np.unique(observations.point[order], return_index=True)
    row_of = np.zeros(int(observations.point.max()) + 1, np.int64)
    row_of[observations.point[order[first]]] = order[first]
    return np.asarray(row_of[observations.point])


def inverses(matrix: FloatArray) -> FloatArray:
    """Inverses (n, 2, 2) of matrices; not finite where there is none."""
    (a, b), (c, d) = np.moveaxis(matrix, 0, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), -1, 0))


def warps(reference: FloatArray, other: FloatArray) -> FloatArray:
    """Derivatives (n, 2, 2) of positions in one image by those in the reference image, on level ground; 0 where
    unknown.

    reference, other : (n, 2, 3) px per m, derivatives of the image positions by the ground point.
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
    """Patches (m, p, p) float32 around some of the observations, and which of them are valid (m,).

    view : (m,) of all observations; whole : (m, 2) column and row of their whole pixels; rows : (k,) which are read,
    the other patches are zero. Patches have a border of one pixel for slopes.
    """
    half = PATCH_PX // 2 + 1
    patches, usable = np.zeros((len(view), 2 * half + 1, 2 * half + 1), np.float32), np.zeros(len(view), bool)

    of_view = rows_by_view(view[rows], len(views))

    def read(i: int) -> None:
        for squares in squares_around(views[i], whole, rows[of_view[i]], half):
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


# Names of the arrays in which refined ties are kept: of the ties as SIFT found them and of the refined observations.
KEPT_TIES, KEPT_COLUMNS = ("rough", "precise"), ("view", "point", "xy")


@dataclass(frozen=True)
class RefinedTies:
    """The measurements in the images, which take most of the time of an orientation.

    ties : as SIFT found them; observations : the same ties, refined by least squares, without those that could not be.
    """

    ties: Ties
    observations: Observations

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The measurements as named arrays, to be kept in a file, without the matches of the pairs."""
        both = zip(KEPT_TIES, (self.ties.observations, self.observations), strict=True)
        columns = {f"{kept}_{column}": getattr(each, column) for kept, each in both for column in KEPT_COLUMNS}
        return {**columns, "z": self.ties.z, "z_range": np.array(self.ties.z_range)}

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], n_views: int) -> RefinedTies | None:
        """The measurements that `arrays` gave; None where the arrays do not belong to ties of `n_views` views."""
        try:
            rough, refined = (Observations(*(arrays[f"{kept}_{name}"] for name in KEPT_COLUMNS)) for kept in KEPT_TIES)
            z, (low, high) = arrays["z"], arrays["z_range"]
        except (KeyError, ValueError):
            return None
        if not all(_are_valid(observations, n_views, len(z)) for observations in (rough, refined)):
            return None
        return cls(Ties(rough, z, (), (float(low), float(high))), refined)


def _are_valid(observations: Observations, n_views: int, n_points: int) -> bool:
    """Whether observations have the shapes and numbers of so many views and points."""
    view, point, xy = observations.view, observations.point, observations.xy
    if view.ndim != 1 or point.shape != view.shape or xy.shape != (len(observations), 2):
        return False
    numbers = ((view, n_views), (point, n_points))
    return all(v.dtype == np.int64 and v.min(initial=0) >= 0 and v.max(initial=-1) < n for v, n in numbers)
