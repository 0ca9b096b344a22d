"""Natural textures that repeat without a seam: gravel, grass and fractal noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

TEXTURE_SIZE = 1024
GRAVEL, GRASS, FRACTAL = 0, 1, 2
STONES = (72, 44)
STROKE_DIRECTIONS = 7
STROKE_DENSITY = 0.004
STROKE_LENGTH, STROKE_WIDTH = 11.0, 1.1


def natural_textures(rng: np.random.Generator, size: int = TEXTURE_SIZE) -> NDArray[np.float32]:
    """Periodic textures (3, t, t) float32 of gravel, grass and fractal noise; mean 0 and standard deviation 1 each."""
    fine, coarse = (_stones(rng, size, max(2, n * size // TEXTURE_SIZE)) for n in STONES)
    fractal = fractal_surface(rng, (size, size), 1.0, longest=size / 8, exponent=1.1)
    gravel = _unit(fine) + 0.9 * _unit(coarse) + 0.3 * fractal
    grass = _unit(_strokes(rng, size)) + 0.3 * fractal
    return np.stack([_unit(gravel), _unit(grass), fractal])


def fractal_surface(
    rng: np.random.Generator, shape: tuple[int, int], spacing: float, longest: float, exponent: float
) -> NDArray[np.float32]:
    """Periodic noise (r, c) float32 of mean 0 and standard deviation 1.

    Its amplitude is proportional to wavelength ** exponent below the wavelength `longest`, which has the unit of
    `spacing`.
    """
    rows = fft.fftfreq(shape[0], spacing)[:, None]
    cols = fft.rfftfreq(shape[1], spacing)[None, :]
    amplitude = (rows**2 + cols**2 + longest**-2) ** (-exponent / 2)
    amplitude[0, 0] = 0.0
    spectrum = fft.rfft2(rng.standard_normal(shape, dtype=np.float32)) * amplitude.astype(np.float32)
    return _unit(fft.irfft2(spectrum, s=shape))


def _unit(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray((values - values.mean()) / values.std(), np.float32)


def _stones(rng: np.random.Generator, size: int, n: int) -> NDArray[np.float32]:
    """Stones with dark gaps, from distances to the two nearest of n x n jittered points (Worley, 1996)."""
    jitter = rng.uniform(0.0, 1.0, (2, n, n)).astype(np.float32)
    brightness = rng.normal(0.0, 0.30, (n, n)).astype(np.float32)
    place = (np.arange(size, dtype=np.float32) + 0.5) * (n / size)
    cell = place.astype(np.int64)
    first = np.full((size, size), np.inf, np.float32)
    second = first.copy()
    shade = np.zeros((size, size), np.float32)
    for row in (-1, 0, 1):
        for col in (-1, 0, 1):
            at = np.ix_((cell + row) % n, (cell + col) % n)
            dy = (cell + row - place)[:, None].astype(np.float32) + jitter[0][at]
            dx = (cell + col - place)[None, :].astype(np.float32) + jitter[1][at]
            distance = np.sqrt(dx * dx + dy * dy)
            nearer = distance < first
            second = np.where(nearer, first, np.minimum(second, distance))
            shade = np.where(nearer, brightness[at], shade)
            first = np.where(nearer, distance, first)
    return np.asarray(shade - np.exp(-(second - first) / 0.12), np.float32)


def _strokes(rng: np.random.Generator, size: int) -> NDArray[np.float32]:
    """Blades of grass in several directions: sparse impulses blurred by narrow Gaussians, in the Fourier domain."""
    rows = fft.fftfreq(size)[:, None]
    cols = fft.rfftfreq(size)[None, :]
    total = np.zeros((size, len(cols[0])), np.complex64)
    for angle in (np.arange(STROKE_DIRECTIONS) + rng.uniform()) * np.pi / STROKE_DIRECTIONS:
        along = rows * np.sin(angle) + cols * np.cos(angle)
        across = rows * np.cos(angle) - cols * np.sin(angle)
        impulses = rng.standard_normal((size, size), dtype=np.float32)
        impulses *= rng.random((size, size), dtype=np.float32) < STROKE_DENSITY
        blur = np.exp(-2.0 * np.pi**2 * ((along * STROKE_LENGTH) ** 2 + (across * STROKE_WIDTH) ** 2))
        total += fft.rfft2(impulses) * blur.astype(np.float32)
    return np.asarray(fft.irfft2(total, s=(size, size)), np.float32)
