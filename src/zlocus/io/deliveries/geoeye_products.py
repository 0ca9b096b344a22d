"""Products that GeoEye itself delivered, of GeoEye-1 and Ikonos: `po_ORDER_pan_0000000.tif` and
`po_ORDER_bgrn_0000000.tif`, each with its `_rpc.txt`, and one `po_ORDER_metadata.txt` for all of them.

The first three digits of the number are the product image, of which the metadata have a section.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from zlocus.core.scene import NOT_KNOWN, Acquisition
from zlocus.io.cameras.rpc import find_sidecar
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, Spectrum, found_in_products
from zlocus.io.image_acquisition import acquisition_from
from zlocus.io.safe_text import read_text

PRODUCT = re.compile(
    r"(?P<order>po_\w+?)_(?P<kind>pan|bgrn|rgb)_(?P<image>\d{3})(?P<part>\d{4})\.(?:tif|tiff|ntf)", re.IGNORECASE
)
# Bands of the multispectral product are blue, green, red and near infrared.
BLUE_GREEN_RED, RED_GREEN_BLUE = (3, 2, 1), (1, 2, 3)
SPECTRA = {"pan": Spectrum.PANCHROMATIC, "bgrn": Spectrum.MULTISPECTRAL, "rgb": Spectrum.OTHER}
MAX_BYTES = 10_000_000
# Lines of a section: the name that they have here, and its name among those of other vendors.
VENDOR_NAMES = {
    "sensor": "satid", "acquisition date/time": "acquired", "sun angle azimuth": "sun_azimuth",
    "sun angle elevation": "sun_elevation", "nominal collection azimuth": "satellite_azimuth",
    "nominal collection elevation": "satel", "percent cloud cover": "cloud_percent",
}  # fmt: skip


def geoeye_products(files: Sequence[Path]) -> Found:
    """The images of all such products of a delivery."""
    by_name = {path.parent / path.name.lower(): path for path in files}
    found = {path: match for path in files if (match := PRODUCT.fullmatch(path.name)) is not None}
    return found_in_products(found, lambda path: Found((_image(path, found[path], by_name),)), lambda path: [path])


def _image(path: Path, match: re.Match[str], by_name: Mapping[Path, Path]) -> DeliveredImage:
    """The image of a file. by_name : the files of the delivery, by their paths with names in small letters."""
    metadata = by_name.get(path.parent / f"{match['order'].lower()}_metadata.txt")
    kind, camera = match["kind"].lower(), find_sidecar(path)
    return DeliveredImage(
        product=path.stem,
        pixels=path,
        camera=camera,
        acquisition=NOT_KNOWN if metadata is None else _acquisition(metadata, match["image"]),
        spectrum=SPECTRA[kind],
        colour_bands=BLUE_GREEN_RED if kind == "bgrn" else RED_GREEN_BLUE if kind == "rgb" else None,
        claimed=frozenset(each for each in (camera, metadata) if each is not None),
    )


def _acquisition(path: Path, image: str) -> Acquisition:
    """What the metadata say of a product image, by its three digits; of a single one, whatever its number is."""
    _, _, sources = read_text(path, MAX_BYTES).partition("Source Image Metadata")
    sections = re.split(r"(?m)^Source Image ID:", sources)[1:]
    of_image = [section for section in sections if re.search(rf"(?m)^Product Image ID: *{image}\b", section)]
    chosen = of_image or (sections if len(sections) == 1 else [])
    if not chosen:
        return NOT_KNOWN
    fields: dict[str, str] = {}
    for line in chosen[0].splitlines():
        name, _, value = line.partition(":")
        vendor = VENDOR_NAMES.get(name.strip().lower())
        if vendor is not None:
            # A unit may follow a number.
            fields.setdefault(vendor, value.removesuffix("degrees").strip())
    return acquisition_from(fields)
