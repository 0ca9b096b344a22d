"""When and how rendered images were taken, and tags of images that say so."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import rasterio

from zlocus.core.scene import Acquisition, SunDirection
from zlocus.synthetic.scenes import Exposure, SceneSpec

FIRST_DAY = datetime.date(2014, 8, 5)
# Time (UTC) of the first image of a pass, and seconds between its images.
PASS_TIME, SECONDS_APART = datetime.time(10, 30, 12, tzinfo=datetime.UTC), 40
SATELLITE = "WV03"


def acquisition_of(spec: SceneSpec, exposure: Exposure, index: int) -> Acquisition:
    """When, from where and in what light an exposure was taken. index : of the exposure among those of the scene."""
    view = exposure.view
    day = FIRST_DAY + datetime.timedelta(days=view.day)
    time = datetime.datetime.combine(day, PASS_TIME) + datetime.timedelta(seconds=SECONDS_APART * index)
    middle = (np.array([exposure.shape[::-1]]) - 1.0) / 2.0
    low, high = spec.height_range
    (x0, y0, _), (x1, y1, _) = exposure.sensor.ground_from_image(np.repeat(middle, 2, axis=0), np.array([low, high]))
    east, north = (x1 - x0) / (high - low), (y1 - y0) / (high - low)
    return Acquisition(
        day, time, SATELLITE, SunDirection(view.sun.azimuth_deg, view.sun.elevation_deg),
        view_azimuth_deg=float(np.rad2deg(np.arctan2(east, north)) % 360.0),
        incidence_deg=float(np.rad2deg(np.arctan(np.hypot(east, north)))),
    )  # fmt: skip


def write_tags(path: Path, acquisition: Acquisition) -> None:
    """Write into the tags of an image when and how it was taken, under names that `zlocus` reads."""
    said = described(acquisition)
    with rasterio.open(path, "r+") as image:
        image.update_tags(
            satid=said["satId"], acquired=said["firstLineTime"], sun_azimuth=said["meanSunAz"],
            sun_elevation=said["meanSunEl"], satellite_azimuth=said["meanSatAz"], satel=said["meanSatEl"],
        )  # fmt: skip


def described(acquisition: Acquisition) -> dict[str, str]:
    """The texts by which Maxar says when and how an image was taken, by the names of its `.IMD` files."""
    time, sun, azimuth = acquisition.time, acquisition.sun_direction, acquisition.view_azimuth_deg
    incidence = acquisition.incidence_deg
    if time is None or sun is None or azimuth is None or incidence is None:
        raise ValueError("All of it is known of a rendered image.")
    return {
        "satId": acquisition.satellite or SATELLITE, "firstLineTime": f"{time:%Y-%m-%dT%H:%M:%S}.000000Z",
        "meanSunAz": f"{sun.azimuth_deg:.1f}", "meanSunEl": f"{sun.altitude_deg:.1f}", "meanSatAz": f"{azimuth:.1f}",
        "meanSatEl": f"{90.0 - incidence:.1f}",
    }  # fmt: skip
