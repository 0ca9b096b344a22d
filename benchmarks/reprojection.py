"""Check of a surface by images that were left out of the matching. It needs no truth, and takes any sensor model.

The surface is textured with the matched images and compared with every left-out image: both are resampled at the cells
of the surface and correlated over windows of `WINDOW` x `WINDOW` cells (a cell is about a pixel), where both show the
surface. A window takes its texture from the matched image with the viewing direction nearest to that of the left-out
image. Occlusions follow from the surface alone: the line of sight from a cell must not meet the surface. No window is
dropped because of its correlation.

A wrong height displaces the texture in the left-out image along the epipolar line. The displacement is searched by
correlation within `MAX_SHIFT_PX`. Windows without texture show no displacement, so they are counted apart: their
heights may be right or wrong, and this check cannot tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lines_of_sight import CLEAR_CELLS, Projection, Surface, clear_cells, highest_of, parallax_rate
from zlocus.core.scene import View
from zlocus.core.sensor_model import SensorModel
from zlocus.sensors.correction import ReducedModel

__all__ = ["CLEAR_CELLS", "Reprojection", "Surface", "clear_cells", "highest_of", "reprojected", "window_ncc"]

WINDOW = 11
# Share of a window that both images must see.
LEAST_SEEN = 0.5
# Below this product of the variances of two windows (grey values squared) one of them has no texture.
EVEN = 1e-6
# Displacements along the epipolar line that are tried, px of the left-out image.
MAX_SHIFT_PX, SHIFT_STEP_PX = 3.0, 0.5
# A window is displaced where its correlation is highest more than this many px away, is at least `LIKE` there, and
# exceeds the correlation at its place by at least `MIN_GAIN`, so that a flat maximum counts as no displacement.
DISPLACED_PX, LIKE, MIN_GAIN = 1.0, 0.5, 0.05
# A window is plain where its variance is below this many times that of the noise of the image: the noise alone then
# brings the expected correlation of right heights below 0.75.
PLAIN_VARIANCES = 4.0
# The noise of an image is that of its flattest blocks: of this many pixels a side, this quantile of all. It is at least
# the noise that rounding to whole grey values adds.
BLOCK_PX, FLATTEST, ROUNDING_NOISE = 16, 0.05, 12**-0.5


@dataclass(frozen=True)
class Reprojection:
    """Comparison of a surface with an image that was left out. n : number of windows that could be compared.

    where : (r, c) bool, cells whose window was compared. Of each such window, in the order of the cells: ncc : (n,)
    correlation, 0 without any texture; plain : (n,) bool, without texture beyond the noise of one of the two images;
    shift_px : (n,) displacement along the epipolar line, NaN where it was not searched or no correlation reaches `LIKE`
    within `MAX_SHIFT_PX`; error_m : (n,) error of height that explains the displacement, NaN as `shift_px`.

    The others are numbers of cells. empty : without a height; outside : of the image; hidden : occluded by the surface;
    untextured : not seen by a matched image; at_rim : most of the window is one of these.
    """

    where: np.ndarray
    ncc: np.ndarray
    plain: np.ndarray
    shift_px: np.ndarray
    error_m: np.ndarray
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
        """Median correlation of all compared windows."""
        return median(self.ncc)

    @property
    def judged(self) -> np.ndarray:
        """Windows (n,) that have texture in both images: only these can show an error of height."""
        return ~self.plain

    @property
    def unlike(self) -> np.ndarray:
        """Windows (n,) with texture and a correlation below `LIKE`."""
        return self.judged & (self.ncc < LIKE)

    @property
    def displaced(self) -> np.ndarray:
        """Windows (n,) with texture that the left-out image shows more than `DISPLACED_PX` away: a wrong height."""
        return self.judged & (np.abs(np.nan_to_num(self.shift_px)) > DISPLACED_PX)

    @property
    def metres_per_pixel(self) -> float:
        """Error of height that displaces a window by one pixel: the median of all windows with a displacement."""
        known = np.isfinite(self.error_m) & (self.shift_px != 0)
        return median(np.abs(self.error_m[known] / self.shift_px[known]))

    @property
    def lost(self) -> np.ndarray:
        """Windows (n,) with texture that the left-out image shows nowhere within `MAX_SHIFT_PX`: unlike everywhere."""
        return self.unlike & np.isnan(self.shift_px)


@dataclass(frozen=True)
class Shown:
    """A view resampled at the cells of a surface.

    sensor : of the pixels; pixels : (r, c) float32, of the image; noise : its standard deviation, grey values.
    projection : of the surface; grey : (r, c), defined where `inside`; inside : (r, c), inside the image; clear :
    (r, c), not occluded.
    """

    sensor: SensorModel
    pixels: np.ndarray
    noise: float
    projection: Projection
    grey: np.ndarray
    inside: np.ndarray
    clear: np.ndarray

    @classmethod
    def of(cls, view: View, surface: Surface) -> Shown:
        """The view at the cells of a surface. A view with several pixels per cell is reduced before."""
        window = view.image.read(0, 0, *view.image.shape)
        factor = pixels_per_cell(view.sensor, surface)
        sensor = ReducedModel(view.sensor, factor) if factor > 1 else view.sensor
        pixels, valid = reduced(window.pixels, factor), reduced(window.valid.astype(np.float32), factor) > 0.999
        projection = Projection.of(sensor, surface)
        (rows, cols), xy = pixels.shape, projection.xy
        inside = (xy >= 1).all(axis=2) & (xy[..., 0] <= cols - 2) & (xy[..., 1] <= rows - 2)
        nearest = np.rint(np.where(inside[..., None], xy, 0)).astype(int)
        inside &= valid[nearest[..., 1], nearest[..., 0]]
        clear = inside & projection.clear(sensor, surface)
        return cls(sensor, pixels, noise_of(pixels), projection, sampled(pixels, xy), inside, clear)

    def cosine(self, other: Shown) -> np.ndarray:
        """Cosine (r, c) of the angle between the lines of sight of two views."""
        a, b = self.projection.sight, other.projection.sight
        return ((a * b).sum(axis=2) + 1) / np.sqrt(((a * a).sum(axis=2) + 1) * ((b * b).sum(axis=2) + 1))


def pixels_per_cell(sensor: SensorModel, surface: Surface) -> int:
    """Whole pixels that fit into a cell, the median of cells all over the surface; at least 1."""
    ground = surface.xyz[surface.has_height]
    ground = ground[:: max(len(ground) // 1000, 1)]
    at = sensor.image_from_ground(ground)
    moves = [sensor.image_from_ground(ground + np.array(by) * surface.cell_m) - at for by in ((1, 0, 0), (0, 1, 0))]
    pixels = np.sqrt(np.abs(moves[0][:, 0] * moves[1][:, 1] - moves[0][:, 1] * moves[1][:, 0]))
    return max(int(median(pixels[np.isfinite(pixels)], 1.0)), 1)


def reduced(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Means of factor x factor pixels; incomplete ones at the lower and right border are left out."""
    if factor == 1:
        return pixels
    rows, cols = (n // factor for n in pixels.shape)
    whole = pixels[: rows * factor, : cols * factor]
    return whole.reshape(rows, factor, cols, factor).mean(axis=(1, 3))


def sampled(pixels: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Grey values (r, c) at image positions (r, c, 2), by cubic interpolation; any value where a position is NaN."""
    at = np.where(np.isfinite(xy), xy, 0.0).astype(np.float32)
    return cv2.remap(pixels, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def noise_of(pixels: np.ndarray) -> float:
    """Standard deviation of the noise of an image, grey values, from its flattest blocks.

    The second differences of a block in both directions cancel planes of grey values (Immerkaer 1996, Computer Vision
    and Image Understanding 64 (2), 300-302; its mask has the norm 6). Blocks of one value are saturated: not counted.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    second = cv2.filter2D(pixels, cv2.CV_32F, mask)[1:-1, 1:-1] / 6
    rows, cols = (n // BLOCK_PX for n in second.shape)
    blocks = second[: rows * BLOCK_PX, : cols * BLOCK_PX].reshape(rows, BLOCK_PX, cols, BLOCK_PX)
    noise = np.sqrt((blocks.astype(np.float64) ** 2).mean(axis=(1, 3)))
    return max(float(np.quantile(noise[noise > 0], FLATTEST)) if (noise > 0).any() else 0.0, ROUNDING_NOISE)


def median(values: np.ndarray, otherwise: float = float("nan")) -> float:
    """Median; `otherwise` without any value."""
    return float(np.median(values)) if len(values) else otherwise


@dataclass
class WindowFigures:
    """Correlation, texture and displacement of the window around each cell, (r, c), filled image by image."""

    ncc: np.ndarray
    plain: np.ndarray
    shift_px: np.ndarray
    error_m: np.ndarray

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> WindowFigures:
        """Nothing known yet."""
        unknown = np.full(shape, np.nan, np.float32)
        return cls(np.zeros(shape, np.float32), np.zeros(shape, bool), unknown, unknown.copy())


def compared(target: Shown, matched: Sequence[Shown], surface: Surface, search: bool = False) -> Reprojection:
    """Comparison of an image with the texture of the surface, at every cell that both show.

    search : also search the displacement of every window.
    """
    has_height = surface.has_height
    seen = has_height & target.inside & target.clear
    usable = [seen & one.inside & one.clear for one in matched]
    enough = [each & (windows(each.astype(float)) >= LEAST_SEEN) for each in usable]
    cosines = np.array([np.where(e, one.cosine(target), -2.0) for e, one in zip(enough, matched, strict=True)])
    nearest, is_compared = cosines.argmax(axis=0), np.logical_or.reduce(enough)
    found = WindowFigures.empty(seen.shape)
    for k, one in enumerate(matched):
        chosen = is_compared & (nearest == k)
        if chosen.any():
            compare_windows(target, one, surface, (usable[k], chosen), found, search)
    is_textured = np.logical_or.reduce(usable)
    return Reprojection(
        where=is_compared,
        ncc=found.ncc[is_compared],
        plain=found.plain[is_compared],
        shift_px=found.shift_px[is_compared],
        error_m=found.error_m[is_compared],
        cells=has_height.size,
        empty=int((~has_height).sum()),
        outside=int((has_height & ~target.inside).sum()),
        hidden=int((has_height & target.inside & ~target.clear).sum()),
        untextured=int((seen & ~is_textured).sum()),
        at_rim=int((is_textured & ~is_compared).sum()),
    )


def compare_windows(
    target: Shown, texture: Shown, surface: Surface, masks: tuple[np.ndarray, np.ndarray], found: WindowFigures,
    search: bool,
) -> None:  # fmt: skip
    """Write the figures of the windows that take their texture from one image.

    masks : cells (r, c) that both images show, and the cells whose windows are wanted.
    """
    usable, chosen = masks
    ncc, spread_a, spread_b = window_correlation(target.grey, texture.grey, usable)
    found.ncc[chosen] = ncc[chosen]
    plain = (spread_a < PLAIN_VARIANCES * target.noise**2) | (spread_b < PLAIN_VARIANCES * texture.noise**2)
    found.plain[chosen] = plain[chosen]
    if not search:
        return
    rate = parallax_rate(target.sensor, target.projection.xy, texture.projection, surface)
    speed = np.linalg.norm(rate, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = rate / speed[..., None]
    curve = displacement_curve(target, texture, usable, along)
    shift = best_shift(curve, ncc)
    found.shift_px[chosen] = shift[chosen]
    with np.errstate(invalid="ignore", divide="ignore"):
        # Where the surface is dz too high, the texture is that of ground dz lower: displaced by -dz times the rate.
        found.error_m[chosen] = (-shift / speed)[chosen]


def displacement_curve(target: Shown, texture: Shown, usable: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Correlation (s, r, c) of each window at the displacements `tried_shifts()` along the epipolar line.

    along : (r, c, 2) unit vectors of the epipolar line in the target image.
    """
    curve = [
        window_ncc(sampled(target.pixels, target.projection.xy + shift * along), texture.grey, usable)
        for shift in tried_shifts()
    ]
    return np.array(curve, np.float32)


def tried_shifts() -> np.ndarray:
    """Displacements that are tried, px, from -MAX_SHIFT_PX to MAX_SHIFT_PX."""
    n_steps = round(MAX_SHIFT_PX / SHIFT_STEP_PX)
    return np.arange(-n_steps, n_steps + 1) * SHIFT_STEP_PX


def best_shift(curve: np.ndarray, ncc: np.ndarray) -> np.ndarray:
    """Displacement (r, c) px of the highest correlation, between the tried ones by a parabola.

    0 where the highest correlation exceeds that at the place of the window by less than `MIN_GAIN` and lies more than
    `DISPLACED_PX` away: a flat curve tells of no displacement. NaN where the highest is below `LIKE`.
    """
    best = curve.argmax(axis=0)
    inner = best.clip(1, len(curve) - 2)
    before, at, after = (np.take_along_axis(curve, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    is_peak = (bend < 0) & (inner == best)
    offset = np.where(is_peak, 0.5 * (before - after) / np.where(is_peak, bend, 1.0), 0.0)
    shift = tried_shifts()[best] + SHIFT_STEP_PX * offset
    top = np.take_along_axis(curve, best[None], axis=0)[0]
    shift[(np.abs(shift) > DISPLACED_PX) & (top - ncc < MIN_GAIN)] = 0.0
    return np.where(top >= LIKE, shift, np.nan)


def windows(values: np.ndarray) -> np.ndarray:
    """Mean of the window around each cell, (r, c); values beyond the border are 0."""
    return cv2.blur(values, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT)


def window_ncc(a: np.ndarray, b: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Correlation over the usable cells of the window around each cell, (r, c); 0 where one window has no texture."""
    return window_correlation(a, b, usable)[0]


def window_correlation(a: np.ndarray, b: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlation of the window around each cell, see `window_ncc`, and the variances of both windows, (r, c) each."""
    if not usable.any():
        return (np.zeros(usable.shape),) * 3
    # The mean is subtracted first, because squares of large values lose digits.
    a, b = (np.where(usable, v - v[usable].mean(dtype=float), 0.0) for v in (a, b))
    share = np.maximum(windows(usable.astype(float)), 1e-9)
    mean_a, mean_b = windows(a) / share, windows(b) / share
    spread_a, spread_b = windows(a * a) / share - mean_a**2, windows(b * b) / share - mean_b**2
    spread = spread_a * spread_b
    covariance = windows(a * b) / share - mean_a * mean_b
    return np.where(spread > EVEN, covariance / np.sqrt(np.maximum(spread, EVEN)), 0.0), spread_a, spread_b


def reprojections(
    surface: Surface, matched: Sequence[View], left_out: Sequence[View], search: bool = False
) -> Iterator[tuple[str, Reprojection]]:
    """Name of and comparison with each left-out image. search : also search the displacement of every window."""
    textures = [Shown.of(view, surface) for view in matched]
    for view in left_out:
        yield view.name, compared(Shown.of(view, surface), textures, surface, search)


def reprojected(
    surface: Surface, matched: Sequence[View], left_out: Sequence[View], by_m: float = 0.0
) -> dict[str, Reprojection]:
    """Comparison with each left-out image, by name.

    by_m : all heights are raised by this much first, to see how far the correlations fall for a wrong surface.
    """
    return dict(reprojections(surface.moved(by_m), matched, left_out))
