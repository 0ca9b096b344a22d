"""SkySat scenes of Planet: `ID_basic_panchromatic_dn.tif`, `ID_basic_analytic_dn.tif`, each with its `_RPC.TXT` (or the
RPC in its tags) and `_udm2.tif`, and `ID_metadata.json` with the acquisition of both.

Source: Planet, SkySat product specification (2023).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from zlocus.core.scene import NOT_KNOWN, Acquisition
from zlocus.io.cameras.rpc import find_sidecar
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, SetAside, Spectrum, found_in_products
from zlocus.io.image_acquisition import acquisition_from
from zlocus.io.safe_documents import read_json

PRODUCT = re.compile(
    r"(?P<id>.+)_(?P<level>basic|ortho)_(?P<kind>(?:l1a_)?panchromatic|analytic|visual|pansharpened)(?P<rest>_.*|)\.tif",
    re.IGNORECASE,
)
MASK = re.compile(r".*_udm2?", re.IGNORECASE)
# Bands of the multispectral product are blue, green, red and near infrared.
BLUE_GREEN_RED = (3, 2, 1)
SPECTRA = {
    "panchromatic": Spectrum.PANCHROMATIC, "l1a_panchromatic": Spectrum.PANCHROMATIC,
    "analytic": Spectrum.MULTISPECTRAL, "pansharpened": Spectrum.OTHER, "visual": Spectrum.OTHER,
}  # fmt: skip


def planet_products(files: Sequence[Path]) -> Found:
    """The images of all SkySat scenes of a delivery."""
    found = {path: match for path in files if (match := PRODUCT.fullmatch(path.name)) is not None}
    beside = set(files)
    masks = [path for path, match in found.items() if MASK.fullmatch(match["rest"])]

    def read(path: Path) -> Found:
        match = found[path]
        kind = match["kind"].lower()
        if match["level"].lower() == "ortho":
            return _left_out(path, "is an ortho-image, whose pixels have no camera: order the basic product")
        if kind == "l1a_panchromatic" and any(_is_final(other, match["id"]) for other in found.values()):
            return _left_out(path, "is an earlier level of the panchromatic image beside it")
        return Found((_image(path, match, beside),))

    products = found_in_products([path for path in found if path not in masks], read, lambda path: [path])
    products = replace(products, images=tuple(_with_missing_masks(products.images)))
    lone = [path for path in masks if path not in products.claimed and find_sidecar(path) is None]
    reason = "is the mask of an image that is missing, or has another name"
    return products.with_more(Found(set_aside=tuple(SetAside(path, reason, is_doubtful=True) for path in lone)))


def _left_out(path: Path, reason: str) -> Found:
    return Found(set_aside=(SetAside(path, reason),))


def _with_missing_masks(images: Sequence[DeliveredImage]) -> list[DeliveredImage]:
    """The images, of which those without a mask miss one where another image of their kind has it: nothing names the
    masks of a scene."""
    masked = {image.spectrum for image in images if image.masks}
    return [
        image
        if image.masks or image.spectrum not in masked
        else replace(image, missing_masks=(image.pixels.with_name(_mask_name(image.pixels)),))
        for image in images
    ]


def _mask_name(pixels: Path) -> str:
    """The usual name of the mask of an image: the number (dn) of the image is not in it."""
    return f"{re.sub('_dn$', '', pixels.stem, flags=re.IGNORECASE)}_udm2.tif"


def _is_final(other: re.Match[str], scene: str) -> bool:
    return other["id"] == scene and other["kind"].lower() == "panchromatic" and not MASK.fullmatch(other["rest"])


def _image(path: Path, match: re.Match[str], beside: set[Path]) -> DeliveredImage:
    kind, scene = match["kind"].lower(), match["id"]
    # The number of the image (dn) may stand before or after the name of the mask.
    stem = f"{scene}_{match['level']}_{match['kind']}"
    names = (f"{stem}_udm2.tif", f"{stem}{match['rest']}_udm2.tif", f"{stem}_udm.tif", f"{stem}{match['rest']}_udm.tif")
    masks = [path.with_name(name) for name in names if path.with_name(name) in beside][:1]
    metadata = [path.with_name(f"{scene}{end}") for end in ("_metadata.json", ".json")]
    metadata = [each for each in metadata if each in beside][:1]
    spectrum = SPECTRA[kind]
    return DeliveredImage(
        product=f"{scene}_{kind}",
        pixels=path,
        camera=find_sidecar(path),
        acquisition=_acquisition(metadata[0]) if metadata else NOT_KNOWN,
        spectrum=spectrum,
        colour_bands=BLUE_GREEN_RED if spectrum is Spectrum.MULTISPECTRAL else None,
        masks=tuple(masks),
        claimed=frozenset(each for name in names if (each := path.with_name(name)) in beside) | frozenset(metadata),
    )


def _acquisition(path: Path) -> Acquisition:
    document = read_json(path)
    said = document.get("properties", document) if isinstance(document, Mapping) else {}
    fields = said if isinstance(said, Mapping) else {}
    return acquisition_from({str(name).lower(): str(value) for name, value in fields.items() if value is not None})
