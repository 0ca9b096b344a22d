"""Photographs of a drone: rendered radiance with the camera's blur, vignetting, noise, tone curve and compression."""

from __future__ import annotations

import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.drone_ground import ColouredGround
from zlocus.synthetic.raycast import MISS, TOP, cast_rays
from zlocus.synthetic.render import Sun, field_of, render
from zlocus.synthetic.terrain import SyntheticGround

FloatImage = NDArray[np.float32]

# Shares of red, green and blue in the luminance. Source: ITU-R BT.601.
LUMINANCE = (0.299, 0.587, 0.114)
# Colour is rendered at every second pixel and row, as JPEG stores it, along rays between nodes at a wider spacing.
COLOUR_SPACING_PX, COLOUR_NODES_PX = 2, 8
COLOUR_ROWS_AT_ONCE = 64
# Nodes of the spline through the rays of a frame, along each side, and pixels that it covers beyond the border.
SPLINE_NODES, SPLINE_MARGIN_PX = (97, 129), 8.0
# A point this far behind the border of a cell, along the ray, lies inside the cell (part of the ray's length).
BEHIND_BORDER = 1e-5
HEIGHT_MARGIN_M = 2.0
# Slope of the logarithm of the grey value by that of the light, in the middle tones, and light at full grey.
GAMMA, WHITE = 1 / 2.2, 1.0
CONTRAST = 0.25


@dataclass(frozen=True)
class DronePhoto:
    """What a camera does to the light of a scene.

    exposure : factor from radiance to light, where 1 is the full scale; blur_px : standard deviation of the point
    spread function; motion_px : length of the motion during the exposure, along the columns; vignetting : share of the
    light that is missing in the corners; electrons : at full scale, which give the shot noise; sharpening : share of
    the difference to a blurred image that the camera adds; quality : of the JPEG, 1 to 100.
    """

    exposure: float = 1.0
    blur_px: float = 0.65
    motion_px: float = 0.6
    vignetting: float = 0.3
    electrons: float = 6000.0
    sharpening: float = 0.5
    quality: int = 92


class SplinedRays:
    """A frame camera whose rays are interpolated by quintic splines, as a `SensorModel` for rendering.

    The exact inverse of the distortion takes longer than rendering does. The splines differ from it by less than
    1e-4 px. Positions have to be those of a lattice, row by row, as the renderer asks for them.
    """

    def __init__(self, sensor: FrameModel, shape: tuple[int, int]) -> None:
        rows, cols = (
            np.linspace(-SPLINE_MARGIN_PX, size - 1 + SPLINE_MARGIN_PX, n)
            for size, n in zip(shape, SPLINE_NODES, strict=True)
        )
        col, row = np.meshgrid(cols, rows)
        ray = sensor.ray_from_image(np.column_stack([col.ravel(), row.ravel()]))
        aside = (ray[:, :2] / ray[:, 2:]).reshape(*col.shape, 2)
        self.sensor = sensor
        self._splines = tuple(RectBivariateSpline(rows, cols, aside[..., k], kx=5, ky=5) for k in (0, 1))

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return self.sensor.image_from_ground(xyz)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`; xy : positions (n, 2) px of a lattice, row by row."""
        n_cols = int(np.argmax(xy[:, 1] != xy[0, 1])) or len(xy)
        rows, cols = xy[::n_cols, 1], xy[:n_cols, 0]
        assert len(rows) * len(cols) == len(xy), "positions are a lattice"
        x, y, height = (np.array(self.sensor.centre) + self.sensor.displacement(xy)).T
        east, north = (spline(rows, cols).ravel() for spline in self._splines)
        return np.column_stack([x + (z - height) * east, y + (z - height) * north, z])

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None


def photographed(
    coloured_ground: ColouredGround, sensor: FrameModel, shape: tuple[int, int], lit: NDArray[np.bool_], sun: Sun,
    samples: int, photo: DronePhoto, rng: np.random.Generator,
) -> NDArray[np.uint8]:  # fmt: skip
    """Red, green and blue (3, r, c) uint8 of an image, before compression. lit : see `render`.

    The luminance is exact; colour has half its resolution.
    """
    radiance = render(coloured_ground.ground, SplinedRays(sensor, shape), shape, sun, samples, lit)
    grey = developed(radiance, photo, rng)
    del radiance
    ratios = gaussian_filter(seen_colours(coloured_ground, sensor, shape), (0, photo.blur_px, photo.blur_px))
    bands = np.empty((3, *shape), np.uint8)
    for band, ratio in zip(bands, ratios, strict=True):
        full = cv2.resize(ratio, shape[::-1], interpolation=cv2.INTER_LINEAR)
        band[:] = np.clip(np.rint(grey * full), 0, 255)
    return bands


def developed(radiance: FloatImage, photo: DronePhoto, rng: np.random.Generator) -> FloatImage:
    """Grey values (r, c) float32, 0 to 255, of radiance (r, c)."""
    light = gaussian_filter(photo.exposure * radiance, photo.blur_px, mode="nearest")
    # The standard deviation of a uniform motion is its length over the root of 12.
    light = gaussian_filter1d(light, photo.motion_px / np.sqrt(12.0), axis=0, mode="nearest")
    light *= vignette(light.shape, photo.vignetting)
    light += np.sqrt(light / np.float32(photo.electrons)) * rng.standard_normal(light.shape, dtype=np.float32)
    tone = toned(light)
    tone += np.float32(photo.sharpening) * (tone - gaussian_filter(tone, 1.0, mode="nearest"))
    return np.asarray(np.clip(255.0 * tone, 0.0, 255.0))


def vignette(shape: tuple[int, int], missing: float) -> FloatImage:
    """Share of the light that arrives, (r, c) float32: 1 in the middle, 1 - missing in the corners."""
    y, x = (np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in shape)
    half_rows, half_cols = shape[0] / np.hypot(*shape), shape[1] / np.hypot(*shape)
    return np.asarray(1.0 - missing * ((half_rows * y[:, None]) ** 2 + (half_cols * x) ** 2), np.float32)


def toned(light: FloatImage) -> FloatImage:
    """Tone 0 to 1 of light, (r, c) float32: a gamma, then a curve that steepens the middle and saturates softly."""
    tone = np.clip(light / WHITE, 0.0, 1.0) ** np.float32(GAMMA)
    return np.asarray((1.0 - CONTRAST) * tone + CONTRAST * tone * tone * (3.0 - 2.0 * tone), np.float32)


def seen_colours(coloured_ground: ColouredGround, sensor: FrameModel, shape: tuple[int, int]) -> FloatImage:
    """Factors of red, green and blue (3, r / 2, c / 2) float32 of what an image shows; their luminance is 1."""
    ground = coloured_ground.ground
    low, high = ground.height_range
    upper, lower = high + HEIGHT_MARGIN_M, low - HEIGHT_MARGIN_M
    table = _nodes(ground, sensor, shape, (upper, lower))
    rows, cols = (np.arange(0.5, n - 0.5, COLOUR_SPACING_PX) for n in shape)
    out = np.empty((3, len(rows), len(cols)), np.float32)
    field = field_of(ground)

    def fill(first: int) -> None:
        part = rows[first : first + COLOUR_ROWS_AT_ONCE]
        at = _interpolated(table, part, cols)
        n = len(at)
        rays = np.column_stack([at[:, :2], np.full(n, upper), at[:, 2:] - at[:, :2], np.full(n, lower - upper)])
        kinds, places = cast_rays(rays, field)
        places[kinds == MISS] = 0.0
        col, row = (places[:, :2] + BEHIND_BORDER * rays[:, 3:5]).astype(np.int64).T
        last_row, last_col = (n - 1 for n in ground.material.shape)
        material = ground.material[np.clip(row, 0, last_row), np.clip(col, 0, last_col)]
        is_top = (kinds == TOP)[:, None]
        colours = np.where(is_top, coloured_ground.top_colours[material], coloured_ground.wall_colours[material])
        out[:, first : first + len(part)] = colours.T.reshape(3, len(part), len(cols))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(fill, range(0, len(rows), COLOUR_ROWS_AT_ONCE)))
    return out


def _nodes(
    ground: SyntheticGround, sensor: FrameModel, shape: tuple[int, int], heights: tuple[float, float]
) -> FloatArray:  # fmt: skip
    """Field coordinates (a, b, 4) at two heights, for image positions at multiples of `COLOUR_NODES_PX`."""
    rows, cols = (COLOUR_NODES_PX * np.arange(n // COLOUR_NODES_PX + 2, dtype=np.float64) for n in shape)
    col, row = np.meshgrid(cols, rows)
    xy = np.column_stack([col.ravel(), row.ravel()])
    xyz = [sensor.ground_from_image(xy, np.full(len(xy), z)) for z in heights]
    at = [np.column_stack([each[:, 0] - ground.x0, ground.y0 - each[:, 1]]) / ground.step for each in xyz]
    return np.hstack(at).reshape(*col.shape, 4)


def _interpolated(table: FloatArray, rows: FloatArray, cols: FloatArray) -> FloatArray:
    """Values (n, 4) of a table of `_nodes` at image positions, row by row."""
    (a, p), (b, q) = (np.divmod(at / COLOUR_NODES_PX, 1.0) for at in (rows, cols))
    a, b, p, q = a.astype(np.int64), b.astype(np.int64), p[:, None, None], q[:, None]
    above = (1.0 - p) * table[a] + p * table[a + 1]
    return np.asarray((1.0 - q) * above[:, b] + q * above[:, b + 1]).reshape(-1, table.shape[2])


def write_photo(path: Path, bands: NDArray[np.uint8], quality: int) -> None:
    """Write an image (3, r, c) as JPEG."""
    profile = {"driver": "JPEG", "height": bands.shape[1], "width": bands.shape[2], "count": 3, "dtype": "uint8"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile, quality=quality) as file:
            file.write(bands)
