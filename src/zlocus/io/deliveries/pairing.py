"""Which multispectral image gives the colours of a panchromatic one: that of the same pass and the same ground.

Both were taken by one camera within a second, so that a pixel of the one lies at the same place of the other at every
height. Two images of a stereo pair do not pass this test, because heights shift them against each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.colour_image import PlacePolynomials
from zlocus.io.deliveries.delivered_image import DeliveredImage, Spectrum
from zlocus.io.open_raster import open_raster
from zlocus.sensors.rpc import RpcModel

# Both are taken by lines of one focal plane, up to a second apart; images of a stereo pair are ten seconds apart.
MAX_SECONDS = 5.0
# Largest distance between the place that the polynomials give and that of the cameras, in pixels of the
# multispectral image. Within it colours stay on their roofs.
MAX_DISTANCE_PX = 2.0
# Points of the image in each direction, and heights relative to the range of the RPC, at which both are compared.
N_POINTS, RELATIVE_HEIGHTS = 7, (-0.5, 0.0, 0.5)
# Share of the points that lie in the multispectral image.
MIN_INSIDE = 0.5


@dataclass(frozen=True)
class ColourPartner:
    """The image that gives the colours of another one.

    polynomials : from positions of the other image to positions in this one; distance_px : largest distance
    between these and the cameras, px of this one.
    """

    image: DeliveredImage
    polynomials: PlacePolynomials
    distance_px: float


def colour_partner(image: DeliveredImage, images: Sequence[DeliveredImage]) -> ColourPartner | None:
    """The multispectral image that belongs to a panchromatic one; None where there is none.

    Raises
    ------
    InputError
        A camera or an image cannot be read.
    """
    if image.spectrum is not Spectrum.PANCHROMATIC:
        return None
    coloured = [each for each in images if each.spectrum is Spectrum.MULTISPECTRAL and each.colour_bands is not None]
    of_pass = [each for each in coloured if _may_be_of_one_pass(image, each)]
    found = [partner for each in of_pass if (partner := _partner(image, each)) is not None]
    return min(found, key=lambda partner: _apart(image, partner), default=None)


def _apart(image: DeliveredImage, partner: ColourPartner) -> tuple[bool, int, float]:
    """How far an image and a partner are from being of one product: of two orders in one folder, or twice the same one,
    each image takes the colours of its own."""
    other = partner.image
    is_of_other = image.acquisition.satellite != other.acquisition.satellite
    n_folders = sum(other.pixels.is_relative_to(folder) for folder in image.pixels.parents)
    return is_of_other, -n_folders, partner.distance_px


def _may_be_of_one_pass(image_a: DeliveredImage, image_b: DeliveredImage) -> bool:
    one, other = image_a.acquisition, image_b.acquisition
    if one.time is not None and other.time is not None:
        return abs((one.time - other.time).total_seconds()) <= MAX_SECONDS
    return one.date == other.date


def _partner(image_a: DeliveredImage, image_b: DeliveredImage) -> ColourPartner | None:
    places = common_places((image_a.pixels, image_a.camera), (image_b.pixels, image_b.camera))
    return None if places is None else ColourPartner(image_b, places.polynomials, places.distance_px)


class CommonPlaces(NamedTuple):
    """Where the pixels of an image lie in another one of the same pass, and by how much that is off at most, px."""

    polynomials: PlacePolynomials
    distance_px: float


def common_places(first: tuple[Path, Path | None], second: tuple[Path, Path | None]) -> CommonPlaces | None:
    """The map from one image to another; None where the cameras say that they are of different passes or places.

    first, second : file of the pixels and file of the RPC, None for the one in it or beside it.

    Raises
    ------
    InputError
        A camera or an image cannot be read.
    """
    shapes = []
    for pixels, _ in (first, second):
        with open_raster(pixels) as source:
            shapes.append(source.shape)
    pan, colour = (RpcModel(read_rpc(*each), CRS.from_epsg(4978)) for each in (first, second))
    row, col = (np.linspace(0.0, side - 1.0, N_POINTS) for side in shapes[0])
    xy = np.stack(np.meshgrid(col, row), axis=-1).reshape(-1, 2)
    seen = []
    for relative in RELATIVE_HEIGHTS:
        height = np.full(len(xy), pan.rpc.height_off + relative * pan.rpc.height_scale)
        lon, lat = pan.geographic_from_image(xy, height)
        seen.append(colour.image_from_geographic(lon, lat, height))
    at = np.concatenate(seen)
    if not np.isfinite(at).all():
        return None
    polynomials = PlacePolynomials.fitted(np.tile(xy, (len(RELATIVE_HEIGHTS), 1)), at, shapes[0])
    distance_px = float(np.abs(np.tile(polynomials.at(xy), (len(RELATIVE_HEIGHTS), 1)) - at).max())
    inside = ((at > -0.5) & (at < np.array(shapes[1])[::-1] - 0.5)).all(axis=1).mean()
    if distance_px > MAX_DISTANCE_PX or inside < MIN_INSIDE:
        return None
    return CommonPlaces(polynomials, distance_px)
