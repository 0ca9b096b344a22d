"""Products of GaoFen and SuperView: NAME-PAN1.tiff and NAME-MSS1.tiff, each with an .rpb and an .xml of its name.

The XML says times of the satellite in Chinese standard time; only `ReceiveTime` is UTC.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from zlocus.core.scene import Acquisition
from zlocus.io.cameras.rpc import find_sidecar
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, Spectrum
from zlocus.io.image_acquisition import acquisition_from, first_number, sun_direction, time_in
from zlocus.io.vendor_xml import fields_of, plain_xml

ROOT = "productmetadata"
PIXEL_SUFFIXES = (".tif", ".tiff")
PANCHROMATIC = re.compile(r"PAN\d?\Z", re.IGNORECASE)
MULTISPECTRAL = re.compile(r"(?:MSS|MUX|MUL)\d?\Z", re.IGNORECASE)
# Bands are blue, green, red and near infrared.
BLUE_GREEN_RED = (3, 2, 1)
# Chinese standard time is ahead of UTC by this.
AHEAD = datetime.timedelta(hours=8)


def gaofen_products(files: Sequence[Path]) -> Found:
    """The images of a delivery that have an XML of their own name with `ProductMetaData`."""
    by_name: dict[Path, dict[str, Path]] = {}
    for path in files:
        by_name.setdefault(path.with_suffix(""), {})[path.suffix.lower()] = path
    images = [image for parts in by_name.values() if (image := _product(parts)) is not None]
    return Found(tuple(images))


def _product(parts: Mapping[str, Path]) -> DeliveredImage | None:
    pixels = next((parts[suffix] for suffix in PIXEL_SUFFIXES if suffix in parts), None)
    if pixels is None or ".xml" not in parts:
        return None
    root = plain_xml(parts[".xml"])
    if root.tag.lower() != ROOT:
        return None
    spectrum = Spectrum.PANCHROMATIC if PANCHROMATIC.search(pixels.stem) else Spectrum.OTHER
    spectrum = Spectrum.MULTISPECTRAL if MULTISPECTRAL.search(pixels.stem) else spectrum
    return DeliveredImage(
        product=pixels.stem,
        pixels=pixels,
        camera=find_sidecar(pixels),
        acquisition=_acquisition(fields_of(root)),
        spectrum=spectrum,
        colour_bands=BLUE_GREEN_RED if spectrum is Spectrum.MULTISPECTRAL else None,
        claimed=frozenset(parts.values()),
    )


def _acquisition(fields: Mapping[str, str]) -> Acquisition:
    received, local = time_in(fields.get("receivetime", "")), None
    for name in ("centertime", "starttime"):
        local = local or time_in(fields.get(name, ""))
    time = received[1] if received is not None else None
    if time is None and local is not None and local[1] is not None:
        time = local[1] - AHEAD
    zenith = first_number(fields, ("solarzenith", "sunzenith"))
    altitude = 90.0 - zenith if zenith is not None else first_number(fields, ("sunaltitude", "solarelevation"))
    view_zenith = first_number(fields, ("satellitezenith",))
    others = {
        "cloud_percent": fields.get("cloudpercent", ""),
        "satellite_azimuth": fields.get("satelliteazimuth", ""),
        "incidence_angle": "" if view_zenith is None else str(view_zenith),
        "off_nadir": fields.get("rollviewingangle", fields.get("rollsatelliteangle", "")),
    }
    date = None if time is None else time.date()
    names = (fields.get("satelliteid", ""), fields.get("sensorid", ""))
    sun = sun_direction(first_number(fields, ("solarazimuth", "sunazimuth")), altitude)
    return Acquisition(date, time, "-".join(name for name in names if name) or None, sun).completed_by(
        acquisition_from(others)
    )
