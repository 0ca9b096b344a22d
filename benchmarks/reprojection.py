"""Check of a surface by images that were left out of the matching, in a local frame.

The surface is textured with the matched images and compared with every left-out image: both are resampled at the cells
of the surface and correlated over windows of `WINDOW` x `WINDOW` cells (a cell is about a pixel), where both show the
surface. A window takes its texture from the matched image with the viewing direction nearest to that of the left-out
image. Occlusions follow from the surface alone: the ray from a cell to the camera must not meet the surface. No window
is dropped because of its correlation; windows without texture count as 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from zlocus.core.jit import kernel
from zlocus.core.scene import View
from zlocus.evaluation.heights import read_heights

WINDOW = 11
# A cell is occluded where the surface rises more than this many cells above its ray.
CLEAR_CELLS = 3.0
# Side, in cells, of the squares that a ray may skip at once, and of the squares whose occlusion is decided together.
SQUARE, ALIKE = 16, 2
# Share of a window that both images must see.
LEAST_SEEN = 0.5
# Below this product of the variances of two windows (grey values squared) one of them has no texture.
EVEN = 1e-6


@dataclass(frozen=True)
class Reprojection:
    """Comparison of a surface with an image that was left out; all but `ncc` are numbers of cells.

    ncc : (n,) correlations of the compared windows; empty : without a height; outside : of the image; hidden : occluded
    by the surface; untextured : not seen by a matched image; at_rim : most of the window is one of these.
    """

    ncc: np.ndarray
    cells: int
    empty: int
    outside: int
    hidden: int
    untextured: int
    at_rim: int

    @property
    def with_height(self) -> int:
        """Cells of the surface that have a height."""
        return self.cells - self.empty

    @property
    def median(self) -> float:
        """Median correlation."""
        return float(np.median(self.ncc)) if len(self.ncc) else float("nan")


@dataclass(frozen=True)
class Surface:
    """xyz : (r, c, 3) m, NaN in z where there is no height; cell_m : side of a cell."""

    xyz: np.ndarray
    cell_m: float

    @classmethod
    def read(cls, path: Path) -> Surface:
        """A dsm.tif in the frame of the cameras."""
        raster = read_heights(path)
        rows, cols = raster.z.shape
        col, row = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
        x, y = raster.transform * (col, row)
        return cls(np.dstack([x, y, raster.z]), float(raster.transform.a))

    def moved(self, by_m: float) -> Surface:
        """The surface with all heights raised by `by_m`."""
        return Surface(self.xyz + np.array([0.0, 0.0, by_m]), self.cell_m)


@dataclass(frozen=True)
class Shown:
    """A view resampled at the cells of a surface.

    grey : (r, c), defined where `inside`; inside : (r, c), inside the image; clear : (r, c), inside and not occluded;
    towards : (r, c, 3), unit vectors to the camera.
    """

    grey: np.ndarray
    inside: np.ndarray
    clear: np.ndarray
    towards: np.ndarray


# (r,c) f4, (b,d) f4, f8, f8, f8, f8, (r,c) b1 -> None
@kernel
def clear_cells(height, highest, cam_col, cam_row, cam_height, margin, out):
    """Whether the ray from each cell to a camera stays above the surface; it is followed cell by cell.

    height : (r, c) float32 in cells, NaN where there is none; highest : (b, d) float32, see `highest_of`; cam_col,
    cam_row, cam_height : of the camera, in cells; margin : cells by which the surface must stand above the ray to hide.
    A square that the ray enters above its highest cell is skipped.
    """
    n_rows, n_cols = height.shape
    for r in range(0, n_rows, ALIKE):
        for c in range(0, n_cols, ALIKE):
            clear = False
            for k in range(ALIKE**2):
                row, col = min(r + k // ALIKE, n_rows - 1), min(c + k % ALIKE, n_cols - 1)
                if not np.isnan(height[row, col]):
                    clear = is_clear(height, highest, row, col, (cam_col, cam_row, cam_height), margin)
                    break
            out[r : r + ALIKE, c : c + ALIKE] = clear


# (r,c) f4, (b,d) f4, i8, i8, (3,) f8, f8 -> b1
@kernel
def is_clear(height, highest, r, c, camera, margin):
    """Whether the ray from one cell stays above the surface. camera : column, row, height in cells."""
    z, (n_rows, n_cols) = height[r, c], height.shape
    if not camera[2] > z:
        return False
    by_col, by_row, by_height = camera[0] - c, camera[1] - r, camera[2] - z
    n_steps = max(abs(by_col), abs(by_row))
    by_col, by_row, by_height = by_col / n_steps, by_row / n_steps, by_height / n_steps
    step = 1.0
    while step <= n_steps:
        ray, at_row, at_col = z + by_height * step, r + by_row * step, c + by_col * step
        row, col = int(np.rint(at_row)), int(np.rint(at_col))
        if row < 0 or col < 0 or row >= n_rows or col >= n_cols:
            break
        if highest[row // SQUARE, col // SQUARE] > ray + margin:
            if height[row, col] > ray + margin:
                return False
            step += 1.0
        else:
            step += max(np.floor(min(way_out(at_row, by_row), way_out(at_col, by_col))), 1.0)
    return True


# f8, f8 -> f8
@kernel
def way_out(at, by):
    """Steps until a position on an axis leaves its square of cells."""
    first = np.rint(at) // SQUARE * SQUARE - 0.5
    if by > 0.0:
        return (first + SQUARE - at) / by
    if by < 0.0:
        return (first - at) / by
    return np.inf


def highest_of(height: np.ndarray) -> np.ndarray:
    """Highest cell of each square. (r, c) -> (b, d) float32, -inf where there is none."""
    rows, cols = (-n % SQUARE for n in height.shape)
    whole = np.pad(np.where(np.isnan(height), -np.inf, height), ((0, rows), (0, cols)), constant_values=-np.inf)
    squares = whole.reshape(whole.shape[0] // SQUARE, SQUARE, whole.shape[1] // SQUARE, SQUARE)
    return squares.max(axis=(1, 3)).astype(np.float32)


def shown(view: View, surface: Surface) -> Shown:
    """A view resampled at the cells of a surface, with the occlusions that the surface causes."""
    points = surface.xyz.reshape(-1, 3)
    shape = surface.xyz.shape[:2]
    xy = view.sensor.image_from_ground(points)
    rows, cols = view.image.shape
    inside = (xy >= 1).all(axis=1) & (xy[:, 0] <= cols - 2) & (xy[:, 1] <= rows - 2)
    at = np.where(inside[:, None], xy, 0.0).astype(np.float32).reshape(*shape, 2)
    pixels = view.image.read(0, 0, rows, cols).pixels
    grey = cv2.remap(pixels, at, None, cv2.INTER_CUBIC)
    centre, origin = np.array(view.sensor.centre), surface.xyz[0, 0]
    height = (surface.xyz[..., 2] / surface.cell_m).astype(np.float32)
    clear = np.empty(shape, bool)
    col, row = (centre[0] - origin[0]) / surface.cell_m, (origin[1] - centre[1]) / surface.cell_m
    clear_cells(height, highest_of(height), col, row, float(centre[2] / surface.cell_m), CLEAR_CELLS, clear)
    towards = (centre - surface.xyz).astype(np.float32)
    return Shown(grey, inside.reshape(shape), clear, towards / np.linalg.norm(towards, axis=2, keepdims=True))


def compared(target: Shown, matched: Sequence[Shown], has_height: np.ndarray) -> Reprojection:
    """Correlations of an image with the texture of the surface, at every cell that both show."""
    seen = has_height & target.inside & target.clear
    is_textured, is_compared = np.zeros(seen.shape, bool), np.zeros(seen.shape, bool)
    nearest, ncc = np.full(seen.shape, -2.0, np.float32), np.zeros(seen.shape, np.float32)
    for one in matched:
        usable = seen & one.inside & one.clear
        is_textured |= usable
        enough = usable & (windows(usable.astype(float)) >= LEAST_SEEN)
        cosine = np.where(enough, (one.towards * target.towards).sum(axis=2), -2.0)
        better = cosine > nearest
        nearest[better], ncc[better] = cosine[better], window_ncc(target.grey, one.grey, usable)[better]
        is_compared |= enough
    return Reprojection(
        ncc=ncc[is_compared],
        cells=has_height.size,
        empty=int((~has_height).sum()),
        outside=int((has_height & ~target.inside).sum()),
        hidden=int((has_height & target.inside & ~target.clear).sum()),
        untextured=int((seen & ~is_textured).sum()),
        at_rim=int((is_textured & ~is_compared).sum()),
    )


def windows(values: np.ndarray) -> np.ndarray:
    """Mean of the window around each cell, (r, c); values beyond the border are 0."""
    return cv2.blur(values, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT)


def window_ncc(a: np.ndarray, b: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Correlation over the usable cells of the window around each cell, (r, c); 0 where one window has no texture."""
    if not usable.any():
        return np.zeros(usable.shape)
    # The mean is subtracted first, because squares of large values lose digits.
    a, b = (np.where(usable, v - v[usable].mean(dtype=float), 0.0) for v in (a, b))
    share = np.maximum(windows(usable.astype(float)), 1e-9)
    mean_a, mean_b = windows(a) / share, windows(b) / share
    spread = (windows(a * a) / share - mean_a**2) * (windows(b * b) / share - mean_b**2)
    covariance = windows(a * b) / share - mean_a * mean_b
    return np.where(spread > EVEN, covariance / np.sqrt(np.maximum(spread, EVEN)), 0.0)


def reprojected(
    surface: Surface, matched: Sequence[View], left_out: Sequence[View], by_m: float = 0.0
) -> dict[str, Reprojection]:
    """Comparison with each left-out image, by name.

    by_m : all heights are raised by this much first, to see how far the correlations fall for a wrong surface.
    """
    moved = surface.moved(by_m)
    has_height = np.isfinite(surface.xyz[..., 2])
    textures = [shown(view, moved) for view in matched]
    return {view.name: compared(shown(view, moved), textures, has_height) for view in left_out}
