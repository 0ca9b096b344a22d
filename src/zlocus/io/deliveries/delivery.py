"""A folder, an archive, an index of tiles or a file of STAC as an input: the views that it holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.quoting import counted, first_names
from zlocus.core.scene import Acquisition
from zlocus.io.archives import is_archive, is_archived, is_folder_in_archive, path_in_archive
from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.deliveries.acquisition_table import dated_images, find_table
from zlocus.io.deliveries.delivered_image import (
    DeliveredImage,
    Found,
    Reader,
    RefusedProduct,
    SetAside,
    Spectrum,
)
from zlocus.io.deliveries.dimap_products import dimap_input, dimap_products
from zlocus.io.deliveries.gaofen_products import gaofen_products
from zlocus.io.deliveries.geoeye_products import geoeye_products
from zlocus.io.deliveries.ground_agreement import are_of_one_pass, contradictions
from zlocus.io.deliveries.listing import files_in, linked_folders
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
ARCHIVE_INSIDE = "is an archive in it, which is not opened: unpack it, or give it as an input of its own"
LINKED_FOLDER = "is a link to a folder, which is not followed: give that folder as an input of its own"
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

    @property
    def lone(self) -> tuple[DeliveredView, ...]:
        """The multispectral images that are matched beside panchromatic ones, and give no image its colours."""
        spectra = [view.image.spectrum for view in self.views]
        if Spectrum.PANCHROMATIC not in spectra:
            return ()
        return tuple(view for view in self.views if view.image.spectrum is Spectrum.MULTISPECTRAL)

    @property
    def is_doubtful(self) -> bool:
        """Whether it may lack an image that was meant to be matched."""
        return bool(self.lone) or any(each.is_doubtful for each in self.set_aside)


def is_delivery(path: Path) -> bool:
    """Whether an input is a delivery: a folder, an archive, an index of tiles, or a file of STAC."""
    if path.suffix.lower() in STAC_SUFFIXES or is_tile_index(path) or is_archive(path):
        return True
    if is_archived(path):
        return is_folder_in_archive(path)
    return path.is_dir()


def open_delivery(path: Path, refused: list[RefusedProduct] | None = None) -> Delivery:
    """Find the views of a delivery.

    refused : list to which products that cannot be used are added, and the others are found; None: they are errors.

    Raises
    ------
    InputError
        It holds no image with a camera, or something in it is damaged, hostile or contradicts itself.
    """
    path = Path(path)
    delivered = _found(path)
    found = _usable(delivered)
    if refused is not None:
        refused += found.refused
    elif found.refused:
        raise InputError(found.refused[0].reason)
    aside = tuple(each for each in found.set_aside if each.reason)
    if not found.images:
        if found.refused:
            return Delivery(path, (), aside)
        raise InputError(_nothing_in(path, aside))
    images = _unique(found.images)
    # A table need not name the multispectral image of a pass, whose time by the vendor's files still tells its partner.
    partners = _partners(images, images)
    if found.table is not None:
        images = dated_images(images, [each.path for each in found.set_aside], found.table)
        partners = _partners([image for image in images if image.product not in partners], images) | partners
    colours = {partner.image.product for partner in partners.values()}
    is_faulty = bool(found.refused)
    for pair, sentence in contradictions(images, {*partners, *colours}):
        if refused is None:
            raise InputError(sentence)
        refused += [RefusedProduct(image.pixels, sentence) for image in pair]
        colours |= {image.product for image in pair}
        is_faulty = True
    if is_faulty and any(image.spectrum is Spectrum.PANCHROMATIC for image in delivered.images):
        # Their panchromatic images may be among those that cannot be used.
        colours |= {image.product for image in images if image.spectrum is Spectrum.MULTISPECTRAL}
    matched = [image for image in images if image.product not in colours]
    names = _names(matched)
    views = [DeliveredView(names[image.product], image, partners.get(image.product)) for image in matched]
    return Delivery(path, tuple(sorted(views, key=_time_and_name)), aside)


def _usable(found: Found) -> Found:
    """What can be used of what the readers find. A multispectral image without a usable RPC is left out where there is
    a panchromatic one of its pass, because it would give colours only."""
    pans = [image for image in found.images if image.spectrum is Spectrum.PANCHROMATIC]
    usable = Found((), found.set_aside, found.refused, found.table)
    for image in found.images:
        try:
            _check_shape(image)
        except InputError as error:
            usable = usable.with_more(Found(refused=(RefusedProduct(image.pixels, str(error)),)))
            continue
        gives_colours = image.spectrum is Spectrum.MULTISPECTRAL and any(are_of_one_pass(pan, image) for pan in pans)
        # Those of the others are read when their views are opened.
        fault = _fault(image, with_rpc=gives_colours or image.spectrum is Spectrum.PANCHROMATIC)
        if not fault:
            usable = usable.with_more(Found((image,)))
        elif gives_colours:
            aside = SetAside(image.pixels, f"gives no colours: {fault.rstrip('.')}")
            usable = usable.with_more(Found(set_aside=(aside,)))
        else:
            usable = usable.with_more(Found(refused=(RefusedProduct(image.pixels, fault),)))
    return usable


def _fault(image: DeliveredImage, with_rpc: bool) -> str:
    """Why an image cannot be used, as a sentence; empty where nothing is known against it. with_rpc : read its RPC."""
    if image.missing_camera:
        return image.missing_camera
    try:
        if with_rpc:
            read_rpc(image.pixels, image.camera)
    except InputError as error:
        return str(error)
    return ""


def _nothing_in(path: Path, aside: Sequence[SetAside]) -> str:
    """The sentence on a delivery without an image."""
    reasons = [f"{each.path.name} {each.reason}" for each in aside]
    why = f": {reasons[0]}" if reasons else ""
    # Some reasons say themselves what to do.
    advice = "" if ": " in why.removeprefix(": ") else " Give the folder that the vendor delivered."
    return f"{path} holds no image with a camera{why}.{advice}"


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
    linked = linked_folders(path) if path.is_dir() else ()
    if not files and not linked:
        raise InputError(f"{path} is empty: it holds no files. Copy it again from its source, or check the path.")
    found, left = Found(), list(files)
    for reader in READERS:
        more = reader(left) if left else Found()
        found = found.with_more(more)
        left = [each for each in left if each not in more.claimed]
    inside = [SetAside(each, ARCHIVE_INSIDE) for each in left if is_archive(each)]
    found = found.with_more(Found(set_aside=(*inside, *(SetAside(each, LINKED_FOLDER) for each in linked))))
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
    n_coloured = sum(view.partner is not None for view in delivery.views)
    colours = f", {n_coloured} of them with the colours of a multispectral image" if n_coloured else ""
    sentences = [f"{delivery.path} holds {counted(len(delivery.views), 'view')}{colours}."]
    by_reason: dict[str, list[str]] = {}
    for each in delivery.set_aside:
        by_reason.setdefault(each.reason, []).append(each.path.name)
    if by_reason:
        parts = [f"{first_names(names, MAX_NAMED)} ({reason})" for reason, names in by_reason.items()]
        sentences.append(f"Left out: {'; '.join(parts)}.")
    if delivery.lone:
        named = first_names([view.name for view in delivery.lone], MAX_NAMED)
        why = "because no panchromatic image of its pass and ground was found"
        sentences.append(f"Multispectral, and matched by itself, {why}: {named}.")
    return " ".join(sentences)
