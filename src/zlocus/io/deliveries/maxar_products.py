"""Products of Maxar (DigitalGlobe, GeoEye): WorldView, GeoEye, QuickBird.

A product has a name such as `14OCT05160138-P1BS-500648062040_01_P001`. Its pixels are NAME.TIF or NAME.NTF, or tiles
that NAME.TIL lists; NAME.IMD (text) or NAME.XML (image support data) says what they are, and NAME.RPB or NAME.XML holds
the RPC. Products that GeoEye itself delivered have NAME_rpc.txt instead, see `geoeye_products`.

Source: DigitalGlobe, Imagery Support Data Documentation (2014).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from zlocus.core.errors import InputError
from zlocus.core.scene import NOT_KNOWN
from zlocus.io.cameras.isd import is_isd
from zlocus.io.cameras.rpc import find_sidecar
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, Spectrum, found_in_products
from zlocus.io.grouped_text import StatementGroup, read_groups
from zlocus.io.image_acquisition import acquisition_from
from zlocus.io.tiled_products import TIL_SUFFIX, named_tiles, whole_number
from zlocus.io.vendor_xml import fields_of, plain_xml

PIXEL_SUFFIXES = (".tif", ".tiff", ".ntf")
# Letters of the bands, as the groups BAND_R and BAND_N1 of a product name them, in the order of its bands.
RED_GREEN_BLUE = ("R", "G", "B")
TILE_PLACE = re.compile(r"_R\d+C\d+", re.ASCII)
PAN_LEVEL = re.compile(r"-P\d[A-Z]{2}", re.ASCII)


@dataclass(frozen=True)
class Description:
    """What NAME.IMD or NAME.XML says of a product.

    fields : texts by names in small letters; shape : rows and columns; bands : letters, in their order.
    """

    fields: Mapping[str, str]
    shape: tuple[int, int] | None
    bands: tuple[str, ...]


def maxar_products(files: Sequence[Path]) -> Found:
    """The images of all products of a delivery that have an .IMD, a .TIL, or an .XML of image support data."""
    by_name: dict[Path, dict[str, Path]] = {}
    for path in files:
        by_name.setdefault(path.with_suffix(""), {})[path.suffix.lower()] = path

    def read(stem: Path) -> Found:
        image = _product(stem, by_name[stem])
        return Found() if image is None else Found((image,))

    return found_in_products(by_name, read, lambda stem: [path for path in files if _is_of_product(path, stem)])


def _is_of_product(path: Path, stem: Path) -> bool:
    """Whether a file lies beside a product and has its name, or the name of one of its tiles."""
    return path.parent == stem.parent and TILE_PLACE.sub("", path.stem) == stem.name


def maxar_input(path: Path, files: Sequence[Path]) -> Found:
    """The image of one .TIL that is given as an input itself. files : those beside it."""
    image = _product(path.with_suffix(""), {each.suffix.lower(): each for each in files if each.stem == path.stem})
    assert image is not None, "a .TIL is a product"
    return Found((image,))


def _product(stem: Path, parts: Mapping[str, Path]) -> DeliveredImage | None:
    """The image of a product. parts : its files by their suffixes."""
    index, imd, xml = parts.get(TIL_SUFFIX), parts.get(".imd"), parts.get(".xml")
    root = None if xml is None else plain_xml(xml)
    if root is not None and not is_isd(root):
        root = None
    if index is None and imd is None and root is None:
        return None
    said = None if imd is None else from_imd(imd)
    if said is None and root is not None and xml is not None:
        said = from_isd(root, xml)
    tiles = [] if index is None else named_tiles(index)
    single = next((parts[suffix] for suffix in PIXEL_SUFFIXES if suffix in parts), None)
    if index is not None:
        pixels = tiles[0] if len(tiles) == 1 else index
    elif single is not None:
        pixels = single
    else:
        described = imd or xml
        raise InputError(
            f"{described} describes an image, but there is no {stem.name}.TIL, .TIF or .NTF beside it. Copy the whole "
            "product again."
        )
    camera, missing_camera = find_sidecar(stem.with_suffix(".TIL")), ""
    if camera is None and len(tiles) > 1:
        # Products without .IMD have the RPC in their XML of image support data.
        name = f"{stem.name}.{'RPB' if imd is not None else 'XML'}"
        missing_camera = f"{index} lists the tiles of an image, but there is no {name} with its RPC beside it. Add it."
    return DeliveredImage(
        product=stem.name,
        pixels=pixels,
        camera=camera,
        acquisition=NOT_KNOWN if said is None else acquisition_from(said.fields),
        spectrum=_spectrum(stem.name, said),
        colour_bands=None if said is None else _colour_bands(said.bands),
        shape=None if said is None else said.shape,
        claimed=frozenset((*parts.values(), *tiles)),
        missing_camera=missing_camera,
    )


def from_imd(path: Path) -> Description:
    """What a NAME.IMD says.

    Raises
    ------
    InputError
        The file is damaged, or its values contradict each other.
    """
    root = read_groups(path)
    fields: dict[str, str] = {}
    for group in root.all_groups():
        for name, text in group.values.items():
            fields.setdefault(name, text)
    return Description(fields, _shape(fields, path), _band_letters(root))


def _band_letters(group: StatementGroup) -> tuple[str, ...]:
    return tuple(each.name.rpartition("_")[2].upper() for each in group.within("BAND_"))


def from_isd(root: Element, path: Path) -> Description | None:
    """What the part IMD of image support data says; None where there is no such part. root : of the file at `path`."""
    part = root.find("IMD")
    if part is None:
        return None
    letters = tuple(each.tag.upper().removeprefix("BAND_") for each in part if each.tag.upper().startswith("BAND_"))
    fields = fields_of(part)
    return Description(fields, _shape(fields, path), letters)


def _shape(fields: Mapping[str, str], path: Path) -> tuple[int, int] | None:
    if "numrows" not in fields or "numcolumns" not in fields:
        return None
    return whole_number(fields["numrows"], "numRows", path), whole_number(fields["numcolumns"], "numColumns", path)


def _spectrum(name: str, description: Description | None) -> Spectrum:
    letters = () if description is None else description.bands
    identity = "" if description is None else description.fields.get("bandid", "")
    if letters == ("P",) or identity.upper() == "P" or (description is None and PAN_LEVEL.search(name)):
        return Spectrum.PANCHROMATIC
    sharpening = "none" if description is None else description.fields.get("pansharpenalgorithm", "none")
    return Spectrum.OTHER if sharpening.lower() != "none" or len(letters) < 3 else Spectrum.MULTISPECTRAL


def _colour_bands(letters: Sequence[str]) -> tuple[int, int, int] | None:
    if not all(letter in letters for letter in RED_GREEN_BLUE):
        return None
    red, green, blue = (letters.index(letter) + 1 for letter in RED_GREEN_BLUE)
    return red, green, blue
