"""Products of GaoFen and SuperView: NAME-PAN1.tiff and NAME-MSS1.tiff, each with an .rpb and an .xml of its name.

The XML says times of the satellite in Chinese standard time.

Source: Space View, SuperView-1 product guide (2018).
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from zlocus.core.scene import Acquisition
from zlocus.io.cameras.rpc import find_sidecar, has_rpc_tag
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, Spectrum, found_in_products
from zlocus.io.image_acquisition import acquisition_from, first_number, sun_altitude_deg, sun_direction, time_in
from zlocus.io.tiled_products import whole_number
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

    def read(name: Path) -> Found:
        image = _product(by_name[name])
        return Found() if image is None else Found((image,))

    return found_in_products(by_name, read, lambda name: by_name[name].values())


def _product(parts: Mapping[str, Path]) -> DeliveredImage | None:
    pixels = next((parts[suffix] for suffix in PIXEL_SUFFIXES if suffix in parts), None)
    if pixels is None or ".xml" not in parts:
        return None
    root = plain_xml(parts[".xml"])
    if root.tag.lower() != ROOT:
        return None
    fields = fields_of(root)
    spectrum = Spectrum.PANCHROMATIC if PANCHROMATIC.search(pixels.stem) else Spectrum.OTHER
    spectrum = Spectrum.MULTISPECTRAL if MULTISPECTRAL.search(pixels.stem) else spectrum
    camera = find_sidecar(pixels)
    is_missing = camera is None and not has_rpc_tag(pixels)
    return DeliveredImage(
        product=pixels.stem,
        pixels=pixels,
        camera=camera,
        acquisition=_acquisition(fields),
        spectrum=spectrum,
        colour_bands=BLUE_GREEN_RED if spectrum is Spectrum.MULTISPECTRAL else None,
        shape=_shape(fields, parts[".xml"]),
        claimed=frozenset(parts.values()),
        missing_camera=f"{pixels} has no RPC: {pixels.stem}.rpb is missing beside it. Add it." if is_missing else "",
    )


def _shape(fields: Mapping[str, str], path: Path) -> tuple[int, int] | None:
    if "heightinpixels" not in fields or "widthinpixels" not in fields:
        return None
    rows, cols = (whole_number(fields[f"{side}inpixels"], f"{side}InPixels", path) for side in ("height", "width"))
    return rows, cols


def _acquisition(fields: Mapping[str, str]) -> Acquisition:
    time = _time(fields)
    names = (fields.get("satelliteid", ""), fields.get("sensorid", ""))
    sun = sun_direction(first_number(fields, ("solarazimuth", "sunazimuth")), _sun_altitude_deg(fields, time))
    tilts = [first_number(fields, (name,)) for name in ("pitchsatelliteangle", "rollsatelliteangle")]
    known = [tilt for tilt in tilts if tilt is not None]
    others = {
        "cloud_percent": fields.get("cloudpercent", ""),
        "satellite_azimuth": fields.get("satelliteazimuth", ""),
        "incidence_angle": fields.get("incidenceangle", fields.get("satellitezenith", "")),
        "off_nadir": fields.get("viewangle", str(math.hypot(*known)) if known else ""),
    }
    return Acquisition(
        None if time is None else time.date(), time, "-".join(name for name in names if name) or None, sun
    ).completed_by(acquisition_from(others))


def _time(fields: Mapping[str, str]) -> datetime.datetime | None:
    """The time of the exposure, UTC. Times of the satellite are Chinese standard time; that of the reception is UTC."""
    for name, ahead in (("starttime", AHEAD), ("centertime", AHEAD), ("receivetime", datetime.timedelta(0))):
        found = time_in(fields.get(name, ""))
        if found is not None and found[1] is not None:
            return found[1] - ahead
    return None


def _sun_altitude_deg(fields: Mapping[str, str], time: datetime.datetime | None) -> float | None:
    """Altitude of the sun from `SolarZenith`, which some products call what is the altitude: where the place and the
    time are known, that meaning counts which is nearer to the sun that stood there."""
    zenith = first_number(fields, ("solarzenith", "sunzenith"))
    if zenith is None:
        return None
    lon, lat = (first_number(fields, (name,)) for name in ("centerlongitude", "centerlatitude"))
    if time is None or lon is None or lat is None:
        return 90.0 - zenith
    there = sun_altitude_deg(time, lon, lat)
    return min(90.0 - zenith, zenith, key=lambda altitude: abs(altitude - there))
