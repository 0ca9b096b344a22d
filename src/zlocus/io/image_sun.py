"""Where the sun stood when an image was taken, as its file or the vendor's file beside it says."""

from __future__ import annotations

import math

import rasterio

from zlocus.core.scene import SunDirection

# Where GDAL puts what vendors deliver beside the pixels, and the header of a NITF file, of which GeoTIFF copies keep
# the tags. In the first the names have groups in front: IMAGE_1.meanSunAz.
VENDOR_DOMAIN = "IMD"
AZIMUTH_NAMES = ("meansunaz", "sunaz", "sun_azimuth", "nitf_use00a_sun_az")
ALTITUDE_NAMES = ("meansunel", "sunel", "sun_elevation", "nitf_use00a_sun_el")


def sun_direction_at_exposure(source: rasterio.DatasetReader) -> SunDirection | None:
    """The direction to the sun as an opened image was taken; None where the file does not say, or says what cannot
    be. Where a file says it of several places of the image, the first one counts."""
    tags = source.tags(ns=VENDOR_DOMAIN) | source.tags()
    azimuth_deg = _first_number(tags, AZIMUTH_NAMES)
    altitude_deg = _first_number(tags, ALTITUDE_NAMES)
    if azimuth_deg is None or altitude_deg is None or not 0.0 < altitude_deg <= 90.0:
        return None
    return SunDirection(azimuth_deg % 360.0, altitude_deg)


def _first_number(tags: dict[str, str], names: tuple[str, ...]) -> float | None:
    """The first finite number under one of the names, whose groups and capital letters do not count."""
    for name, text in tags.items():
        if name.rpartition(".")[2].lower() in names:
            try:
                number = float(text)
            except ValueError:
                continue
            if math.isfinite(number):
                return number
    return None
