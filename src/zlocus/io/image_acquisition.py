"""When and how an image was taken, as its file or the vendor's file beside it says.

GDAL puts what vendors deliver beside the pixels into the domain IMD, with groups in front of the names
(IMAGE_1.meanSunAz), and the header of a NITF file, of which GeoTIFF copies keep the tags, into the default domain.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Mapping, Sequence

import rasterio

from zlocus.core.scene import Acquisition, SunDirection

# Where GDAL puts the time of the exposure: the metadata that vendors deliver beside the pixels (domain and name), the
# header of a NITF file. The time of a TIFF file (TIFFTAG_DATETIME) is that of its writing, and says nothing of the
# exposure.
PLACES = (("IMAGERY", "ACQUISITIONDATETIME"), (None, "NITF_IDATIM"))
# The header of a photograph, whose clock is that of its place: it only gives the day.
LOCAL_TIMES = ("exif_datetimeoriginal",)
VENDOR_DOMAIN = "IMD"
# Names of the same quantity, in small letters and without groups, the more precise ones first.
SUN_AZIMUTH = ("meansunaz", "sunaz", "sun_azimuth", "nitf_use00a_sun_az")
SUN_ALTITUDE = ("meansunel", "sunel", "sun_elevation", "nitf_use00a_sun_el")
VIEW_AZIMUTH = ("meansataz", "sataz", "satellite_azimuth")
VIEW_ALTITUDE = ("meansatel", "satel")
INCIDENCE = ("incidence_angle",)
OFF_NADIR = (
    "meanoffnadirviewangle", "offnadirviewangle", "viewing_angle", "view_angle", "off_nadir", "nitf_use00a_obl_ang",
)  # fmt: skip
CLOUD_SHARE = ("cloudcover", "cloud_cover")
CLOUD_PERCENT = ("cloud_coverage", "cloudpercent", "cloud_percent", "nitf_piaimc_cloudcvr")
SATELLITE = ("satid", "satellite_id")
TIMES = ("firstlinetime", "acquired", "nitf_idatim")
# Year, month and day, and hour, minute and perhaps second, with or without separators: 2014-10-05T16:01:38.25Z,
# 20141005160138, 2014:10:05 16:01.
TIME = re.compile(
    r"\s*(\d{4})[-:/]?(\d{2})[-:/]?(\d{2})(?:[T ]?(\d{2}):?(\d{2})(?::?(\d{2})(\.\d+)?)?(?!\d))?", re.ASCII
)
# Digital images are not older, and what a file says of a later day than tomorrow is a mistake.
FIRST_YEAR = 1920


def acquisition_of(source: rasterio.DatasetReader) -> Acquisition:
    """What an opened image says of its exposure. What cannot be counts as not known."""
    fields = dict[str, str]()
    for name, text in (source.tags(ns=VENDOR_DOMAIN) | source.tags()).items():
        # Where a file says it of several places of the image, the first one counts.
        fields.setdefault(name.rpartition(".")[2].lower(), text)
    date, time = next(
        (found for domain, name in PLACES if (found := time_in(source.tags(ns=domain).get(name, "")))), (None, None)
    )
    return Acquisition(date, time).completed_by(acquisition_from(fields))


def acquisition_from(fields: Mapping[str, str]) -> Acquisition:
    """What fields of a vendor say of the exposure. fields : by their names in small letters, without groups."""
    sun_azimuth, sun_altitude = first_number(fields, SUN_AZIMUTH), first_number(fields, SUN_ALTITUDE)
    view_altitude, incidence = first_number(fields, VIEW_ALTITUDE), first_number(fields, INCIDENCE)
    if incidence is None and view_altitude is not None:
        incidence = 90.0 - view_altitude
    date, time = next((found for name in TIMES if (found := time_in(fields.get(name, "")))), (None, None))
    if date is None:
        date = next((found[0] for name in LOCAL_TIMES if (found := time_in(fields.get(name, "")))), None)
    share, percent = first_number(fields, CLOUD_SHARE), first_number(fields, CLOUD_PERCENT)
    if share is None and percent is not None:
        share = percent / 100.0
    return Acquisition(
        date=date,
        time=time,
        satellite=next((text for name in SATELLITE if (text := fields.get(name, "").strip(' "'))), None),
        sun_direction=sun_direction(sun_azimuth, sun_altitude),
        view_azimuth_deg=_azimuth(first_number(fields, VIEW_AZIMUTH)),
        incidence_deg=_angle(incidence),
        off_nadir_deg=_angle(first_number(fields, OFF_NADIR)),
        cloud_cover=_share(share),
    )


def sun_direction(azimuth_deg: float | None, altitude_deg: float | None) -> SunDirection | None:
    """The direction to the sun; None where an angle is not known, or the sun is not above the horizon."""
    if azimuth_deg is None or altitude_deg is None or not 0.0 < altitude_deg <= 90.0:
        return None
    return SunDirection(azimuth_deg % 360.0, altitude_deg)


def sun_altitude_deg(time: datetime.datetime, lon: float, lat: float) -> float:
    """Altitude of the sun above the horizon at a place (degrees), to about half a degree, without refraction.

    Source: Astronomical Almanac, low-precision formulas for the Sun.
    """
    days = (time - datetime.datetime(2000, 1, 1, 12, tzinfo=datetime.UTC)).total_seconds() / 86_400
    anomaly = math.radians(357.528 + 0.985_600_3 * days)
    ecliptic = math.radians(280.460 + 0.985_647_4 * days + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    tilt = math.radians(23.439)
    ascension = math.atan2(math.cos(tilt) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(tilt) * math.sin(ecliptic))
    sidereal = math.radians(280.460_618 + 360.985_647_366 * days + lon)
    latitude = math.radians(lat)
    sine = math.sin(latitude) * math.sin(declination)
    sine += math.cos(latitude) * math.cos(declination) * math.cos(sidereal - ascension)
    return math.degrees(math.asin(sine))


def time_in(text: str) -> tuple[datetime.date, datetime.datetime | None] | None:
    """Day and time (UTC) at the begin of a text, the time None where it only has a day; None where it holds no day on
    which an image can have been taken."""
    found = TIME.match(text)
    if found is None:
        return None
    try:
        day = datetime.date(*(int(part) for part in found.groups()[:3]))
        is_possible = day.year >= FIRST_YEAR and day <= datetime.date.today() + datetime.timedelta(days=1)
        if not is_possible:
            return None
        if found[4] is None:
            return day, None
        hour, minute, second = (int(part or 0) for part in found.groups()[3:6])
        clock = datetime.time(hour, minute, second, tzinfo=datetime.UTC)
    except ValueError:
        return None
    time = datetime.datetime.combine(day, clock) + datetime.timedelta(seconds=float(found[7] or 0.0))
    return time.date(), time


def first_number(fields: Mapping[str, str], names: Sequence[str]) -> float | None:
    """The first finite number under one of the names."""
    for name in names:
        try:
            number = float(fields.get(name, ""))
        except ValueError:
            continue
        if math.isfinite(number):
            return number
    return None


def _azimuth(azimuth_deg: float | None) -> float | None:
    return None if azimuth_deg is None or abs(azimuth_deg) > 360.0 else azimuth_deg % 360.0


def _angle(angle_deg: float | None) -> float | None:
    """An angle from the vertical; its sign only says to which side."""
    return None if angle_deg is None or abs(angle_deg) >= 90.0 else abs(angle_deg)


def _share(share: float | None) -> float | None:
    return share if share is not None and 0.0 <= share <= 1.0 else None
