"""Images that have the RPC of another one: a file that was copied or named wrongly."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.scene import Acquisition
from zlocus.sensors.rpc import RpcCoefficients

# Images that are at most so many seconds apart may be products of one exposure, which share their RPC.
SAME_EXPOSURE_SECONDS = 1.0


@dataclass(frozen=True)
class ImageRpc:
    """The RPC that an image has. shape : rows and columns of the image."""

    path: Path
    shape: tuple[int, int]
    acquisition: Acquisition
    rpc: RpcCoefficients


def shared_rpcs(image_rpcs: Iterable[ImageRpc], products: bool = False) -> list[tuple[ImageRpc, ImageRpc]]:
    """The pairs of images that have the identical RPC.

    products : whether some may be products of one exposure, such as a panchromatic and a pansharpened image; then only
    those of different exposures or sizes are found.
    """
    alike_image_rpcs: dict[RpcCoefficients, list[ImageRpc]] = {}
    for image_rpc in image_rpcs:
        alike_image_rpcs.setdefault(image_rpc.rpc, []).append(image_rpc)
    pairs = [pair for group in alike_image_rpcs.values() for pair in itertools.combinations(group, 2)]
    return [pair for pair in pairs if not (products and _are_of_one_exposure(*pair))]


def _are_of_one_exposure(image_rpc_a: ImageRpc, image_rpc_b: ImageRpc) -> bool:
    first, second = image_rpc_a.acquisition.time, image_rpc_b.acquisition.time
    if image_rpc_a.shape != image_rpc_b.shape or first is None or second is None:
        return False
    return abs((first - second).total_seconds()) <= SAME_EXPOSURE_SECONDS


def shared_rpc_message(one: Path, other: Path) -> str:
    """The sentence on two images that have the identical RPC."""
    return (
        f"{one} and {other} have the identical RPC: one is a copy of the other, or has the RPC of the other. Leave one "
        "image out, or copy the RPC of both again from their source."
    )
