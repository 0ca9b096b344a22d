"""Render images of a `SyntheticGround` for any sensor model: rays, light, optics, noise, quantisation.

Rays are straight between two heights that enclose the ground, which is exact for the cameras of rendered scenes. For a
sensor with curved rays (an RPC) the chord is used.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from zlocus.core.errors import GeometryError
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.synthetic.raycast import (
    MISS,
    Appearance,
    HeightField,
    Light,
    Sampling,
    cast_rays,
    render_rows,
    sunlit_cells,
)
from zlocus.synthetic.sensor_errors import SensorErrors, compressed, noisy_signal, saturated
from zlocus.synthetic.terrain import SyntheticGround

# Less than a pixel is needed by lenses of short focal length (in px) with distortion.
SPACINGS_PX = (64, 32, 16, 8, 4, 2, 1, 0.5)
TABLE_TOLERANCE_PX = 1e-3
HEIGHT_MARGIN_M = 1.0
ROWS_PER_BAND = 64
NO_ERRORS = SensorErrors()


@dataclass(frozen=True)
class Sun:
    """Direction to the sun: azimuth clockwise from north, elevation above the horizon, degrees."""

    azimuth_deg: float
    elevation_deg: float


@dataclass(frozen=True)
class Optics:
    """Conversion of radiance to digital numbers (DN): haze + gain x blurred radiance, with noise, rounded.

    blur_px : sigma of the point spread function. noise : standard deviation relative to the signal above the haze;
    noise_floor : standard deviation in DN; both are added in quadrature. n_clouds : number of soft bright discs.
    """

    gain: float = 1100.0
    haze: float = 140.0
    blur_px: float = 0.58
    noise: float = 0.005
    noise_floor: float = 4.8
    n_clouds: int = 0
    dtype: str = "uint16"


def render(
    ground: SyntheticGround,
    sensor: SensorModel,
    shape: tuple[int, int],
    sun: Sun,
    samples: int = 2,
    lit: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Radiance (r, c) float32 of an image of `shape`. It does not depend on the number of threads.

    A pixel is the mean of samples x samples rays; 0 where one of them does not meet the ground. lit : (r, c) bool of
    the height field, `sunlit(ground, sun)` if it is known already.
    """
    lower, upper = _enclosing(ground)
    spacing, table = ray_table(ground, sensor, shape, (lower, upper))
    lit = sunlit(ground, sun) if lit is None else lit
    appearance = Appearance(ground.material, ground.materials, ground.textures, lit)
    sampling = Sampling(float(spacing), upper, lower, samples)
    out = np.empty(shape, np.float32)
    field, light = field_of(ground), _light(ground, sun)
    _in_bands(lambda first, band: render_rows(first, table, sampling, field, appearance, light, band), out)
    return out


def sunlit(ground: SyntheticGround, sun: Sun) -> NDArray[np.bool_]:
    """Whether the sun lights the centre of each cell, (r, c) bool."""
    out = np.empty(ground.heights.shape, np.bool_)
    field, light = field_of(ground), _light(ground, sun)
    _in_bands(lambda first, band: sunlit_cells(first, field, light, band), out)
    return out


def _in_bands(fill: Callable[[int, Any], None], out: NDArray[Any]) -> None:
    """Call fill(first_row, rows) for bands of rows of `out`, in threads. The kernels release the GIL."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        firsts = range(0, len(out), ROWS_PER_BAND)
        list(pool.map(lambda first: fill(first, out[first : first + ROWS_PER_BAND]), firsts))


def field_of(ground: SyntheticGround) -> HeightField:
    """The surface of the ground, as kernels take it."""
    return HeightField(ground.planes, ground.block_tops)


def _steepest(ground: SyntheticGround) -> float:
    """Upper bound of the rise of a plane above the centre of its cell, m."""
    return float(max(np.abs(ground.slopes[..., k]).max() for k in (0, 1)))


def _enclosing(ground: SyntheticGround) -> tuple[float, float]:
    """A height below and a height above all of the field, m."""
    low, high = ground.height_range
    slack = _steepest(ground) + HEIGHT_MARGIN_M
    return low - slack, high + slack


def _light(ground: SyntheticGround, sun: Sun) -> Light:
    """The sun and the units of the ground, as kernels take them."""
    azimuth, elevation = np.deg2rad(sun.azimuth_deg), np.deg2rad(sun.elevation_deg)
    to_sun = (np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation))
    sun_u, sun_v, sun_z = map(float, to_sun)
    return Light(sun_u, sun_v, sun_z, float(ground.step), float(ground.texel_m), _enclosing(ground)[1])


def _field_from_image(ground: SyntheticGround, sensor: SensorModel, xy: FloatArray, z: float) -> FloatArray:
    """Field coordinates (n, 2), in cells, of image positions (n, 2) px at height z."""
    xyz = sensor.ground_from_image(xy, np.full(len(xy), z))
    return np.column_stack([(xyz[:, 0] - ground.x0) / ground.step, (ground.y0 - xyz[:, 1]) / ground.step])


def ray_table(
    ground: SyntheticGround, sensor: SensorModel, shape: tuple[int, int], z_range: tuple[float, float]
) -> tuple[float, FloatArray]:
    """Rays at the nodes of a coarse lattice in the image, for bilinear interpolation between them.

    Returns the spacing (px) and a table (a, b, 4) float64: field coordinates at the upper and at the lower height, for
    image positions (-1 + b * spacing, -1 + a * spacing). The spacing is the widest with an interpolation error below
    TABLE_TOLERANCE_PX at the middles of the lattice's cells.

    Raises
    ------
    GeometryError
        The sensor cannot map its own image, or its rays change too fast to be tabulated.
    """
    for spacing in SPACINGS_PX:
        rows, cols = (-1.0 + spacing * np.arange((n + 1) // spacing + 2, dtype=np.float64) for n in shape)
        table, middle = (
            np.hstack([_field_from_image(ground, sensor, xy, z) for z in (z_range[1], z_range[0])])
            for xy in (_lattice(rows, cols), _lattice(rows[:-1] + spacing / 2, cols[:-1] + spacing / 2))
        )
        table = table.reshape(len(rows), len(cols), 4)
        if not np.isfinite(table).all():
            raise GeometryError(f"The sensor does not map all of its {shape[0]} x {shape[1]} image to the ground.")
        mean = (table[:-1, :-1] + table[:-1, 1:] + table[1:, :-1] + table[1:, 1:]) / 4
        pixel_cells = np.abs(np.diff(table, axis=1)).max() / spacing
        if np.abs(mean.reshape(-1, 4) - middle).max() < TABLE_TOLERANCE_PX * pixel_cells:
            return spacing, table
    raise GeometryError("The sensor's rays change too fast from pixel to pixel to be rendered: smooth its motion.")


def _lattice(rows: FloatArray, cols: FloatArray) -> FloatArray:
    """Image positions (n, 2) px of the nodes of a lattice, row by row."""
    col, row = np.meshgrid(cols, rows)
    return np.column_stack([col.ravel(), row.ravel()])


def visible_ground_points(ground: SyntheticGround, sensor: SensorModel, xy: FloatArray) -> FloatArray:
    """Ground points (n, 3) m seen at image positions (n, 2) px; NaN where a ray misses the ground."""
    lower, upper = _enclosing(ground)
    start, end = (_field_from_image(ground, sensor, xy, z) for z in (upper, lower))
    n = len(xy)
    rays = np.column_stack([start, np.full(n, upper), end - start, np.full(n, lower - upper)])
    kinds, places = cast_rays(rays, field_of(ground))
    places[kinds == MISS] = np.nan
    return np.column_stack(
        [ground.x0 + ground.step * places[:, 0], ground.y0 - ground.step * places[:, 1], places[:, 2]]
    )


def expose(
    radiance: NDArray[np.float32], optics: Optics, rng: np.random.Generator, errors: SensorErrors = NO_ERRORS
) -> NDArray[np.integer]:
    """Digital numbers (r, c) of `optics.dtype` from radiance; 0 where the radiance is 0, at least 1 elsewhere."""
    signal = optics.gain * gaussian_filter(radiance, optics.blur_px, mode="nearest")
    if optics.n_clouds:
        _add_clouds(signal, optics, rng)
    sigma = np.sqrt((optics.noise * signal) ** 2 + np.float32(optics.noise_floor) ** 2)
    signal += sigma * rng.standard_normal(signal.shape, dtype=np.float32) + np.float32(optics.haze)
    signal = compressed(saturated(noisy_signal(signal, errors, rng), errors), errors)
    signal = saturated(signal, errors)
    dtype = np.dtype(optics.dtype)
    numbers = np.clip(np.rint(signal), 1, np.iinfo(dtype).max).astype(dtype)
    numbers[radiance == 0.0] = 0
    return np.asarray(numbers)


def _add_clouds(signal: NDArray[np.float32], optics: Optics, rng: np.random.Generator) -> None:
    """Add soft bright discs with radii of a fortieth to a sixteenth of the image."""
    rows, cols = signal.shape
    for _ in range(optics.n_clouds):
        radius = rng.uniform(0.025, 0.06) * min(rows, cols)
        dy = (np.arange(rows, dtype=np.float32) - rng.uniform(0, rows))[:, None]
        dx = (np.arange(cols, dtype=np.float32) - rng.uniform(0, cols))[None, :]
        cover = np.minimum(1.0, 1.4 * np.exp(-0.5 * (dx**2 + dy**2) / radius**2))
        signal += cover * (np.float32(1.2 * optics.gain) - signal)
