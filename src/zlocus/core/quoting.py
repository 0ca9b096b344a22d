"""Values in quotation marks for messages."""

from __future__ import annotations

from typing import Any

MAX_SHOWN_CHARACTERS = 40


def quoted(value: Any) -> str:
    """A value in quotation marks for a message, shortened to `MAX_SHOWN_CHARACTERS`."""
    text = value if isinstance(value, str) else repr(value)
    return repr(text if len(text) <= MAX_SHOWN_CHARACTERS else text[:MAX_SHOWN_CHARACTERS] + "...")
