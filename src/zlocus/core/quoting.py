"""Values in messages: in quotation marks, counted, and the first of many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

MAX_SHOWN_CHARACTERS = 40


def quoted(value: Any) -> str:
    """A value in quotation marks for a message, shortened to `MAX_SHOWN_CHARACTERS`."""
    text = value if isinstance(value, str) else repr(value)
    return repr(text if len(text) <= MAX_SHOWN_CHARACTERS else text[:MAX_SHOWN_CHARACTERS] + "...")


def counted(n: int, noun: str) -> str:
    """A number with its noun, in the plural where it is not one: 1 tile, 2 tiles."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def first_names(names: Sequence[str], n_named: int) -> str:
    """The first names, separated by commas, and how many more there are: a.tif, b.tif and 5 more."""
    more = f" and {len(names) - n_named} more" if len(names) > n_named else ""
    return ", ".join(names[:n_named]) + more
