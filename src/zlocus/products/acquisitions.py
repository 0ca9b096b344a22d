"""When and how the images were taken, as records of run.json and as the table that the doctor and the report show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from zlocus.core.scene import NOT_KNOWN, Acquisition, View

COLUMNS = ("image", "taken (UTC)", "satellite", "sun", "seen from", "cloud")
UNKNOWN = "-"


def acquisition_records(views: Sequence[View]) -> dict[str, dict[str, Any]]:
    """What is known of the exposure of each view, by its name; views of which nothing is known are left out."""
    return {view.name: acquisition_record(view.acquisition) for view in views if view.acquisition != NOT_KNOWN}


def acquisition_record(acquisition: Acquisition) -> dict[str, Any]:
    """An acquisition as values that JSON can hold. Angles are in degrees, the cloud cover is a share of the image."""
    sun = acquisition.sun_direction
    return {
        "date": None if acquisition.date is None else acquisition.date.isoformat(),
        "time": None if acquisition.time is None else acquisition.time.isoformat(),
        "satellite": acquisition.satellite,
        "sun_azimuth_deg": None if sun is None else sun.azimuth_deg,
        "sun_altitude_deg": None if sun is None else sun.altitude_deg,
        "view_azimuth_deg": acquisition.view_azimuth_deg,
        "incidence_deg": acquisition.incidence_deg,
        "off_nadir_deg": acquisition.off_nadir_deg,
        "cloud_cover": acquisition.cloud_cover,
    }


def acquisition_rows(records: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """The rows of the table below `COLUMNS`, in order of the views. records : see `acquisition_records`."""
    return [(name, *_cells(record)) for name, record in records.items()]


def _cells(record: Mapping[str, Any]) -> tuple[str, ...]:
    time, cloud = record["time"], record["cloud_cover"]
    taken = record["date"] or UNKNOWN if time is None else f"{time[:10]} {time[11:19]}"
    return (
        taken,
        record["satellite"] or UNKNOWN,
        _direction(record["sun_azimuth_deg"], record["sun_altitude_deg"], "up"),
        _view(record),
        UNKNOWN if cloud is None else f"{100 * cloud:.0f} %",
    )


def _direction(azimuth_deg: float | None, angle_deg: float | None, word: str) -> str:
    """An azimuth and an angle, as far as they are known."""
    parts = [] if azimuth_deg is None else [f"azimuth {azimuth_deg:.0f}°"]
    parts += [] if angle_deg is None else [f"{angle_deg:.0f}° {word}"]
    return ", ".join(parts) or UNKNOWN


def _view(record: Mapping[str, Any]) -> str:
    """Where the sensor stood, seen from the ground where the angle there is known, else the angle at the sensor."""
    if record["incidence_deg"] is None and record["off_nadir_deg"] is not None:
        return _direction(record["view_azimuth_deg"], record["off_nadir_deg"], "off nadir")
    return _direction(record["view_azimuth_deg"], record["incidence_deg"], "off the vertical")
