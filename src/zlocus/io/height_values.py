"""Heights stored in rasters: their unit, and numbers that stand for missing heights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import InputError

# Units of bands that are refused, as programs spell them. Any other text counts as the metre: some programs write "1",
# or the name of the quantity.
UNITS_NOT_METRE = (
    "ft", "foot", "feet", "ftus", "sft", "sfoot", "yd", "yard", "in", "inch", "fathom", "mm", "cm", "dm", "km",
    "millimetre", "centimetre", "decimetre", "kilometre", "millimeter", "centimeter", "decimeter", "kilometer",
)  # fmt: skip
# Words before a unit that say which foot it is.
FOOT_PREFIXES = ("us survey ", "u.s. survey ", "international ", "survey ", "us ", "u.s. ", "intl ", "british ")
# Numbers that programs write for a missing height, often without declaring them as nodata.
FILL_HEIGHTS = (-9999.0, -32767.0, -32768.0, float(np.finfo(np.float32).min))


def check_unit(unit: str | None, path: Path) -> None:
    """Check that the heights of a band are in metres.

    Raises
    ------
    InputError
        The band declares another unit.
    """
    plain = (unit or "").strip().lower().replace("-", " ").replace("_", " ")
    prefix = next((name for name in FOOT_PREFIXES if plain.startswith(name)), "")
    unit_name = plain.removeprefix(prefix)
    if unit_name in UNITS_NOT_METRE or unit_name.removesuffix("s") in UNITS_NOT_METRE:
        raise InputError(f"The heights of {path} are in {unit}. Convert them to metres.")


def is_fill(stored: NDArray[Any]) -> NDArray[np.bool_]:
    """Which stored numbers of a band stand for a missing height without being declared. The shape of `stored`."""
    return np.isin(stored, FILL_HEIGHTS)
