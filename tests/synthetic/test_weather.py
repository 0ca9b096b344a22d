"""Weather between ground and sensor: clouds stand above the ground, so that views see them at different places."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.core.errors import ConfigError
from zlocus.synthetic.weather import CLOUD_RADIANCE, SHADOW_LIGHT, Weather, periodic_field, weathered

CLEAR_RADIANCE, SEED, CELL_M = 0.3, (5, 0), 2.0
OVERHEAD = np.zeros(2)
CLOUDY = Weather(cloud_share=0.1, cloud_height_m=600.0)


def places(side: int = 400) -> np.ndarray:
    x, y = np.meshgrid(CELL_M * np.arange(side), CELL_M * np.arange(side))
    return np.stack([x, y], axis=-1)


def seen(weather: Weather, to_sensor: np.ndarray = OVERHEAD, to_sun: np.ndarray = OVERHEAD) -> np.ndarray:
    xy = places()
    radiance = np.full(xy.shape[:2], CLEAR_RADIANCE, np.float32)
    radiance[0, 0] = 0.0
    return weathered(radiance, xy, weather, to_sensor, to_sun, SEED)


def test_clouds_cover_their_share_and_hide_the_ground():
    found = seen(CLOUDY)
    assert (found > 0.5 * CLOUD_RADIANCE).mean() == pytest.approx(CLOUDY.cloud_share, abs=0.07)
    assert found.max() == pytest.approx(CLOUD_RADIANCE, abs=1e-6)
    # What the sensor does not see stays without a value.
    assert found[0, 0] == 0.0


def test_a_cloud_is_displaced_by_its_height_and_its_shadow_by_the_sun():
    """A view that is inclined by a cell a metre sees the cloud of the nadir one at 600 m further on."""
    tangent = np.array([20.0 * CELL_M / CLOUDY.cloud_height_m, 0.0])
    far_sun = np.array([0.0, 3.0])
    nadir, inclined = seen(CLOUDY, OVERHEAD, far_sun), seen(CLOUDY, tangent, far_sun)
    is_cloud = (nadir > CLOUD_RADIANCE - 1e-6)[:, 20:]
    assert is_cloud.any()
    np.testing.assert_allclose(inclined[:, :-20][is_cloud], nadir[:, 20:][is_cloud], rtol=0, atol=1e-5)
    # The sun stands overhead, so each cloud shades the ground that the nadir view does not see for it.
    shaded = seen(CLOUDY, 0.31 * far_sun, OVERHEAD)
    below = (nadir > CLOUD_RADIANCE - 1e-6) & ~(shaded > CLEAR_RADIANCE)
    is_free_of_edges = below & (np.abs(shaded - SHADOW_LIGHT * CLEAR_RADIANCE) < 1e-4)
    assert is_free_of_edges.sum() > 0.9 * below.sum() > 0


def test_haze_lowers_contrast_and_moisture_darkens_slowly():
    xy = places(64)
    radiance = np.where(np.indices((64, 64)).sum(axis=0) % 2, 0.2, 0.4).astype(np.float32)
    hazy = weathered(radiance, xy, Weather(haze_share=0.25), OVERHEAD, OVERHEAD, SEED)
    assert np.ptp(hazy) == pytest.approx(0.75 * np.ptp(radiance), rel=1e-5)
    moist = seen(Weather(moisture=0.1))[1:]
    assert np.log(moist / CLEAR_RADIANCE).std() == pytest.approx(0.1, rel=0.5)
    assert np.diff(np.log(moist), axis=1).std() < 0.03
    assert Weather().is_clear
    assert not Weather(moisture=0.1).is_clear


def test_a_field_repeats_and_is_the_same_for_the_same_day():
    field = periodic_field(SEED, 1, 4.0, 100.0, 1.5)
    xy = np.array([[3.0, 7.0], [2000.0, 10.0]])
    np.testing.assert_allclose(field(xy + 4.0 * len(field.values)), field(xy), rtol=0, atol=1e-5)
    np.testing.assert_array_equal(periodic_field(SEED, 1, 4.0, 100.0, 1.5).values, field.values)
    assert not np.array_equal(periodic_field((5, 1), 1, 4.0, 100.0, 1.5).values, field.values)


def test_weather_out_of_range_is_refused():
    with pytest.raises(ConfigError, match="cloud_share"):
        Weather(cloud_share=1.2)
