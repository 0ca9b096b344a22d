"""Text files read with suspicion: whole or line by line, ended, in UTF-8, and numbers that are plainly numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from zlocus.core.errors import InputError

EXPORT_AGAIN = "Export it again, or copy it again from its source."
MAX_SHOWN_CHARACTERS = 40
# Of a line that a person or a program writes a table in, with room to spare.
MAX_LINE_CHARACTERS = 100_000
# What is measured is smaller; larger numbers are damage, and would overflow.
MAX_MAGNITUDE = 1e15
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
# What ends a value for certain, where no line end does.
CLOSING = ("]", "}", '"', "'")
WORD = re.compile(r"[^\s,;]+")
DECIMAL = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """The whole file. most : bytes that a file of its kind may have.

    Raises
    ------
    InputError
        Where it cannot be read, or is longer.
    """
    try:
        length = path.stat().st_size
        if most is not None and length > most:
            raise InputError(
                f"{path} has {length} bytes, and no file of its kind has more than {most}. Check that it is the right "
                "one."
            )
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Check the path.") from error


def read_text(path: Path, most: int | None = None) -> str:
    """The whole file, which is UTF-8. most : see `read_bytes`."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8, from byte {error.start} on. {EXPORT_AGAIN}") from error


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, from 1, read one at a time; every line has an end, or the last one's last number is
    written as those above it are (see `written`).

    Raises
    ------
    InputError
        Where the file cannot be read, is not UTF-8, or stops within a line.
    """
    above: set[tuple[int, int] | None] = set()
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                words = WORD.findall(line)
                last = digits_written(words[-1]) if words else None
                if not line.endswith("\n") and (last is None or {last} != above):
                    raise truncation_error(path, number)
                if words and is_decimal(words[-1]):
                    above.add(last)
                yield number, line.rstrip("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8. {EXPORT_AGAIN}") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Check the path.") from error


def truncation_error(path: Path, line: int) -> InputError:
    """The error of a file whose last line has no end, so that its last number may be half of one."""
    return InputError(f"{path} stops within line {line}: it may be truncated. Copy it again, or end that line.")


def digits_written(number: str) -> tuple[int, int] | None:
    """Digits behind the point and of the exponent; None where no digit is behind the point, or for no number.

    Where all numbers are written alike, one that was cut short is not.
    """
    mantissa, _, exponent = number.lower().partition("e")
    digits = len(mantissa.partition(".")[2])
    return (digits, len(exponent.lstrip("+-"))) if digits and is_decimal(number) else None


def check_last_line_ended(text: str, path: Path) -> None:
    """Refuse options that stop within a value: the last line has an end, unless it closes a bracket or a quotation.

    Raises
    ------
    InputError
        Naming the line.
    """
    if text and not text.endswith(("\n", "\r", *CLOSING)):
        raise truncation_error(path, text.count("\n") + 1)


def decimal(text: str) -> float:
    """A number as files write it; NaN for anything else, also what only Python reads as one (1_0, other digits)."""
    text = text.strip()
    return float(text) if is_decimal(text) else math.nan


def is_decimal(text: str) -> bool:
    """Whether text is a number as files write it."""
    return DECIMAL.fullmatch(text) is not None


def quoted(value: Any) -> str:
    """A value for a message, shortened."""
    text = value if isinstance(value, str) else repr(value)
    return repr(text if len(text) <= MAX_SHOWN_CHARACTERS else text[:MAX_SHOWN_CHARACTERS] + "...")
