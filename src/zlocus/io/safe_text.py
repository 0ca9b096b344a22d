"""Safe reading of text files: UTF-8 only, no truncated last line, and only plain decimal numbers."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.io.archives import is_archived
from zlocus.io.stored_files import byte_length, read_content

EXPORT_AGAIN = "Export it again, or copy it again from its source."
# Longer than any line of a table that a person or a program writes.
MAX_LINE_CHARACTERS = 100_000
# Larger than anything that is measured. A larger number is a sign of damage, and could overflow later.
MAX_MAGNITUDE = 1e15
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
# A value that ends with one of these is complete, even without a line end.
CLOSING = ("]", "}", '"', "'")
WORD = re.compile(r"[^\s,;]+")
DECIMAL = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)


def read_bytes(path: Path, max_bytes: int | None = None) -> bytes:
    """The content of a file. max_bytes : the most that a file of its kind may have; None: no limit.

    Raises
    ------
    InputError
        The file cannot be read, or is longer.
    """
    length = byte_length(path)
    if max_bytes is not None and length > max_bytes:
        raise InputError(
            f"{path} has {length} bytes, and no file of its kind has more than {max_bytes}. Check that it is the right "
            "one."
        )
    return read_content(path)


def read_text(path: Path, max_bytes: int | None = None) -> str:
    """The content of a text file in UTF-8. max_bytes : see `read_bytes`.

    Raises
    ------
    InputError
        The file cannot be read, is longer, or is not UTF-8.
    """
    try:
        return read_bytes(path, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8, from byte {error.start} on. {EXPORT_AGAIN}") from error


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a file with their numbers, from 1.

    A last line without a line end is accepted if its last number has as many digits as those above it (see
    `digits_written`); otherwise the file may have been truncated within that number.

    Raises
    ------
    InputError
        The file cannot be read, is not UTF-8, or stops within a line.
    """
    above: set[tuple[int, int] | None] = set()
    try:
        with io.StringIO(read_text(path)) if is_archived(path) else path.open(encoding="utf-8-sig") as file:
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
    """The error of a file whose last line has no line end, so that its last number may be truncated."""
    return InputError(f"{path} stops within line {line}: it may be truncated. Copy it again, or end that line.")


def digits_written(number: str) -> tuple[int, int] | None:
    """Number of digits behind the point and in the exponent; None without digits behind the point, or for no number.

    Where all numbers of a table have the same digits, a truncated one stands out.
    """
    mantissa, _, exponent = number.lower().partition("e")
    digits = len(mantissa.partition(".")[2])
    return (digits, len(exponent.lstrip("+-"))) if digits and is_decimal(number) else None


def check_last_line_ended(text: str, path: Path) -> None:
    """Check that a file of options does not stop within a value.

    Its last line has a line end, unless it closes a bracket or a quotation.

    Raises
    ------
    InputError
        The file may be truncated; the message names the line.
    """
    if text and not text.endswith(("\n", "\r", *CLOSING)):
        raise truncation_error(path, text.count("\n") + 1)


def decimal(text: str) -> float:
    """The value of a decimal number; NaN for any other text, also for what only Python accepts (1_0, other digits)."""
    text = text.strip()
    return float(text) if is_decimal(text) else math.nan


def is_decimal(text: str) -> bool:
    """Whether a text is a plain decimal number."""
    return DECIMAL.fullmatch(text) is not None
