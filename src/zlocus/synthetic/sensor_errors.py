"""Errors of real sensors: column gains, shot noise, saturation, compression, and lines that are displaced."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.cameras import SatelliteCamera

BLOCK_PX = 8
WAVE_STREAM = 59
N_WAVES = 3
WAVE_ROWS = (200.0, 1200.0)
INVERSE_STEPS = 6


@dataclass(frozen=True)
class SensorErrors:
    """Errors of one image.

    column_gain : standard deviation of the gain of each column, relative. shot : variance of the shot noise over the
    signal, DN. quantum : step to which the coefficients of blocks of 8 x 8 pixels are rounded, DN; 0: no compression.
    saturation : largest digital number.
    """

    column_gain: float = 0.0
    shot: float = 0.0
    quantum: float = 0.0
    saturation: int | None = None


def noisy_signal(signal: NDArray[np.float32], errors: SensorErrors, rng: np.random.Generator) -> NDArray[np.float32]:
    """The signal (r, c) DN with the gains of its columns and with shot noise."""
    if errors.column_gain:
        signal = signal * (1.0 + errors.column_gain * rng.standard_normal(signal.shape[1], dtype=np.float32))
    if errors.shot:
        sigma = np.sqrt(np.maximum(errors.shot * signal, 0.0))
        signal = signal + sigma * rng.standard_normal(signal.shape, dtype=np.float32)
    return np.asarray(signal, np.float32)


def saturated(signal: NDArray[np.float32], errors: SensorErrors) -> NDArray[np.float32]:
    """The signal (r, c) DN limited to what the sensor can tell."""
    return signal if errors.saturation is None else np.minimum(signal, np.float32(errors.saturation))


def compressed(signal: NDArray[np.float32], errors: SensorErrors) -> NDArray[np.float32]:
    """The signal (r, c) DN after a compression with losses: coefficients of blocks are rounded to a quantum.

    The mean of a block is kept, as compression on board of satellites does.
    """
    if not errors.quantum:
        return signal
    rows, cols = signal.shape
    padded = np.pad(signal, [(0, -rows % BLOCK_PX), (0, -cols % BLOCK_PX)], mode="edge")
    blocks = padded.reshape(padded.shape[0] // BLOCK_PX, BLOCK_PX, padded.shape[1] // BLOCK_PX, BLOCK_PX)
    coefficients = fft.dctn(blocks, axes=(1, 3), norm="ortho")
    rounded = errors.quantum * np.rint(coefficients / np.float32(errors.quantum))
    rounded[:, 0, :, 0] = coefficients[:, 0, :, 0]
    restored = fft.idctn(rounded, axes=(1, 3), norm="ortho").reshape(padded.shape)
    return np.asarray(restored[:rows, :cols], np.float32)


@dataclass(frozen=True)
class WavySatelliteCamera(SatelliteCamera):
    """A satellite whose attitude oscillates: its rows are displaced in slow waves that RPCs do not describe.

    wave_px : largest displacement along and across the flight; wave_seed : of amplitudes, periods and phases.
    """

    wave_px: float = 0.0
    wave_seed: tuple[int, ...] = (0,)

    @property
    def steady(self) -> SatelliteCamera:
        """The camera without the waves."""
        return SatelliteCamera(
            self.target, self.centre, self.gsd_m, self.along_deg, self.across_deg, self.heading_deg, self.altitude_m
        )

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`. The displacement at the row where the point is seen is found by iteration."""
        steady = self.steady.image_from_ground(xyz)
        seen = steady
        for _ in range(INVERSE_STEPS):
            seen = steady + self.displacement(seen[:, 1])
        return seen

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xy = np.asarray(xy, float)
        return self.steady.ground_from_image(xy - self.displacement(xy[:, 1]), z)

    def displacement(self, row: FloatArray) -> FloatArray:
        """Displacements (n, 2) px, column and row, of pixels in rows (n,), counted from the image's origin."""
        rng = np.random.default_rng([*self.wave_seed, WAVE_STREAM])
        periods = WAVE_ROWS[0] * (WAVE_ROWS[1] / WAVE_ROWS[0]) ** rng.random((N_WAVES, 2))
        amplitudes = periods * rng.uniform(0.5, 1.0, (N_WAVES, 2))
        amplitudes *= self.wave_px / amplitudes.sum(axis=0)
        phases = 2.0 * np.pi * rng.random((N_WAVES, 2))
        angles = 2.0 * np.pi * np.asarray(row)[:, None, None] / periods + phases
        return np.asarray((amplitudes * np.sin(angles)).sum(axis=1))
