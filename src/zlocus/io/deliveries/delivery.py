"""A folder, an archive, an index of tiles or a file of STAC as an input: the views that it holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.scene import Acquisition
from zlocus.io.archives import is_archive, is_archived, is_folder_in_archive, path_in_archive
from zlocus.io.deliveries.acquisition_table import dated_images, find_table
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, Reader, SetAside
from zlocus.io.deliveries.dimap_products import dimap_input, dimap_products
from zlocus.io.deliveries.gaofen_products import gaofen_products
from zlocus.io.deliveries.geoeye_products import geoeye_products
from zlocus.io.deliveries.ground_agreement import contradictions
from zlocus.io.deliveries.listing import files_in
from zlocus.io.deliveries.maxar_products import maxar_input, maxar_products
from zlocus.io.deliveries.pairing import ColourPartner, colour_partner
from zlocus.io.deliveries.plain_images import plain_images
from zlocus.io.deliveries.planet_products import planet_products
from zlocus.io.deliveries.stac_products import stac_input, stac_products
from zlocus.io.open_raster import open_raster
from zlocus.io.stored_files import names_beside
from zlocus.io.tiled_products import TIL_SUFFIX, is_tile_index

# Readers of vendors, in the order in which they are asked. Files that one of them claims are not shown to the next.
READERS: tuple[Reader, ...] = (
    stac_products, dimap_products, maxar_products, geoeye_products, planet_products, gaofen_products, plain_images,
)  # fmt: skip
STAC_SUFFIXES = (".json", ".geojson")
# Files that a note names at most for one reason.
MAX_NAMED = 3


@dataclass(frozen=True)
class DeliveredView:
    """A view of a delivery. name : of its acquisition; partner : the image that gives its colours, None for its
    own."""

    name: str
    image: DeliveredImage
    partner: ColourPartner | None = None


@dataclass(frozen=True)
class Delivery:
    """What an input holds. views : to be matched; set_aside : images that are not, and why."""

    path: Path
    views: tuple[DeliveredView, ...]
    set_aside: tuple[SetAside, ...]


def is_delivery(path: Path) -> bool:
    """Whether an input is a delivery: a folder, an archive, an index of tiles, or a file of STAC."""
    if path.suffix.lower() in STAC_SUFFIXES or is_tile_index(path) or is_archive(path):
        return True
    if is_archived(path):
        return is_folder_in_archive(path)
    return path.is_dir()


def open_delivery(path: Path) -> Delivery:
    """Find the views of a delivery.

    Raises
    ------
    InputError
        It holds no image with a camera, or something in it is damaged, hostile or contradicts itself.
    """
    path = Path(path)
    found = _found(path)
    if not found.images:
        reasons = [f"{each.path.name} {each.reason}" for each in found.set_aside if each.reason]
        why = f": {reasons[0]}" if reasons else ""
        raise InputError(f"{path} holds no image with a camera{why}. Give the folder that the vendor delivered.")
    for image in found.images:
        _check_shape(image)
    images = _unique(found.images)
    # A table need not name the multispectral image of a pass, whose time by the vendor's files still tells its partner.
    partners = _partners(images, images)
    if found.table is not None:
        images = dated_images(images, [each.path for each in found.set_aside], found.table)
        partners = _partners([image for image in images if image.product not in partners], images) | partners
    colours = {partner.image.product for partner in partners.values()}
    for sentence in contradictions(images, {*partners, *colours}):
        raise InputError(sentence)
    matched = [image for image in images if image.product not in colours]
    names = _names(matched)
    views = [DeliveredView(names[image.product], image, partners.get(image.product)) for image in matched]
    aside = [each for each in found.set_aside if each.reason]
    return Delivery(path, tuple(sorted(views, key=_time_and_name)), tuple(aside))


def _partners(images: Sequence[DeliveredImage], all_images: Sequence[DeliveredImage]) -> dict[str, ColourPartner]:
    """The image that gives the colours of each image, by the product of the latter. all_images : among which it is."""
    return {image.product: partner for image in images if (partner := colour_partner(image, all_images))}


def _time_and_name(view: DeliveredView) -> tuple[str, str]:
    """Views are in order of their acquisition; those whose time is not known come last."""
    time = view.image.acquisition.time
    return "~" if time is None else time.isoformat(), view.name


def _found(path: Path) -> Found:
    """What the readers find."""
    if path.suffix.lower() in STAC_SUFFIXES:
        return stac_input(path)
    if path.suffix.lower() == TIL_SUFFIX:
        return maxar_input(path, [path.with_name(name) for name in names_beside(path)])
    if is_tile_index(path):
        return dimap_input(path)
    files = files_in(path_in_archive(path) if is_archive(path) and path.is_file() else path)
    found, left = Found(), list(files)
    for reader in READERS:
        more = reader(left) if left else Found()
        found = Found(found.images + more.images, found.set_aside + more.set_aside)
        left = [each for each in left if each not in more.claimed]
    return replace(found, table=find_table(files))


def _check_shape(image: DeliveredImage) -> None:
    """Refuse an image whose size is not the one that the vendor's files say."""
    with open_raster(image.pixels) as source:
        shape = source.shape
    if image.shape is not None and shape != image.shape:
        raise InputError(
            f"The metadata of {image.product} say that the image has {image.shape[0]} x {image.shape[1]} pixels, and "
            f"{image.pixels} has {shape[0]} x {shape[1]}. Copy the product again from its source."
        )


def _unique(images: Sequence[DeliveredImage]) -> list[DeliveredImage]:
    """The images, with different names of their products: that of the folder stands in front where two are alike."""
    count = Counter(image.product for image in images)
    return [
        replace(image, product=f"{image.pixels.parent.name}/{image.product}") if count[image.product] > 1 else image
        for image in images
    ]


def _names(images: Sequence[DeliveredImage]) -> dict[str, str]:
    """The name of the view of each image, by the name of its product: that of its acquisition where it is known and no
    other image has it."""
    acquired = {image.product: _name_of(image.acquisition) for image in images}
    count = Counter(acquired.values())
    return {product: name if name and count[name] == 1 else product for product, name in acquired.items()}


def _name_of(acquisition: Acquisition) -> str:
    """Satellite, day and time: WV03_20141005T160138; empty where the time is not known."""
    if acquisition.time is None:
        return ""
    satellite = "".join(sign for sign in acquisition.satellite or "" if sign.isalnum() or sign == "-")
    return "_".join(part for part in (satellite, f"{acquisition.time:%Y%m%dT%H%M%S}") if part)


def describe(delivery: Delivery) -> str:
    """What was found, and what is left out, in sentences."""
    n_views = len(delivery.views)
    n_coloured = sum(view.partner is not None for view in delivery.views)
    colours = f", {n_coloured} of them with the colours of a multispectral image" if n_coloured else ""
    held = f"{delivery.path} holds {n_views} view{'s' if n_views != 1 else ''}{colours}"
    by_reason: dict[str, list[str]] = {}
    for each in delivery.set_aside:
        by_reason.setdefault(each.reason, []).append(each.path.name)
    if not by_reason:
        return f"{held}."
    parts = []
    for reason, names in by_reason.items():
        more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
        parts.append(f"{', '.join(names[:MAX_NAMED])}{more} ({reason})")
    return f"{held}. Left out: {'; '.join(parts)}."
