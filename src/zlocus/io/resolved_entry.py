"""The views that the inputs of a command name: single images, and deliveries that hold several."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from zlocus.core.errors import ZlocusNote, ZlocusWarning
from zlocus.core.quoting import first_names
from zlocus.core.scene import NOT_KNOWN, Acquisition
from zlocus.io.archives import is_archived, member_of
from zlocus.io.cameras.camera_entry import CameraEntry
from zlocus.io.cameras.camera_kinds import RpcCamera
from zlocus.io.colour_image import ColourImage
from zlocus.io.deliveries.delivered_image import RefusedProduct
from zlocus.io.deliveries.delivery import MAX_NAMED, DeliveredView, Delivery, describe, is_delivery, open_delivery
from zlocus.io.masks.mask_entry import MaskEntry
from zlocus.io.masks.vendor_masks import vendor_kind, vendor_mask

# Parts of a compressed file cannot be read without what lies before them, which shows from this size on.
SLOW_BYTES = 100 << 20


@dataclass(frozen=True)
class ResolvedEntry:
    """A view before its image is opened.

    path : of the image; acquisition : what is known besides the image itself; colour_image : another image that gives
    its colours; masks : of pixels that show no ground, with paths that can be opened.
    """

    name: str
    path: Path
    camera: CameraEntry
    acquisition: Acquisition = NOT_KNOWN
    colour_image: ColourImage | None = None
    masks: tuple[MaskEntry, ...] = ()


def entries_of(paths: Sequence[Path], refused: list[RefusedProduct] | None = None) -> tuple[ResolvedEntry, ...]:
    """The views that some images and deliveries name, each with a name of its own.

    refused : see `open_delivery`.

    Raises
    ------
    InputError
        A delivery holds no image, or is damaged.
    """
    delivered = {path: open_delivery(path, refused) for path in paths if is_delivery(path)}
    images = [path for path in paths if path not in delivered]
    entries = [ResolvedEntry(name, path, RpcCamera()) for name, path in zip(_unique_names(images), images, strict=True)]
    for delivery in delivered.values():
        if delivery.set_aside or delivery.lone:
            category = ZlocusWarning if delivery.is_doubtful else ZlocusNote
            warnings.warn(describe(delivery), category, stacklevel=2)
        _warn_of_missing_masks(delivery)
        entries += [_entry(view) for view in delivery.views]
    _warn_of_slow(entries)
    return tuple(_with_own_names(entries))


def _entry(view: DeliveredView) -> ResolvedEntry:
    """The entry of a delivered view."""
    image, partner = view.image, view.partner
    camera = RpcCamera(file=None if image.camera is None else str(image.camera))
    colour_image = None
    if partner is not None and partner.image.colour_bands is not None:
        of = partner.image
        colour_image = ColourImage(of.pixels, of.camera, partner.image.colour_bands, partner.polynomials)
    masks = [entry for path in image.masks if (entry := _mask_entry(path)) is not None]
    return ResolvedEntry(view.name, image.pixels, camera, image.acquisition, colour_image, tuple(masks))


def _mask_entry(path: Path) -> MaskEntry | None:
    """The entry of a vendor's mask; None of one that is not applied, or of a kind that is not known."""
    kind = vendor_kind(path) or ("classes" if path.suffix.lower() in (".tif", ".tiff") else None)
    return None if kind is None else vendor_mask(path, kind)


def _warn_of_missing_masks(delivery: Delivery) -> None:
    """Say which masks of the matched images are missing, of those that are applied."""
    missing = [path.name for view in delivery.views for path in view.image.missing_masks if _mask_entry(path)]
    if not missing:
        return
    masks = "a mask that belongs" if len(missing) == 1 else f"{len(missing)} masks that belong"
    warnings.warn(
        f"{delivery.path} lacks {masks} to its images: {first_names(missing, MAX_NAMED)}. Clouds and defects "
        "there will be matched. Copy what is missing from the delivery, or give masks in a scene.yaml.",
        ZlocusWarning,
        stacklevel=3,
    )


def _warn_of_slow(entries: Sequence[ResolvedEntry]) -> None:
    for entry in entries:
        member = member_of(entry.path) if is_archived(entry.path) else None
        if member is not None and member.is_packed and member.n_bytes > SLOW_BYTES:
            warnings.warn(
                f"{entry.path} is compressed in its archive, so that every part of it takes long to read. Unpack the "
                "archive and give the folder, to be faster.",
                ZlocusWarning,
                stacklevel=3,
            )
            return


def _with_own_names(entries: Sequence[ResolvedEntry]) -> list[ResolvedEntry]:
    """The entries, of which those whose names are alike are numbered."""
    found, known = [], set[str]()
    for entry in entries:
        name, number = entry.name, 1
        while name in known:
            number += 1
            name = f"{entry.name}-{number}"
        known.add(name)
        found.append(entry if name == entry.name else replace(entry, name=name))
    return found


def _unique_names(paths: Sequence[Path]) -> list[str]:
    """A name for each image: the first that is unique of its stem, parent/stem, and path without suffix."""
    names = [path.stem for path in paths]
    for depth in (1, 2):
        doubled = {name for name in names if names.count(name) > 1}
        for i, path in enumerate(paths):
            if names[i] in doubled:
                whole = path.resolve()
                names[i] = f"{whole.parent.name}/{whole.stem}" if depth == 1 else whole.with_suffix("").as_posix()
    return names
