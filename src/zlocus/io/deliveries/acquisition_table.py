"""A table of when and how images were taken: `dates.csv` in a delivery, one line for each image.

The columns are found by their names: `image` or `name` (of the file, or its name without suffix); `date`, `time`,
`acquired` or a name that begins with `acquired_`; `sun_azimuth`, `sun_elevation`, `view_azimuth`, `off_nadir`,
`incidence` and `cloud_cover` (0 to 1), each also with `_deg` at its end; `satellite`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.scene import Acquisition
from zlocus.io.image_acquisition import acquisition_from, time_in
from zlocus.io.safe_text import read_text

NAME, MAX_BYTES = "dates.csv", 10_000_000
IMAGE_COLUMNS, TIME_COLUMNS = ("image", "name", "file"), ("acquired", "datetime", "date")
# Column of the table: name of the same quantity among those of vendors.
VENDOR_NAMES = {
    "sun_azimuth": "sun_azimuth", "sun_elevation": "sun_elevation", "view_azimuth": "satellite_azimuth",
    "off_nadir": "off_nadir", "incidence": "incidence_angle", "cloud_cover": "cloud_cover", "satellite": "satid",
}  # fmt: skip


def read_acquisition_table(path: Path) -> dict[str, Acquisition]:
    """What a table says of each image, by the name of its file, in small letters, without suffix.

    Raises
    ------
    InputError
        The file is no such table, names an image twice, or holds a day on which no image can have been taken.
    """
    rows = csv.DictReader(io.StringIO(read_text(path, MAX_BYTES)))
    columns = {str(name).strip().lower(): str(name) for name in rows.fieldnames or ()}
    image = next((columns[name] for name in IMAGE_COLUMNS if name in columns), None)
    time = next((columns[name] for begin in TIME_COLUMNS for name in columns if name.startswith(begin)), None)
    if image is None or time is None:
        raise InputError(
            f"{path} is no table of dates: its first line has to name the columns {IMAGE_COLUMNS[0]} and "
            f"{TIME_COLUMNS[-1]}, and it is {quoted(','.join(columns))}."
        )
    acquisitions: dict[str, Acquisition] = {}
    for number, row in enumerate(rows, 2):
        name = Path((row[image] or "").strip()).stem.lower()
        if name in acquisitions:
            raise InputError(f"{path}, line {number}: {quoted(name)} is there twice. Remove one of the lines.")
        moment = time_in(_moment(row, time, columns))
        if moment is None:
            raise InputError(
                f"{path}, line {number}: {quoted(row[time] or '')} is no day on which an image can have been taken. "
                "Write it as 2014-10-05 or 2014-10-05T16:01:38Z."
            )
        acquisitions[name] = Acquisition(*moment).completed_by(acquisition_from(_vendor_fields(row, columns)))
    return acquisitions


def _moment(row: Mapping[str, str | None], column: str, columns: Mapping[str, str]) -> str:
    """Day and time of a line, in one column or in two."""
    day = (row[column] or "").strip()
    clock = (row.get(columns.get("time", ""), None) or "").strip()
    return f"{day}T{clock}" if clock and columns.get("time") != column else day


def _vendor_fields(row: Mapping[str, str | None], columns: Mapping[str, str]) -> dict[str, str]:
    fields: dict[str, str] = {}
    for name, vendor in VENDOR_NAMES.items():
        column = next((columns[each] for each in (name, f"{name}_deg") if each in columns), None)
        if column is not None:
            fields[vendor] = (row[column] or "").strip()
    return fields


def find_table(files: Sequence[Path]) -> Path | None:
    """The table of a delivery; None where there is none."""
    return next((path for path in files if path.name.lower() == NAME), None)
