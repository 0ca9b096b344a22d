"""Clouds painted over a finished image: opaque, bright and textured, with soft edges, and the pixels that they cover.

`zlocus.synthetic.weather` renders clouds that all images of a day see from their own directions. These are in one image
only, whatever its camera is, so that they can be painted over real images too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.synthetic.textures import fractal_surface

COVER_STREAM, TEXTURE_STREAM = 79, 83
CLOUD_M, CLOUD_EXPONENT = 160.0, 2.4
# Lumps of a cloud are as large as houses and as strong as their contrast, so that they can be matched like ground.
TEXTURE_M, TEXTURE_EXPONENT, TEXTURE_SHARE = 20.0, 1.2, 0.08
# Width of the soft edge, in standard deviations of the field that clouds are cut out of.
EDGE = 0.35
# Clouds are brighter than all but this percentile of the ground.
BRIGHT_PERCENT = 99.0


@dataclass(frozen=True)
class CloudyImage:
    """numbers : (r, c), the image with its clouds, in its own type; cover : (r, c) float32, the share of each pixel's
    light that comes from a cloud, between 0 and 1 in the soft edges."""

    numbers: NDArray[np.integer]
    cover: NDArray[np.float32]


def with_clouds(numbers: NDArray[np.integer], share: float, pixel_m: float, seed: int) -> CloudyImage:
    """The image (r, c) with clouds over a share of its pixels, half or more of whose light comes from a cloud.

    numbers : 0 where there is no image, which stays so; pixel_m : size of a pixel on the ground.
    """
    shape = (numbers.shape[0], numbers.shape[1])
    field = fractal_surface(np.random.default_rng([seed, COVER_STREAM]), shape, pixel_m, CLOUD_M, CLOUD_EXPONENT)
    cover = np.clip(0.5 + (field - np.quantile(field, 1.0 - share)) / EDGE, 0.0, 1.0).astype(np.float32)
    lumps = fractal_surface(
        np.random.default_rng([seed, TEXTURE_STREAM]), shape, pixel_m, TEXTURE_M, TEXTURE_EXPONENT
    )  # fmt: skip
    bright = float(np.percentile(numbers[numbers > 0], BRIGHT_PERCENT))
    light = bright * (1.0 + TEXTURE_SHARE * np.clip(lumps, -3.0, 3.0))
    mixed = np.rint(numbers + cover * (light - numbers))
    largest = float(np.iinfo(numbers.dtype).max)
    shown = np.where(numbers > 0, np.clip(mixed, 1.0, largest), 0.0)
    return CloudyImage(shown.astype(numbers.dtype), cover)
