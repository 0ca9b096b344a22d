"""Images of a delivery that no vendor's reader knows: every raster that has an RPC, in its tags or beside it.

NITF files hold theirs in the header (RPC00B).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.request_checks import IMAGE_SUFFIXES
from zlocus.io.archives import is_archived
from zlocus.io.cameras.rpc import find_sidecar, has_rpc_tag
from zlocus.io.deliveries.delivered_image import DeliveredImage, Found, SetAside
from zlocus.io.image_acquisition import acquisition_of
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
            if camera is not None or has_rpc_tag(path):
                with open_raster(path) as source:
                    acquisition = acquisition_of(source)
                images.append(DeliveredImage(path.stem, path, camera, acquisition))
            else:
                aside.append(_without_rpc(path))
        except InputError as error:
            aside.append(SetAside(path, f"cannot be read ({error})", is_doubtful=True))
    return Found(tuple(images), tuple(aside))


def _without_rpc(path: Path) -> SetAside:
    """Why an image without an RPC is left out. One that has a place on a map is none that was meant to be matched."""
    with open_raster(path) as source:
        is_map = source.crs is not None and not source.transform.is_identity
    reason = "is a map or a product of one, and has no RPC" if is_map else "has no RPC, in its tags or beside it"
    return SetAside(path, reason, is_doubtful=not is_map)
