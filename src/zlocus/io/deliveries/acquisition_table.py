"""A table of when and how images were taken: `dates.csv` in a delivery, one line for each image.

The columns are found by their names: `image`, `name` or `file` (of the file of pixels or the index of its tiles, with
or without suffix, or of the product); `acquired`, `datetime`, `date` or a name that begins with one of them; `time`;
`sun_azimuth`, `sun_elevation`, `view_azimuth`, `off_nadir`, `incidence` and `cloud_cover` (0 to 1), each also with
`_deg` at its end; `satellite`. Nothing in a table is left out in silence.
"""

from __future__ import annotations

import csv
import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.core.quoting import first_names, quoted
from zlocus.core.scene import Acquisition
from zlocus.io.deliveries.delivered_image import DeliveredImage
from zlocus.io.image_acquisition import acquisition_from, time_in
from zlocus.io.safe_text import read_text

NAME, MAX_BYTES = "dates.csv", 10_000_000
IMAGE_COLUMNS, TIME_COLUMNS = ("image", "name", "file"), ("acquired", "datetime", "date")
CLOCK = "time"
# Column of the table: name of the same quantity among those of vendors.
VENDOR_NAMES = {
    "sun_azimuth": "sun_azimuth", "sun_elevation": "sun_elevation", "view_azimuth": "satellite_azimuth",
    "off_nadir": "off_nadir", "incidence": "incidence_angle", "cloud_cover": "cloud_cover", "satellite": "satid",
}  # fmt: skip
# Smallest and largest value of the columns that hold numbers, and what they are.
LIMITS = {
    "sun_azimuth": (-180.0, 360.0, "an angle from -180 to 360 degrees"),
    "sun_elevation": (0.0, 90.0, "an angle above the horizon, from 0 to 90 degrees"),
    "view_azimuth": (-180.0, 360.0, "an angle from -180 to 360 degrees"),
    "off_nadir": (-89.0, 89.0, "an angle from -89 to 89 degrees"),
    "incidence": (-89.0, 89.0, "an angle from -89 to 89 degrees"),
    "cloud_cover": (0.0, 1.0, "a share from 0 to 1"),
}
SUFFIX = re.compile(r"\.[a-z][a-z0-9]{1,4}")
# Names of images that a message lists.
MAX_NAMED = 5


@dataclass(frozen=True)
class _Row:
    """A line of a table. number : of the line; name : as the table writes it, in small letters."""

    number: int
    name: str
    acquisition: Acquisition


def dated_images(
    images: Sequence[DeliveredImage], set_aside: Sequence[Path], path: Path
) -> list[DeliveredImage]:  # fmt: skip
    """Images with what a table says of them, which has precedence, because someone made it for these images.

    set_aside : files of images that are left out, which the table may name; path : of the table.

    Raises
    ------
    InputError
        The file is no such table, holds a value that is none of its column, or names an image twice.
    """
    rows = _read(path)
    of_image = [{*_names_of(image.pixels), image.product.lower().rpartition("/")[2]} for image in images]
    known = set().union(*of_image, *map(_names_of, set_aside))
    unknown = [row for row in rows if not _spellings(row.name) & known]
    if unknown:
        names = [f"{row.name} (line {row.number})" for row in unknown]
        warnings.warn(
            f"{path} names images that are not in this folder: {first_names(names, MAX_NAMED)}. What it says of "
            "them has no effect; correct the names where these images should be here.",
            ZlocusWarning,
            stacklevel=2,
        )
    return [_with_row(image, names, rows) for image, names in zip(images, of_image, strict=True)]


def _with_row(image: DeliveredImage, names: set[str], rows: Sequence[_Row]) -> DeliveredImage:
    """An image with what the line of a table says that has one of its names."""
    found = next((row.acquisition for row in rows if _spellings(row.name) & names), None)
    return image if found is None else replace(image, acquisition=found.completed_by(image.acquisition))


def _names_of(pixels: Path) -> set[str]:
    return {pixels.name.lower(), pixels.stem.lower()}


def _spellings(name: str) -> set[str]:
    """A name with and without its suffix: names of products may hold points too."""
    return {name, _without_suffix(name)}


def _without_suffix(name: str) -> str:
    path = Path(name)
    return path.stem if SUFFIX.fullmatch(path.suffix) else name


def _read(path: Path) -> list[_Row]:
    """The lines of a table. Raises `InputError`: see `dated_images`."""
    text = read_text(path, MAX_BYTES)
    if not text.strip():
        raise InputError(f"{path} is empty. Fill it, or remove it.")
    table = csv.DictReader(io.StringIO(text))
    columns = _columns(table, path)
    rows: dict[str, _Row] = {}
    for fields in table:
        row = _row(fields, columns, path, table.line_num)
        same = _without_suffix(row.name)
        if same in rows:
            raise InputError(f"{path}, line {row.number}: {quoted(same)} is there twice. Remove one of the lines.")
        rows[same] = row
    if not rows:
        raise InputError(f"{path} has no line below the names of its columns. Add one for each image, or remove it.")
    return list(rows.values())


def _columns(table: csv.DictReader[str], path: Path) -> dict[str, str]:
    """Names of the columns as the table writes them, by what they hold: one of `VENDOR_NAMES`, image, date, time."""
    header = {str(name).strip().lower(): str(name) for name in table.fieldnames or () if str(name).strip()}
    if len(header) == 1 and ";" in "".join(header):
        raise InputError(
            f"{path} has semicolons between its columns. Write commas between them, and points in numbers."
        )
    held = {name: _held_by(name) for name in header}
    if not {"image", "date"} <= set(held.values()):
        raise InputError(
            f"{path} is no table of dates: its first line has to name the columns {IMAGE_COLUMNS[0]} and "
            f"{TIME_COLUMNS[-1]}, and it is {quoted(','.join(header))}."
        )
    columns: dict[str, str] = {}
    for name, meaning in held.items():
        if meaning is None:
            raise InputError(
                f"{path}, line 1: the column {quoted(header[name])} is not known. Known are {IMAGE_COLUMNS[0]}, "
                f"{TIME_COLUMNS[-1]}, {CLOCK}, {', '.join(VENDOR_NAMES)}; correct its name, or remove it."
            )
        columns.setdefault(meaning, header[name])
    return columns


def _held_by(name: str) -> str | None:
    """What a column holds by its name, in small letters; None where that is not known."""
    if name in IMAGE_COLUMNS:
        return "image"
    if name.startswith(TIME_COLUMNS):
        return "date"
    quantity = name.removesuffix("_deg")
    return quantity if quantity in VENDOR_NAMES or quantity == CLOCK else None


def _row(fields: Mapping[str | None, str | None], columns: Mapping[str, str], path: Path, number: int) -> _Row:
    """A line of a table. number : of the line, for messages."""
    if None in fields:
        raise InputError(f"{path}, line {number}: it has more values than the first line names columns. Correct it.")
    texts = {held: (fields[column] or "").strip() for held, column in columns.items()}
    name = Path(texts["image"]).name.lower()
    if not name:
        raise InputError(f"{path}, line {number}: it names no image. Correct it, or remove the line.")
    moment = time_in(f"{texts['date']}T{texts[CLOCK]}" if texts.get(CLOCK) else texts["date"])
    if moment is None:
        raise InputError(
            f"{path}, line {number}: {quoted(texts['date'])} is no day on which an image can have been taken. "
            "Write it as 2014-10-05 or 2014-10-05T16:01:38Z."
        )
    for said in _faults(texts):
        raise InputError(f"{path}, line {number}: {said}. Correct it, or leave it empty.")
    vendor_fields = {vendor: texts[held] for held, vendor in VENDOR_NAMES.items() if held in texts}
    return _Row(number, name, Acquisition(*moment).completed_by(acquisition_from(vendor_fields)))


def _faults(texts: Mapping[str, str]) -> Iterator[str]:
    """What is wrong with the numbers of a line. texts : by what they hold."""
    for held, (low, high, meaning) in LIMITS.items():
        if not (text := texts.get(held, "")):
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high or (held == "sun_elevation" and value == 0.0):
            yield f"{quoted(text)} in {held} is not {meaning}"
    sun = [name for name in ("sun_azimuth", "sun_elevation") if texts.get(name)]
    if len(sun) == 1:
        yield f"{sun[0]} tells no direction without the other angle of the sun"


def find_table(files: Sequence[Path]) -> Path | None:
    """The table of a delivery; None where there is none."""
    return next((path for path in files if path.name.lower() == NAME), None)
