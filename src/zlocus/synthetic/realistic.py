"""Specifications of scenes that are as hard as real images.

Every scene of this recipe has plain and saturated surfaces, crops in rows, water, forest and moving cars, seen by
sensors with noise, column gains, compression, attitude waves and pointing errors, on two days. Rarer things (clouds,
snow, greenhouses, towers of 130 m ...) occur in a share of the scenes. Which share was chosen so that matchers other
than zlocus find these scenes as hard as independent ones, see `docs/reference/realistic_scenes.md`.
"""

from __future__ import annotations

import numpy as np

from zlocus.synthetic.appearance import Changes
from zlocus.synthetic.objects import Objects
from zlocus.synthetic.render import Optics, Sun
from zlocus.synthetic.scenes import SceneSpec, ViewSpec
from zlocus.synthetic.sensor_errors import SensorErrors
from zlocus.synthetic.weather import Weather

RECIPE_STREAM = 101
SIZE_PX, MARGIN_M, RELIEF_M, LONGEST_M = 720, 20.0, 100.0, 450.0
MAX_POINTING_PX, MAX_WAVE_PX = 0.8, (0.1, 0.35)
BLUR_PX = (0.75, 0.9)
CHANGES = Changes(directional=0.08, daily=0.12, cars_per_km=6.0)
FIRST_SUN, SECOND_SUN = Sun(152.0, 48.0), Sun(215.0, 31.0)
# Name, angles along and across the flight, heading, day.
ANGLES = (
    ("n1", 1.0, -4.0, 2.0, 0), ("f1", 17.0, -4.0, 2.0, 0), ("b1", -16.0, -5.0, 2.0, 0),
    ("n2", -2.0, 11.0, -1.5, 1), ("f2", 15.0, 12.0, -1.5, 1), ("s1", 7.0, -4.0, 2.0, 0),
)  # fmt: skip
CLOUDY_SHARES, HAZY_SHARE = (0.1, 0.3), 0.2
CLOUD_SHARE = 0.015


def realistic_spec(seed: int) -> SceneSpec:
    """A realistic scene of 360 m x 360 m with six images of two days."""
    rng = np.random.default_rng([seed, RECIPE_STREAM])
    views = tuple(_view(rng, *angles) for angles in ANGLES)
    weather = tuple(_weather(rng, cloudy_share) for cloudy_share in CLOUDY_SHARES)
    return SceneSpec(
        kind="real", seed=seed, size=SIZE_PX, gsd_m=0.5, margin_m=MARGIN_M, base_m=400.0, relief_m=RELIEF_M,
        longest_m=LONGEST_M,
        objects=Objects(0.0, 0.0, 0.0, 0.0), views=views, changes=CHANGES, weather=weather,
        west_m=500100.0, north_m=5205900.0,
    )  # fmt: skip


def _view(
    rng: np.random.Generator, name: str, along_deg: float, across_deg: float, heading_deg: float, day: int
) -> ViewSpec:
    """A view with the errors of its own that real ones have."""
    gain = rng.uniform(4200.0, 5200.0) * (1.0 if day == 0 else 0.8)
    haze, blur_px = rng.uniform(120.0, 180.0), rng.uniform(*BLUR_PX)
    optics = Optics(gain=gain, haze=haze, blur_px=blur_px, noise=0.0, noise_floor=5.0)
    errors = SensorErrors(column_gain=0.004, shot=0.05, quantum=rng.uniform(8.0, 14.0), saturation=4095)
    row_px, col_px = rng.uniform(-MAX_POINTING_PX, MAX_POINTING_PX, 2)
    return ViewSpec(
        name, along_deg, across_deg, heading_deg, FIRST_SUN if day == 0 else SECOND_SUN, optics,
        float(row_px), float(col_px), day, errors, float(rng.uniform(*MAX_WAVE_PX)),
    )  # fmt: skip


def _weather(rng: np.random.Generator, cloudy_share: float) -> Weather:
    """Weather of a day: always some moisture, haze and clouds in a share of the scenes."""
    is_cloudy, is_hazy = rng.random(2) < (cloudy_share, HAZY_SHARE)
    haze_share = float(rng.uniform(0.1, 0.3))
    return Weather(
        cloud_share=CLOUD_SHARE if is_cloudy else 0.0, haze_share=haze_share if is_hazy else 0.0, moisture=0.05
    )
