"""Specification of a scene that a satellite sees on many days of most of a year, while the ground is changed.

As with images that are ordered one by one, each has a day, a direction and a light of its own: seasons change the
brightness of every surface and the shadows, some days are hazy, and on one day clouds pass.
"""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np

from zlocus.core.errors import ConfigError
from zlocus.synthetic.acquisitions import FIRST_DAY
from zlocus.synthetic.appearance import Changes
from zlocus.synthetic.objects import Objects
from zlocus.synthetic.realistic import realistic_spec
from zlocus.synthetic.realistic_ground import Cover
from zlocus.synthetic.render import Optics, Sun
from zlocus.synthetic.scenes import SceneSpec, ViewSpec
from zlocus.synthetic.sensor_errors import SensorErrors
from zlocus.synthetic.weather import Weather

DATES_STREAM = 103
N_IMAGES, MIN_IMAGES, MAX_IMAGES = 19, 4, 100
SIZE_PX, MARGIN_M, RELIEF_M = 320, 12.0, 30.0
DAYS = 300
# The works on the ground begin at the turn of the year.
WORKS_DAY = (datetime.date(2015, 1, 1) - FIRST_DAY).days
MAX_ALONG_DEG, MAX_ACROSS_DEG, MAX_HEADING_DEG = 24.0, 20.0, 8.0
LATITUDE_DEG, HOUR_ANGLE_DEG, TILT_DEG, EQUINOX, YEAR = 47.0, -18.0, 23.44, 81, 365.25
CHANGES = Changes(directional=0.08, daily=0.15, cars_per_km=6.0)
MAX_POINTING_PX, MAX_WAVE_PX, BLUR_PX = 0.8, 0.25, (0.7, 0.9)
# Brightest surfaces are exposed just below the largest number of the sensor.
GAIN, ROAD_ALBEDO = (2600.0, 3400.0), (0.45, 0.75)
# Every so many days are hazy; the cloudy one is counted from the first.
HAZY_EVERY, CLOUDY = 5, 3
HAZE_SHARE, CLOUD_SHARE, MOISTURE = 0.25, 0.06, 0.06


def many_dates_spec(seed: int, n_images: int = N_IMAGES) -> SceneSpec:
    """A realistic scene of 160 m x 160 m, seen on `n_images` days; a pit is dug in it at the turn of the year.

    Raises
    ------
    ConfigError
        Fewer images than two before and two after the works, or more than there can be.
    """
    if not MIN_IMAGES <= n_images <= MAX_IMAGES:
        raise ConfigError(f"--views {n_images} is outside its range {MIN_IMAGES} to {MAX_IMAGES} for many dates.")
    rng = np.random.default_rng([seed, DATES_STREAM])
    days = np.linspace(0, DAYS, n_images)
    days[1:-1] += rng.uniform(-0.3, 0.3, n_images - 2) * DAYS / n_images
    views = tuple(_view(rng, int(day)) for day in days)
    weather = [Weather(moisture=MOISTURE)] * (DAYS + 1)
    for number, view in enumerate(views):
        is_hazy, is_cloudy = number % HAZY_EVERY == HAZY_EVERY - 1, number == CLOUDY
        weather[view.day] = Weather(
            cloud_share=CLOUD_SHARE if is_cloudy else 0.0, haze_share=HAZE_SHARE if is_hazy else 0.0, moisture=MOISTURE
        )
    return replace(
        realistic_spec(seed), size=SIZE_PX, margin_m=MARGIN_M, relief_m=RELIEF_M, objects=Objects(0.0, 0.0, 0.0, 0.0),
        cover=Cover(
            houses_per_ha=5.0, forest_share=0.12, n_lakes=0, n_terraces=0, n_fields=1, rare_objects=(),
            road_albedo=ROAD_ALBEDO,
        ),
        views=views, changes=CHANGES, weather=tuple(weather), is_dated=True, works_day=WORKS_DAY,
    )  # fmt: skip


def _view(rng: np.random.Generator, day: int) -> ViewSpec:
    """The view of a day, named after it."""
    optics = Optics(
        gain=rng.uniform(*GAIN), haze=rng.uniform(120.0, 200.0), blur_px=rng.uniform(*BLUR_PX), noise=0.0,
        noise_floor=5.0,
    )  # fmt: skip
    errors = SensorErrors(column_gain=0.004, shot=0.05, quantum=rng.uniform(8.0, 14.0), saturation=4095)
    along, across, heading = rng.uniform(-1.0, 1.0, 3) * (MAX_ALONG_DEG, MAX_ACROSS_DEG, MAX_HEADING_DEG)
    row_px, col_px = rng.uniform(-MAX_POINTING_PX, MAX_POINTING_PX, 2)
    name = f"{FIRST_DAY + datetime.timedelta(days=day):%Y%m%d}"
    return ViewSpec(
        name, float(along), float(across), float(heading), sun_of_day(day), optics, float(row_px), float(col_px), day,
        errors, MAX_WAVE_PX,
    )  # fmt: skip


def sun_of_day(day: int) -> Sun:
    """The sun at the time of the pass, so many days after the first one."""
    of_year = (FIRST_DAY + datetime.timedelta(days=day)).timetuple().tm_yday
    declination = np.deg2rad(TILT_DEG) * np.sin(2.0 * np.pi * (of_year - EQUINOX) / YEAR)
    latitude, hour = np.deg2rad([LATITUDE_DEG, HOUR_ANGLE_DEG])
    up = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    return Sun(float(np.rad2deg(np.arctan2(east, north)) % 360.0), float(np.rad2deg(np.arcsin(up))))
