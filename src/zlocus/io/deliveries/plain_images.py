"""Images of a delivery that no vendor's reader knows: every raster that has an RPC, in its tags or beside it.

NITF files hold theirs in the header (RPC00B).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.request_checks import IMAGE_SUFFIXES
from zlocus.io.archives import is_archived
from zlocus.io.cameras.rpc import find_sidecar
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, SetAside
from zlocus.io.open_raster import open_raster

# Formats without tags, which mostly show in small what other files hold.
PREVIEW_SUFFIXES = (".jpg", ".jpeg", ".png", ".gif")


def plain_images(files: Sequence[Path]) -> Found:
    """The rasters with an RPC among some files; those without one are set aside."""
    images, aside = [], []
    for path in files:
        suffix = path.suffix.lower()
        if suffix not in IMAGE_SUFFIXES or (suffix == ".vrt" and is_archived(path)):
            continue
        camera = find_sidecar(path)
        if suffix in PREVIEW_SUFFIXES and camera is None:
            continue
        try:
            has_rpc = camera is not None or _has_rpc_tag(path)
        except InputError as error:
            aside.append(SetAside(path, f"cannot be read ({error})"))
            continue
        if has_rpc:
            images.append(DeliveredImage(product=path.stem, pixels=path, camera=camera))
        else:
            aside.append(SetAside(path, "has no RPC, in its tags or beside it"))
    return Found(tuple(images), tuple(aside))


def _has_rpc_tag(path: Path) -> bool:
    with open_raster(path) as source:
        return bool(source.tags(ns="RPC"))
