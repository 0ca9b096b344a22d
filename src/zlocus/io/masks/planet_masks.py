"""Masks of Planet: UDM2, a raster with a band for each class, and the older UDM, a raster whose bits have meanings.

Source: Planet, "Usable Data Mask" (docs.planet.com/data/imagery/udm) and "Imagery Product Specifications".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import rasterio

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.masks.band_rule import BandRule
from zlocus.io.masks.class_names import words_of
from zlocus.io.masks.mask_entry import MaskEntry

# Bands of a UDM2 in their order, for files that do not name them.
UDM2_BANDS = ("clear", "snow", "shadow", "light_haze", "heavy_haze", "cloud", "confidence", "udm1")
# The confidence (percent) is no class, and the bits of `udm1` have names of their own.
UDM2_CLASSES = UDM2_BANDS[:6]
# Bits of a UDM by their names. Clouds are found by brightness, so that snow counts as cloud.
UDM_BITS = {"blackfill": 0b1, "cloud": 0b10, "missing": 0b11111100}
# Of the `udm1` band of a UDM2 its clouds are not used: those of the other bands are better.
UNUSABLE_BITS = UDM_BITS["blackfill"] | UDM_BITS["missing"]
UDM2_DEFAULT = ("cloud", "heavy_haze", "unusable")


def is_udm2(source: rasterio.DatasetReader) -> bool:
    """Whether the bands of a raster are named as those of a UDM2."""
    named = {words_of(text) for text in source.descriptions if text}
    return {words_of("clear"), words_of("cloud"), words_of("udm1")} <= named


def is_udm(source: rasterio.DatasetReader, path: Path) -> bool:
    """Whether a raster is a UDM, by the name of its file (`*_DN_udm.tif`, `*_udm_clip.tif`) and its single band."""
    return source.count == 1 and re.search(r"_udm(_\w+)?\.", path.name.lower()) is not None


def udm2_rules(entry: MaskEntry, source: rasterio.DatasetReader, path: Path) -> tuple[BandRule, ...]:
    """The rules of a UDM2: the classes that `values` names, by default clouds, heavy haze and unusable pixels.

    Raises
    ------
    InputError
        The raster has other bands than a UDM2, or a name is not one of its classes.
    """
    _refuse(entry, path, "UDM2")
    if any(source.descriptions):
        texts: Sequence[str] = [text or "" for text in source.descriptions]
    elif source.count == len(UDM2_BANDS):
        texts = UDM2_BANDS
    else:
        raise InputError(f"{path} is no UDM2: it has {source.count} bands without names, not {len(UDM2_BANDS)}.")
    bands = {words_of(text): i for i, text in enumerate(texts, 1) if text}
    rules = []
    for name in entry.values or UDM2_DEFAULT:
        _check_name(name, (*UDM2_CLASSES, "unusable"), path)
        is_unusable = words_of(str(name)) == words_of("unusable")
        band = bands.get(words_of("udm1" if is_unusable else str(name)))
        if band is None:
            raise InputError(f"{path} is no UDM2: it has no band for {quoted(str(name))}, but {', '.join(texts)}.")
        rules.append(BandRule(band, bits=UNUSABLE_BITS if is_unusable else None))
    return tuple(rules)


def udm_rules(entry: MaskEntry, path: Path) -> tuple[BandRule, ...]:
    """The rule of a UDM: the bits that `values` names, by default all of them.

    Raises
    ------
    InputError
        A name is not one of its bits.
    """
    _refuse(entry, path, "UDM")
    bits = 0
    for name in entry.values or tuple(UDM_BITS):
        _check_name(name, tuple(UDM_BITS), path)
        bits |= next(bit for known, bit in UDM_BITS.items() if words_of(known) == words_of(str(name)))
    return (BandRule(1, bits=bits),)


def _refuse(entry: MaskEntry, path: Path, kind: str) -> None:
    """Refuse options that say nothing to masks of Planet."""
    if entry.band is not None or entry.names is not None:
        raise InputError(f"{path} is a {kind}, whose classes have names: give `values`, without `band` and `names`.")


def _check_name(name: int | str, known: Sequence[str], path: Path) -> None:
    if words_of(str(name)) not in {words_of(each) for each in known}:
        raise InputError(f"{path} has no class called {quoted(str(name))}. It has {', '.join(known)}.")
