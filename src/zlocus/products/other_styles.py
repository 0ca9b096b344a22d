"""Styles beside the products of mosaics, changes, evaluations, comparisons, clouds and ortho-images."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from zlocus.core.options import ProductOptions
from zlocus.evaluation.volumes import ChangeClass
from zlocus.io.open_raster import open_raster
from zlocus.io.row_strips import BandReader
from zlocus.io.styles.file_names import remove_styles
from zlocus.io.styles.layer_style import ClassStyle, Colour, FeatureStyle, RampStyle, StyleRule, ValueColour
from zlocus.products.blending import SeamKind
from zlocus.products.number_names import IMAGES, RUNS, numbered_names
from zlocus.products.styles import (
    BLUE,
    MAKERS,
    ORANGE,
    SKY_BLUE,
    VERMILION,
    Maker,
    even_ramp,
    flag_values,
    image_style,
    named_classes,
    percentiles,
    point_cloud_style,
    round_span,
    rounded_up,
    sampled,
    table_colours,
    write_style,
)

# Too low, right, too high: as in the report.
TOO_LOW, RIGHT, TOO_HIGH = (0, 0, 225), (225, 225, 225), (225, 0, 0)
# Differences have full colours from this percentile of their size on, significances from so many sigmas on.
SATURATED_PERCENT, SATURATED_SIGMAS = 95.0, 5.0
NAMES_OF_CHANGE = {
    ChangeClass.UNCHANGED: ("no significant change", (225, 225, 225)), ChangeClass.RAISED: ("raised", (178, 24, 43)),
    ChangeClass.LOWERED: ("lowered", (33, 102, 172)),
}  # fmt: skip
NAMES_OF_SEAMS = {
    SeamKind.ONE: ("one run has a height", (225, 225, 225)),
    SeamKind.BLENDED: ("runs agree, and are averaged", SKY_BLUE),
    SeamKind.CHOSEN: ("runs contradict each other, and one is chosen", (200, 30, 0)),
}  # fmt: skip
# Colours of numbered runs and images, again from the start where there are more of them.
NUMBER_COLOURS: tuple[Colour, ...] = (
    SKY_BLUE, ORANGE, (0, 158, 115), (240, 228, 66), (204, 121, 167), BLUE, VERMILION, (153, 153, 153),
    (170, 220, 245), (245, 210, 150), (120, 205, 180), (230, 185, 210),
)  # fmt: skip
# More numbers than this have no name each.
MAX_NUMBERS = 256
VOLUME_MM, VOLUME_OPACITY = 0.5, 0.25


def write_other_styles(
    folder: Path, products: Iterable[str], options: ProductOptions | None = None, is_new: bool = True
) -> list[str]:
    """Write the style files of products, and return their names. options : default ones where None is given.

    is_new : the products were made again, so that earlier styles are replaced, and removed of those that are not there
    any more; otherwise only missing styles are written.

    Raises
    ------
    InputError, OutputError
        See `write_styles`.
    """
    options, written = options or ProductOptions(), list[str]()
    for product in products:
        make = _maker_of(product)
        if make is None:
            continue
        if is_new:
            remove_styles(folder, [product])
        if options.styles and (folder / product).is_file():
            written += write_style(folder / product, make, options)
    return written


def _maker_of(product: str) -> Maker | None:
    """What makes the style of a product: by its name, or by the end of it where that begins with the name of an
    image."""
    return _OTHERS.get(product) or next((make for end, make in _OF_IMAGES.items() if product.endswith(end)), None)


def _differences(path: Path, options: ProductOptions) -> RampStyle:
    high = rounded_up(percentiles(np.abs(sampled(path)), (0.0, SATURATED_PERCENT))[1])
    return even_ramp(-high, high, (TOO_LOW, RIGHT, TOO_HIGH), "m")


def _significances(path: Path, options: ProductOptions) -> RampStyle:
    return even_ramp(-SATURATED_SIGMAS, SATURATED_SIGMAS, (TOO_LOW, RIGHT, TOO_HIGH), "sigma")


def _numbers(path: Path, options: ProductOptions) -> ClassStyle | RampStyle:
    """Runs or images by their numbers, with the names that the raster gives them."""
    with BandReader(path) as reader:
        n = int(reader.statistic("MAXIMUM") or 1)
    if n > MAX_NUMBERS:
        return even_ramp(1, n, table_colours(cv2.COLORMAP_TURBO), "")
    with open_raster(path, "raster") as file:
        tags = file.tags(1)
    names = numbered_names(tags.get(RUNS) or tags.get(IMAGES) or "")
    return ClassStyle(
        tuple(
            ValueColour(k, NUMBER_COLOURS[(k - 1) % len(NUMBER_COLOURS)], names.get(k, f"number {k}"))
            for k in range(1, n + 1)
        )
    )


def _image_heights(path: Path, options: ProductOptions) -> RampStyle:
    return even_ramp(*round_span(path), table_colours(cv2.COLORMAP_VIRIDIS), "m")


def _image_depths(path: Path, options: ProductOptions) -> RampStyle:
    # What is near is bright, as what is high.
    return even_ramp(*round_span(path), table_colours(cv2.COLORMAP_VIRIDIS)[::-1], "m")


def _volumes(path: Path, options: ProductOptions) -> FeatureStyle:
    """Polygons that were raised or lowered in all, with their volumes."""
    _, raised = NAMES_OF_CHANGE[ChangeClass.RAISED]
    _, lowered = NAMES_OF_CHANGE[ChangeClass.LOWERED]
    rules = (
        StyleRule("raised in all, m\u00b3", raised, VOLUME_MM, ((0.0, math.inf),), None, None, True, VOLUME_OPACITY),
        StyleRule("lowered in all, m\u00b3", lowered, VOLUME_MM, ((-math.inf, 0.0),), None, None, True, VOLUME_OPACITY),
        StyleRule("volume not known", (120, 120, 120), VOLUME_MM),
    )
    return FeatureStyle("volume_m3", "polygon", rules)


_OTHERS: dict[str, Maker] = MAKERS | {
    "error.tif": _differences, "difference.tif": _differences, "significance.tif": _significances,
    "class.tif": named_classes(NAMES_OF_CHANGE), "volumes.gpkg": _volumes, "seams.tif": named_classes(NAMES_OF_SEAMS),
    "source.tif": _numbers, "mosaic_images.tif": _numbers, "mosaic.tif": image_style, "cloud.laz": point_cloud_style,
    "cloud.copc.laz": point_cloud_style,
}  # fmt: skip
_OF_IMAGES: dict[str, Maker] = {
    "_ortho.tif": image_style, "_height.tif": _image_heights, "_depth.tif": _image_depths, "_quality.tif": flag_values,
}  # fmt: skip
