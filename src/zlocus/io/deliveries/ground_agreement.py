"""Whether the RPCs of a delivery fit together: a panchromatic image and the multispectral one of its pass look at the
ground from one direction, and images of different exposures have different RPCs."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.cameras.shared_rpc import ImageRpc, shared_rpc_message, shared_rpcs
from zlocus.io.deliveries.delivered_image import DeliveredImage, Spectrum
from zlocus.io.deliveries.pairing import MAX_SECONDS, N_POINTS, RELATIVE_HEIGHTS
from zlocus.io.open_raster import open_raster
from zlocus.sensors.rpc import RpcModel

# A satellite that is 450 km high flies 0.08 of its height in `MAX_SECONDS`: rays that diverge by more than this per
# metre of height are of another pass.
MAX_DIVERGENCE = 0.1
# Share of the points of the panchromatic image that lie in the multispectral one, below which they are not compared.
MIN_COMMON = 0.25
EARTH_RADIUS_M = 6_371_000.0


class Contradiction(NamedTuple):
    """Images whose RPCs contradict each other, and a sentence that says so."""

    images: tuple[DeliveredImage, ...]
    sentence: str


def contradictions(images: Sequence[DeliveredImage], paired: Collection[str]) -> Iterator[Contradiction]:
    """Images whose RPCs contradict each other. Images whose RPC cannot be read are passed over.

    paired : products of the panchromatic images that have colours, and of the images that give them.
    """
    known = {image.product: rpc for image in images if (rpc := _image_rpc(image)) is not None}
    doubtful = set(paired)
    for one, other in shared_rpcs(known.values(), products=True):
        pair = tuple(image for image in images if image.pixels in (one.path, other.path))
        doubtful |= {image.product for image in pair}
        yield Contradiction(pair, shared_rpc_message(one.path, other.path))
    left = [image for image in images if image.product not in doubtful and image.product in known]
    for pan in (image for image in left if image.spectrum is Spectrum.PANCHROMATIC):
        for colour in (image for image in left if image.spectrum is Spectrum.MULTISPECTRAL):
            if not are_of_one_pass(pan, colour):
                continue
            divergence = _divergence(known[pan.product], known[colour.product])
            if divergence is not None and divergence > MAX_DIVERGENCE:
                yield Contradiction(
                    (pan, colour),
                    f"{pan.pixels} and {colour.pixels} are of one pass, but by their RPCs they look at the ground from "
                    f"directions {math.degrees(math.atan(divergence)):.0f} degrees apart: one of them has the RPC of "
                    f"another image, and heights would be wrong. Copy both again from their source; if the RPC of "
                    f"{colour.pixels.name} is the wrong one, leaving that image out is enough.",
                )


def _image_rpc(image: DeliveredImage) -> ImageRpc | None:
    try:
        with open_raster(image.pixels) as source:
            shape = source.shape
        return ImageRpc(image.pixels, shape, image.acquisition, read_rpc(image.pixels, image.camera))
    except InputError:
        return None


def are_of_one_pass(image_a: DeliveredImage, image_b: DeliveredImage) -> bool:
    """Whether one satellite took both within `MAX_SECONDS`, as far as that is known."""
    first, second = image_a.acquisition, image_b.acquisition
    if first.time is None or second.time is None or first.satellite != second.satellite:
        return False
    return abs((first.time - second.time).total_seconds()) <= MAX_SECONDS


def _divergence(image_rpc_a: ImageRpc, image_rpc_b: ImageRpc) -> float | None:
    """By how many metres per metre of height the rays of common pixels diverge, the median; None where the images share
    too little ground."""
    first, second = (RpcModel(each.rpc, CRS.from_epsg(4978)) for each in (image_rpc_a, image_rpc_b))
    row, col = (np.linspace(0.0, side - 1.0, N_POINTS) for side in image_rpc_a.shape)
    xy = np.stack(np.meshgrid(col, row), axis=-1).reshape(-1, 2)
    low, high = (
        image_rpc_a.rpc.height_off + relative * image_rpc_a.rpc.height_scale for relative in RELATIVE_HEIGHTS[::2]
    )
    lon, lat = first.geographic_from_image(xy, np.full(len(xy), low))
    at = second.image_from_geographic(lon, lat, np.full(len(xy), low))
    inside = ((at > -0.5) & (at < np.array(image_rpc_b.shape)[::-1] - 0.5)).all(axis=1)
    if inside.mean() < MIN_COMMON:
        return None
    z = np.full(int(inside.sum()), high)
    lon, lat = first.geographic_from_image(xy[inside], z)
    other_lon, other_lat = second.geographic_from_image(at[inside], z)
    east = np.radians(other_lon - lon) * np.cos(np.radians(lat))
    distance_m = EARTH_RADIUS_M * np.hypot(east, np.radians(other_lat - lat))
    median = float(np.median(distance_m) / (high - low))
    return median if math.isfinite(median) else None
