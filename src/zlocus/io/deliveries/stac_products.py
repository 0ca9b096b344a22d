"""Items and local catalogues of STAC: JSON files that name images as assets, and say when and how they were taken.

Assets lie in or below the folder of the file that was given; what lies on a server is not fetched.

Source: SpatioTemporal Asset Catalog specification 1.0 and 1.1, with the extensions view, eo and projection.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.scene import Acquisition
from zlocus.io.archives import is_archived
from zlocus.io.cameras.rpc import find_sidecar
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, Spectrum, found_in_products
from zlocus.io.image_acquisition import acquisition_from, sun_direction, time_in
from zlocus.io.safe_documents import read_json
from zlocus.io.stored_files import file_exists

STAC_SUFFIXES = (".json", ".geojson")
MAX_ITEMS, MAX_DEPTH = 10_000, 8
PIXEL_MEDIA = ("image/tiff", "image/jp2", "application/x-nitf", "image/nitf", "image/vnd.stac.geotiff")
PIXEL_SUFFIXES = (".tif", ".tiff", ".ntf", ".jp2", ".vrt")
# Roles of assets that are no image to match.
OTHER_ROLES = frozenset(
    ("thumbnail", "overview", "metadata", "visual", "cloud", "cloud-shadow", "data-mask", "snow-ice")
)
MASK_ROLES = frozenset(("cloud", "data-mask"))
PAN_NAMES, COLOUR_NAMES = ("pan", "panchromatic"), ("red", "green", "blue")
ADVICE = "Copy the catalogue again from its source, with its images."


def stac_products(files: Sequence[Path]) -> Found:
    """The images of all STAC items among the files of a delivery. Catalogues among them are asked for what is
    missing."""
    root = _common_folder(files)

    def read(path: Path) -> Found:
        document = _document(path)
        if document is None:
            return Found()
        if document.get("type") == "Feature":
            return Found(tuple(_images(path, document, root)))
        for href in _links(document):
            # Published catalogues name their items by addresses; those beside them are found all the same.
            if "://" not in str(href):
                _named(path, href, root)
        return Found()

    documents = [path for path in files if path.suffix.lower() in STAC_SUFFIXES]
    return found_in_products(documents, read, lambda path: [path])


def stac_input(path: Path) -> Found:
    """The images of an item, or of all items that a catalogue or collection leads to.

    Raises
    ------
    InputError
        The file is no STAC, names a file outside its folder or on a server, or leads back to itself.
    """
    images, todo, known = list[DeliveredImage](), [(path, 0)], set[Path]()
    while todo:
        at, depth = todo.pop()
        if at in known:
            continue
        known.add(at)
        document = _document(at)
        if document is None:
            raise InputError(f"{at} is no item or catalogue of STAC: it does not say its stac_version. Check the path.")
        if document.get("type") == "Feature":
            images += _images(at, document, path.parent)
            continue
        if depth == MAX_DEPTH or len(known) > MAX_ITEMS:
            raise InputError(f"{path} leads to more catalogues than are followed. Give the item itself.")
        todo += [(_named(at, href, path.parent), depth + 1) for href in _links(document)]
    return Found(tuple(sorted(images, key=lambda image: image.product)))


def _links(document: Mapping[str, Any]) -> list[object]:
    """What a catalogue or collection leads to."""
    links = document.get("links", [])
    known = [link for link in links if isinstance(link, Mapping)] if isinstance(links, list) else []
    return [link.get("href") for link in known if link.get("rel") in ("item", "child")]


def _document(path: Path) -> dict[str, Any] | None:
    """The content of a file of STAC; None where it is another JSON."""
    document = read_json(path)
    return document if isinstance(document, dict) and "stac_version" in document else None


def _images(path: Path, item: Mapping[str, Any], root: Path) -> list[DeliveredImage]:
    """The images of an item. root : folder that no asset leaves."""
    assets = item.get("assets")
    if not isinstance(assets, Mapping):
        raise InputError(f"{path} is a STAC item without assets. {ADVICE}")
    properties = item.get("properties")
    acquisition = _acquisition(properties if isinstance(properties, Mapping) else {})
    known = {key: asset for key, asset in assets.items() if isinstance(asset, Mapping)}
    masks = [_named(path, asset.get("href"), root) for asset in known.values() if _roles(asset) & MASK_ROLES]
    images = []
    for key, asset in known.items():
        if not _is_pixels(asset):
            continue
        pixels = _named(path, asset.get("href"), root)
        names = _band_names(asset)
        colours = None
        if all(name in names for name in COLOUR_NAMES):
            red, green, blue = (names.index(name) + 1 for name in COLOUR_NAMES)
            colours = (red, green, blue)
        is_pan = len(names) == 1 and names[0] in PAN_NAMES
        spectrum = Spectrum.PANCHROMATIC if is_pan else Spectrum.MULTISPECTRAL if colours else Spectrum.OTHER
        camera = find_sidecar(pixels)
        images.append(
            DeliveredImage(
                product=f"{item.get('id', path.stem)}_{key}",
                pixels=pixels,
                camera=camera,
                acquisition=acquisition,
                spectrum=spectrum,
                colour_bands=colours,
                masks=tuple(mask for mask in masks if file_exists(mask)),
                claimed=frozenset((path,)),
            )
        )
    return images


def _acquisition(properties: Mapping[str, Any]) -> Acquisition:
    said = {str(name): str(value) for name, value in properties.items() if isinstance(value, str | int | float)}

    def number(name: str) -> float | None:
        try:
            return float(said[name])
        except (KeyError, ValueError):
            return None

    date, time = time_in(said.get("datetime", said.get("start_datetime", ""))) or (None, None)
    sun = sun_direction(number("view:sun_azimuth"), number("view:sun_elevation"))
    others = acquisition_from(
        {
            "cloud_percent": said.get("eo:cloud_cover", ""),
            "satellite_azimuth": said.get("view:azimuth", ""),
            "incidence_angle": said.get("view:incidence_angle", ""),
            "off_nadir": said.get("view:off_nadir", ""),
        }
    )
    return Acquisition(date, time, said.get("platform"), sun).completed_by(others)


def _roles(asset: Mapping[str, Any]) -> set[str]:
    roles = asset.get("roles", [])
    return {str(role) for role in roles} if isinstance(roles, list) else set()


def _is_pixels(asset: Mapping[str, Any]) -> bool:
    if _roles(asset) & OTHER_ROLES:
        return False
    kind, name = str(asset.get("type", "")).lower(), str(asset.get("href", "")).lower()
    return kind.startswith(PIXEL_MEDIA) if kind else name.endswith(PIXEL_SUFFIXES)


def _band_names(asset: Mapping[str, Any]) -> list[str]:
    """Common names of the bands, in their order."""
    bands = asset.get("bands", asset.get("eo:bands", []))
    listed = [band for band in bands if isinstance(band, Mapping)] if isinstance(bands, list) else []
    return [str(band.get("eo:common_name", band.get("common_name", ""))) for band in listed]


def _named(path: Path, href: object, root: Path) -> Path:
    """The file that a reference names. path : of the file that holds it; root : folder that it may not leave."""
    text = str(href or "")
    if not text or "\\" in text or ":" in text or any(ord(sign) < 32 for sign in text):
        where = "lies on a server, and is not fetched" if "://" in text else "is no path"
        raise InputError(f"{path} names {quoted(text)}, which {where}. {ADVICE}")
    found = root
    for part in (*_relative_folder(path, root).parts, *PurePosixPath(text).parts):
        found = found.parent if part == ".." and found != root else found / part
    leaves = PurePosixPath(text).is_absolute() or ".." in found.relative_to(root).parts
    if leaves or (not is_archived(found) and not found.resolve().is_relative_to(root.resolve())):
        raise InputError(f"{path} names {quoted(text)}, which does not lie below {root}. {ADVICE}")
    if not file_exists(found):
        raise InputError(f"{path} names {quoted(text)}, which is missing. {ADVICE}")
    return found


def _relative_folder(path: Path, root: Path) -> Path:
    return path.parent.relative_to(root)


def _common_folder(files: Sequence[Path]) -> Path:
    """The folder that holds all files."""
    first = files[0].parent if files else Path()
    return next(each for each in (first, *first.parents) if all(path.is_relative_to(each) for path in files))
