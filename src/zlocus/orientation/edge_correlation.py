"""Correlation of two windows by the directions of their edges, and the place of its maximum to a part of a cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import binary_dilation, gaussian_filter, uniform_filter

# Windows are smoothed before edges are looked for, cells.
SMOOTHING_CELLS = 1.0
# Cells beside a missing one have no direction of their own.
RIM_CELLS = 3
# Least share of the cells of a window that have a value in both, and least mean weight of the edges of either.
MIN_KNOWN_SHARE, MIN_EDGES = 0.5, 0.02


@dataclass(frozen=True)
class Peak:
    """The maximum of a correlation surface.

    col, row : cells by which the second window must be moved back to fit the first; height : above the median of the
    surface, in robust standard deviations of it.
    """

    col: float
    row: float
    height: float


def correlation(first: NDArray[np.float32], second: NDArray[np.float32], n_search: int) -> NDArray[np.float64] | None:
    """Correlation of the middle of `first` with `second` displaced by -n_search to n_search cells, (2 n + 1, 2 n + 1).

    first, second : (r, c) float32, NaN where there is no value. None where one has too few values or edges.
    """
    template, searched = edges(first), edges(second)
    if template is None or searched is None:
        return None
    inner = slice(n_search, first.shape[0] - n_search), slice(n_search, first.shape[1] - n_search)
    middle = template[inner]
    if not (is_textured(middle) and is_textured(searched)):
        return None
    padded = np.zeros(searched.shape, np.complex128)
    padded[: middle.shape[0], : middle.shape[1]] = middle
    n = 2 * n_search + 1
    product = fft.ifft2(fft.fft2(searched) * np.conj(fft.fft2(padded))).real[:n, :n]
    power = np.abs(searched) ** 2
    side = middle.shape
    # Sums over the part of `searched` under the template, for each displacement.
    sums = uniform_filter(power, side, mode="constant") * middle.size
    at = side[0] // 2, side[1] // 2
    local = sums[at[0] : at[0] + n, at[1] : at[1] + n]
    return np.asarray(product / np.sqrt(np.maximum(local, 1e-9) * (np.abs(middle) ** 2).sum()))


def edges(grey: NDArray[np.float32]) -> NDArray[np.complex128] | None:
    """Doubled directions of the edges (r, c) complex, of length 0 to 1 by their strength; None for too few values.

    Doubled, so that an edge that is bright on the other side has the same direction.
    """
    known = np.isfinite(grey)
    if known.mean() < MIN_KNOWN_SHARE:
        return None
    filled = np.where(known, grey, np.float32(grey[known].mean())).astype(np.float64)
    smooth = gaussian_filter(filled, SMOOTHING_CELLS)
    down, across = np.gradient(smooth)
    gradient = across + 1j * down
    power = np.abs(gradient) ** 2
    if not known.all():
        power[binary_dilation(~known, iterations=RIM_CELLS)] = 0.0
    usual = float(np.median(power[power > 0.0])) if (power > 0.0).any() else 0.0
    if usual <= 0.0:
        return None
    return np.asarray(np.where(power > 0.0, gradient**2 / (power + usual), 0.0))


def is_textured(directions: NDArray[np.complex128]) -> bool:
    """Whether a window has enough edges to be compared."""
    return float(np.abs(directions).mean()) > MIN_EDGES


def peak_of(surface: NDArray[np.float64]) -> Peak | None:
    """The maximum of a correlation surface (2 n + 1, 2 n + 1), by a parabola through it and its neighbours.

    None where it lies at the border.
    """
    n = surface.shape[0] // 2
    row, col = (int(k) for k in np.unravel_index(int(surface.argmax()), surface.shape))
    if not (0 < row < 2 * n and 0 < col < 2 * n):
        return None
    middle = float(np.median(surface))
    spread = 1.4826 * float(np.median(np.abs(surface - middle)))
    height = (float(surface[row, col]) - middle) / max(spread, 1e-12)
    near = surface[row - 1 : row + 2, col - 1 : col + 2]
    down, across = np.meshgrid((-1.0, 0.0, 1.0), (-1.0, 0.0, 1.0), indexing="ij")
    x, y = across.ravel(), down.ravel()
    terms = np.column_stack([np.ones(9), x, y, x * x, x * y, y * y])
    _, b, c, d, e, f = np.linalg.lstsq(terms, near.ravel(), rcond=None)[0]
    hessian, slope = np.array([[2 * d, e], [e, 2 * f]]), np.array([b, c])
    if not (d < 0 and f < 0 and np.linalg.det(hessian) > 0):
        return Peak(float(col - n), float(row - n), height)
    moved = np.clip(-np.linalg.solve(hessian, slope), -1.0, 1.0)
    return Peak(float(col - n + moved[0]), float(row - n + moved[1]), height)
