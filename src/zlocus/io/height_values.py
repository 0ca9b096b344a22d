"""Heights as rasters hold them: their unit, and numbers that mean none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import InputError

# Of bands, as programs write them. Any other is taken for the metre: some write "1", or what is measured.
UNITS_NOT_METRE = (
    "ft", "foot", "feet", "ftus", "sft", "sfoot", "yd", "yard", "in", "inch", "fathom", "mm", "cm", "dm", "km",
    "millimetre", "centimetre", "decimetre", "kilometre", "millimeter", "centimeter", "decimeter", "kilometer",
)  # fmt: skip
# Before them: whose feet they are.
FOOT_PREFIXES = ("us survey ", "u.s. survey ", "international ", "survey ", "us ", "u.s. ", "intl ", "british ")
# What programs write where they have no height, often without declaring it; nothing lies there so exactly.
FILL_HEIGHTS = (-9999.0, -32767.0, -32768.0, float(np.finfo(np.float32).min))


def check_unit(unit: str | None, path: Path) -> None:
    """Refuse heights of a band in units that are no metres.

    Raises
    ------
    InputError
        For such heights.
    """
    plain = (unit or "").strip().lower().replace("-", " ").replace("_", " ")
    whose = next((name for name in FOOT_PREFIXES if plain.startswith(name)), "")
    unit_name = plain.removeprefix(whose)
    if unit_name in UNITS_NOT_METRE or unit_name.removesuffix("s") in UNITS_NOT_METRE:
        raise InputError(f"The heights of {path} are in {unit}. Convert them to metres.")


def is_fill(stored: NDArray[Any]) -> NDArray[np.bool_]:
    """Which numbers of a band, as stored, mean no height though nothing says so."""
    return np.isin(stored, FILL_HEIGHTS)
