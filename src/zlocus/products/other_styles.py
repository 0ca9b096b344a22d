"""Styles beside the rasters of mosaics, changes, evaluations and comparisons."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from zlocus.core.options import ProductOptions
from zlocus.evaluation.volumes import ChangeClass
from zlocus.io.styles.file_names import remove_styles
from zlocus.io.styles.layer_style import RampStyle
from zlocus.products.blending import SeamKind
from zlocus.products.styles import (
    MAKERS,
    SKY_BLUE,
    even_ramp,
    named_classes,
    percentiles,
    rounded_up,
    sampled,
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


def write_other_styles(folder: Path, products: Collection[str]) -> None:
    """Write the style files of products of other commands, in place of earlier ones; of those that are not there, the
    earlier ones are removed.

    Raises
    ------
    InputError, OutputError
        See `write_styles`.
    """
    for product in [name for name in products if name in _OTHERS]:
        remove_styles(folder, [product])
        if (folder / product).is_file():
            write_style(folder / product, _OTHERS[product], ProductOptions())


def _differences(path: Path, options: ProductOptions) -> RampStyle:
    high = rounded_up(percentiles(np.abs(sampled(path)), (0.0, SATURATED_PERCENT))[1])
    return even_ramp(-high, high, (TOO_LOW, RIGHT, TOO_HIGH), "m")


def _significances(path: Path, options: ProductOptions) -> RampStyle:
    return even_ramp(-SATURATED_SIGMAS, SATURATED_SIGMAS, (TOO_LOW, RIGHT, TOO_HIGH), "sigma")


_OTHERS = MAKERS | {
    "error.tif": _differences, "difference.tif": _differences, "significance.tif": _significances,
    "class.tif": named_classes(NAMES_OF_CHANGE), "seams.tif": named_classes(NAMES_OF_SEAMS),
}  # fmt: skip
