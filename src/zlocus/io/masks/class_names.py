"""Names of the classes in masks: how they are compared, which of them show the ground, and where rasters keep them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import rasterio

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.safe_documents import read_xml
from zlocus.io.stored_files import file_exists, is_remote

# Classes whose pixels show the ground, or what covers it for long; all others are masked where nothing else is asked
# for. Thin haze and shadows change grey values, which matching allows for.
SHOWING_GROUND = (
    "background", "cirrus", "clear", "clear land", "clear water", "cloud shadow", "confidence", "cutline", "haze",
    "ice", "land", "light haze", "no cloud", "not cloud", "shadow", "snow", "snow ice", "straylight", "thin cirrus",
    "usable", "valid", "vegetation", "water",
)  # fmt: skip
# Words that make no difference between two names.
FILLERS = frozenset(("and", "or", "mask", "masks", "pixel", "pixels", "area", "areas", "class"))
MAX_SHOWN_NAMES = 12


def words_of(name: str) -> frozenset[str]:
    """The words of a name, by which names are compared: `heavy_haze`, `Haze-heavy` and `HEAVY HAZE` are one name."""
    words = re.findall(r"[a-z0-9]+", name.lower())
    kept = [word for word in words if word not in FILLERS] or words
    return frozenset(word.removesuffix("s") for word in kept)


_SHOWING = frozenset(words_of(name) for name in SHOWING_GROUND)


def shows_ground(name: str) -> bool:
    """Whether pixels of a class show the ground, so that they are not masked unless that is asked for."""
    return words_of(name) in _SHOWING


def values_of(wanted: Sequence[int | str], names: Mapping[str, int], path: Path) -> tuple[int, ...]:
    """The values that are meant by numbers and names, sorted. names : values of the file by their names.

    Raises
    ------
    InputError
        A name is not known; the message lists those that are.
    """
    known = {words_of(name): value for name, value in names.items()}
    found = set()
    for value in wanted:
        if isinstance(value, int):
            found.add(value)
        elif words_of(value) in known:
            found.add(known[words_of(value)])
        else:
            shown = ", ".join(list(names)[:MAX_SHOWN_NAMES])
            has = f"It has {shown}" if names else "It names none; give `names: {name: value}`, or numbers"
            raise InputError(f"{path} has no class called {quoted(value)}. {has}.")
    return tuple(sorted(found))


def named_values(source: rasterio.DatasetReader, path: Path, band: int) -> dict[str, int]:
    """The values of a band by the names of its classes; empty where the raster names none.

    Read from the file `*.aux.xml` of GDAL beside the raster: its attribute table, or else its names of categories.
    (rasterio reads neither.)

    Raises
    ------
    InputError
        That file is damaged.
    """
    sidecar = path.with_name(path.name + ".aux.xml")
    if is_remote(path) or not file_exists(sidecar):
        return {}
    root = read_xml(sidecar)
    for element in root.iter("PAMRasterBand"):
        if element.get("band", "1") == str(band):
            return _of_table(element) or _of_categories(element)
    return {}


def _of_categories(element: Element) -> dict[str, int]:
    """Names of categories: the first one is that of value 0."""
    texts = [(each.text or "").strip() for each in element.iterfind("CategoryNames/Category")]
    return {text: value for value, text in enumerate(texts) if text}


# Source: GDAL, gdal_rat.h, GDALRATFieldUsage.
USAGE_MIN_MAX, USAGE_NAME, USAGE_MIN = "5", "2", "3"


def _of_table(element: Element) -> dict[str, int]:
    """Values and names of a raster attribute table; empty where it has no such columns."""
    table = element.find("GDALRasterAttributeTable")
    if table is None:
        return {}
    columns = table.findall("FieldDefn")
    usage = [(column.findtext("Usage") or "").strip() for column in columns]
    title = [(column.findtext("Name") or "").strip().lower() for column in columns]
    of_value = next((i for i, kind in enumerate(usage) if kind in (USAGE_MIN_MAX, USAGE_MIN)), None)
    of_value = next((i for i, name in enumerate(title) if name == "value"), of_value)
    of_name = next((i for i, kind in enumerate(usage) if kind == USAGE_NAME), None)
    of_name = next((i for i, name in enumerate(title) if "name" in name or name == "class"), of_name)
    if of_value is None or of_name is None or of_value == of_name:
        return {}
    found = {}
    for row in table.iterfind("Row"):
        texts = [(field.text or "").strip() for field in row.findall("F")]
        if len(texts) == len(columns) and texts[of_name]:
            try:
                found[texts[of_name]] = int(float(texts[of_value]))
            except (ValueError, OverflowError):
                continue
    return found
