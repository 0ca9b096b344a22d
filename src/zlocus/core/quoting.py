"""Values in messages: in quotation marks, and counted."""

from __future__ import annotations

from typing import Any

MAX_SHOWN_CHARACTERS = 40


def quoted(value: Any) -> str:
    """A value in quotation marks for a message, shortened to `MAX_SHOWN_CHARACTERS`."""
    text = value if isinstance(value, str) else repr(value)
    return repr(text if len(text) <= MAX_SHOWN_CHARACTERS else text[:MAX_SHOWN_CHARACTERS] + "...")


def counted(n: int, noun: str) -> str:
    """A number with its noun, in the plural where it is not one: 1 tile, 2 tiles."""
    return f"{n} {noun}{'' if n == 1 else 's'}"
