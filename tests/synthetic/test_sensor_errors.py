"""Errors of sensors: gains of columns, noise, saturation, compression and displaced lines."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.sensor_errors import (
    BLOCK_PX,
    SensorErrors,
    WavySatelliteCamera,
    compressed,
    noisy_signal,
    saturated,
)

SIGNAL_DN, EXACT_PX = 1000.0, 1e-6
# Standard deviations from 400 x 300 samples are known to a few per cent.
SPREAD_TOLERANCE = 0.05


def even(rows: int = 400, cols: int = 300) -> np.ndarray:
    return np.full((rows, cols), SIGNAL_DN, np.float32)


def test_every_column_has_its_own_gain():
    seen = noisy_signal(even(), SensorErrors(column_gain=0.01), np.random.default_rng(1))
    assert np.ptp(seen, axis=0).max() == 0.0
    assert seen[0].std() == pytest.approx(0.01 * SIGNAL_DN, rel=4 * SPREAD_TOLERANCE)


def test_the_variance_of_shot_noise_is_proportional_to_the_signal():
    errors = SensorErrors(shot=0.09)
    spreads = [
        noisy_signal(factor * even(), errors, np.random.default_rng(2)).std()
        for factor in (np.float32(1), np.float32(4))
    ]
    assert spreads[0] == pytest.approx(np.sqrt(0.09 * SIGNAL_DN), rel=SPREAD_TOLERANCE)
    assert spreads[1] / spreads[0] == pytest.approx(2.0, rel=SPREAD_TOLERANCE)


def test_a_sensor_tells_nothing_above_its_saturation():
    signal = np.array([[10.0, 4094.0, 4096.0, 9000.0]], np.float32)
    np.testing.assert_array_equal(saturated(signal, SensorErrors(saturation=4095)), [[10.0, 4094.0, 4095.0, 4095.0]])
    np.testing.assert_array_equal(saturated(signal, SensorErrors()), signal)


def test_compression_keeps_the_mean_of_blocks_and_drops_weak_texture():
    """Texture below half a quantum is gone, stronger texture stays within half a quantum for each coefficient."""
    rng = np.random.default_rng(3)
    weak = even(64, 61) + 0.1 * rng.standard_normal((64, 61), dtype=np.float32)
    strong = even(64, 61) + 80.0 * rng.standard_normal((64, 61), dtype=np.float32)
    errors = SensorErrors(quantum=10.0)
    found = compressed(weak, errors)
    block = found[:BLOCK_PX, :BLOCK_PX]
    assert np.ptp(block) < 1e-3
    assert block.mean() == pytest.approx(weak[:BLOCK_PX, :BLOCK_PX].mean(), abs=1e-3)
    difference = compressed(strong, errors) - strong
    assert 0.0 < np.abs(difference).max() <= 5.0 * BLOCK_PX
    assert difference.std() == pytest.approx(10.0 / np.sqrt(12.0), rel=4 * SPREAD_TOLERANCE)
    np.testing.assert_array_equal(compressed(strong, SensorErrors()), strong)


def test_waves_displace_lines_and_projections_are_inverse():
    steady = SatelliteCamera((0.0, 0.0, 100.0), (300.0, 300.0), 0.5, 12.0, -4.0)
    wavy = WavySatelliteCamera((0.0, 0.0, 100.0), (300.0, 300.0), 0.5, 12.0, -4.0, wave_px=0.3, wave_seed=(4, 2))
    xy = np.array([(c, r) for r in np.linspace(0.0, 600.0, 31) for c in (0.0, 250.0)])
    ground = wavy.ground_from_image(xy, np.full(len(xy), 130.0))
    np.testing.assert_allclose(wavy.image_from_ground(ground), xy, rtol=0, atol=EXACT_PX)
    by = xy - steady.image_from_ground(ground)
    np.testing.assert_allclose(by, wavy.displacement(xy[:, 1]), rtol=0, atol=EXACT_PX)
    assert 0.05 < np.abs(by).max() <= 0.3 + EXACT_PX
    # All pixels of a line are displaced alike.
    np.testing.assert_allclose(by[0::2], by[1::2], rtol=0, atol=EXACT_PX)
