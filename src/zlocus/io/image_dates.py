"""When an image was taken, as its file or the vendor's file beside it says."""

from __future__ import annotations

import datetime
import re

import rasterio

# Where GDAL puts the time of the exposure: the metadata that vendors deliver beside the pixels (domain and name), the
# header of a NITF file, of which GeoTIFF copies keep the tags, and the header of a photograph. The time of a TIFF file
# (TIFFTAG_DATETIME) is that of its writing, and says nothing of the exposure.
PLACES = (("IMAGERY", "ACQUISITIONDATETIME"), (None, "NITF_IDATIM"), (None, "EXIF_DateTimeOriginal"))
# Year, month and day, with or without a separator: 2014-10-05 16:01:38, 20141005160138, 2014:10:05 16:01:38.
DAY = re.compile(r"\s*(\d{4})[-:/]?(\d{2})[-:/]?(\d{2})")
# Digital images are not older, and what a file says of a later day than tomorrow is a mistake.
FIRST_YEAR = 1920


def date_of_exposure(source: rasterio.DatasetReader) -> datetime.date | None:
    """The day on which an opened image was taken; None where the file does not say, or says what cannot be."""
    for domain, name in PLACES:
        found = DAY.match(source.tags(ns=domain).get(name, "") if domain else source.tags().get(name, ""))
        day = None if found is None else _day(*(int(part) for part in found.groups()))
        if day is not None:
            return day
    return None


def _day(year: int, month: int, day: int) -> datetime.date | None:
    """The day of these numbers; None where there is none, or none on which an image can have been taken."""
    try:
        found = datetime.date(year, month, day)
    except ValueError:
        return None
    is_possible = year >= FIRST_YEAR and found <= datetime.date.today() + datetime.timedelta(days=1)
    return found if is_possible else None
