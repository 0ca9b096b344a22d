"""Tables of numbers in text files: a header of column names, then rows, separated by commas, semicolons or blanks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.sensor_model import FloatArray
from zlocus.io.atomic_write import write_atomically
from zlocus.io.open_raster import existing_file
from zlocus.io.safe_text import EXPORT_AGAIN, MAX_LINE_CHARACTERS, MAX_MAGNITUDE, decimal, text_lines

SEPARATORS = (",", ";")


@dataclass(frozen=True, eq=False)
class NumberTable:
    """The content of a table.

    what : role of the file, for messages; columns : numbers of each column, (n,) float64, finite, by name; labels :
    words of each column of words, (n,), by name; lines : (n,) number of the line in the file, from 1, of each row.
    """

    path: Path
    what: str
    columns: dict[str, FloatArray]
    labels: dict[str, tuple[str, ...]]
    lines: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.lines)

    def stacked(self, names: Sequence[str]) -> FloatArray:
        """The columns of these names side by side, (n, k)."""
        return np.column_stack([self.columns[name] for name in names])

    def refuse(self, row: int, fault: str) -> InputError:
        """The error to raise for a row, with its line in the file. fault : what is wrong, without a full stop."""
        return InputError(f"The {self.what} {self.path}, line {self.lines[row]}: {fault}.")

    def check_monotonic(self, name: str, may_decrease: bool = False) -> None:
        """Check that a column increases from row to row. may_decrease : or that it decreases from row to row.

        Raises
        ------
        InputError
            It does not; the message names the first row that breaks the order.
        """
        steps = np.diff(self.columns[name])
        if may_decrease and len(steps) and steps[0] < 0:
            steps = -steps
        broken = np.flatnonzero(~(steps > 0))
        if len(broken):
            value, before = (float(self.columns[name][broken[0] + i]) for i in (1, 0))
            rule = "increase, or decrease, from row to row" if may_decrease else "increase from row to row"
            raise self.refuse(
                int(broken[0]) + 1, f"{name} is {value!r} after {before!r}, but must {rule}; sort the rows"
            )


def read_number_table(path: Path, what: str, allowed: Iterable[str], words: Sequence[str] = ()) -> NumberTable:
    """Read the table in a file. Lines that are empty or start with # are skipped; column names may be in any case.

    what : role of the file, for messages; allowed : allowed names of columns of numbers; words : names of columns of
    words.

    Raises
    ------
    InputError
        The file is missing, no text, or has no rows; a name is unknown or given twice; a row has another length, or
        holds something that is not a finite number. The message names the line.
    """
    path = existing_file(path, what)
    rows = _rows(path, what)
    if len(rows) < 2:
        raise InputError(f"The {what} {path} holds no rows: a header of names and rows of numbers are needed.")
    (_, header), body = rows[0], rows[1:]
    separator = next((mark for mark in SEPARATORS if mark in header), None)
    names = [cell.strip().lower() for cell in header.split(separator)]
    known = [*allowed, *words]
    for name in names:
        if name not in known:
            raise InputError(
                f"The {what} {path} has the column {quoted(name)} in its header. Allowed: {', '.join(known)}."
            )
        if names.count(name) > 1:
            raise InputError(f"The {what} {path} has the column {name} twice in its header. Remove one.")
    numeric, labels = [name for name in names if name not in words], [name for name in names if name in words]
    number_at, word_at = ([names.index(name) for name in group] for group in (numeric, labels))
    values, label_rows = [], []
    for number, line in body:
        cells = line.split(separator)
        if len(cells) != len(names):
            raise InputError(
                f"The {what} {path}, line {number}: {len(cells)} values, but {len(names)} columns "
                f"({', '.join(names)}). Mend the line, or copy the file again where it is cut off."
            )
        label_rows.append([cells[i].strip() for i in word_at])
        values.append(_numbers([cells[i] for i in number_at], what, path, number))
    columns = dict(zip(numeric, np.array(values, float).reshape(len(values), len(numeric)).T, strict=True))
    by_name = {name: tuple(row[k] for row in label_rows) for k, name in enumerate(labels)}
    return NumberTable(path, what, columns, by_name, tuple(number for number, _ in body))


def write_number_table(
    path: Path, columns: dict[str, FloatArray], comment: str, labels: dict[str, Sequence[str]] | None = None
) -> None:
    """Write a table, separated by commas, that `read_number_table` reads back with equal values.

    comment : text of the first line; labels : columns of words by name, written before the numbers.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    numbers = np.column_stack(list(columns.values())).tolist()
    words = zip(*labels.values(), strict=True) if labels else [()] * len(numbers)
    rows = (",".join([*word, *map(repr, row)]) for word, row in zip(words, numbers, strict=True))
    text = "\n".join([f"# {comment}", ",".join([*(labels or ()), *columns]), *rows]) + "\n"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


def _rows(path: Path, what: str) -> list[tuple[int, str]]:
    """The lines that hold a row, each with its number, from 1."""
    rows = []
    for number, line in text_lines(path):
        if len(line) > MAX_LINE_CHARACTERS:
            raise InputError(f"The {what} {path}, line {number}: {len(line)} letters are no row. {EXPORT_AGAIN}")
        if line.strip() and not line.lstrip().startswith("#"):
            rows.append((number, line.strip()))
    return rows


def _numbers(cells: list[str], what: str, path: Path, line: int) -> list[float]:
    """The numbers of a row, checked to be finite."""
    values: list[float] = []
    for cell in cells:
        value = decimal(cell)
        if not abs(value) <= MAX_MAGNITUDE:
            raise InputError(
                f"The {what} {path}, line {line}: {quoted(cell.strip())} is not a finite number. Mend it there."
            )
        values.append(value)
    return values
