"""Marked spans and tables of a page, and the text that the results files give for them.

A figure in a sentence or in a cell of a table stands between two comments, which no reader sees:

    <!-- figure: ROW; WHAT; FORMAT -->0.9847<!-- / -->

ROW names the results file, WHAT is the label of the figure there, and FORMAT is a format of Python (`.4f`, `.1%`). A
table that is made from results files stands between two lines; see `tables.py` for its name:

    <!-- table: NAME -->

    ...

    <!-- end of table -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from result_files import Results
from workplace import CannotRun

SPAN = re.compile(r"(<!--\s*figure:\s*([^>]*?)\s*-->)(.*?)(<!--\s*/\s*-->)", re.DOTALL)
TABLE = re.compile(r"^(<!-- table: ([\w-]+) -->\n)(.*?)^(<!-- end of table -->)$", re.DOTALL | re.MULTILINE)
# A fenced block of code, in which markers are examples.
CODE = re.compile(r"(^```.*?^```[ \t]*$)", re.DOTALL | re.MULTILINE)
OPENINGS = re.compile(r"<!--\s*(?:figure|table):")
# A comment at the beginning of a line would make all of the line a block of HTML.
AT_LINE_START = re.compile(r"^[ \t]*(?:[-*+]|\d+\.)?[ \t]*<!--\s*(?:figure:|/)", re.MULTILINE)
PARTS = 3

Tables = Mapping[str, Callable[[Mapping[str, Results]], str]]


@dataclass(frozen=True)
class Difference:
    """A marked text that differs from its results file. what : of the figure or the table."""

    page: str
    what: str
    shown: str
    measured: str

    def __str__(self) -> str:
        return (
            f"{self.page} shows {self.shown!r} for {self.what}, and the results files give {self.measured!r}. "
            "Run `make figures`."
        )


def figure_text(marker: str, results: Mapping[str, Results]) -> str:
    """The figure that a marker names, in its format. marker : "ROW; WHAT; FORMAT".

    Raises
    ------
    CannotRun
        The marker has other parts, or there is no such row, figure or format.
    """
    parts = [" ".join(part.split()) for part in marker.split(";")]
    if len(parts) != PARTS:
        raise CannotRun(f"The marker `{marker}` is not of the form `ROW; WHAT; FORMAT`. Correct it.")
    row, what, form = parts
    if row not in results:
        raise CannotRun(f"There is no benchmarks/results/{row}.json for the marker `{marker}`: `make measure {row}`.")
    value = results[row].value(what)
    try:
        text = format(value, form)
    except ValueError as error:
        raise CannotRun(f"`{form}` in the marker `{marker}` is no format of a number. Correct it.") from error
    return text.replace("%", " %").replace(",", " ")


def filled(text: str, results: Mapping[str, Results], tables: Tables) -> str:
    """A page with every marked span and table as the results files have it."""

    def fill(piece: str) -> str:
        piece = TABLE.sub(lambda m: f"{m[1]}\n{table_text(m[2], results, tables)}\n\n{m[4]}", piece)
        return SPAN.sub(lambda m: f"{m[1]}{figure_text(m[2], results)}{m[4]}", piece)

    return outside_code(text, fill)


def outside_code(text: str, change: Callable[[str], str], code: Callable[[str], str] = str) -> str:
    """A page with all text outside fenced code changed by one function, and the code by another."""
    return "".join(code(piece) if k % 2 else change(piece) for k, piece in enumerate(CODE.split(text)))


def without_code(text: str) -> str:
    """A page with its fenced code as empty lines."""
    return outside_code(text, str, lambda code: "\n" * code.count("\n"))


def table_text(name: str, results: Mapping[str, Results], tables: Tables) -> str:
    """The table with this name.

    Raises
    ------
    CannotRun
        No function makes it.
    """
    if name not in tables:
        raise CannotRun(f"No table is named `{name}`; benchmarks/pages/tables.py makes {', '.join(tables)}.")
    return tables[name](results).strip("\n")


def differences(page: str, text: str, results: Mapping[str, Results], tables: Tables) -> Iterator[str]:
    """Sentences on the marked spans and tables that differ from the results files. page : its name."""
    text = without_code(text)
    for found in TABLE.finditer(text):
        try:
            measured = table_text(found[2], results, tables)
        except CannotRun as reason:
            yield f"{page}, table `{found[2]}`: {reason}"
            continue
        shown = found[3].strip("\n")
        if shown != measured:
            yield str(Difference(page, f"table `{found[2]}`", *first_difference(shown, measured)))
    for found in SPAN.finditer(text):
        try:
            measured = figure_text(found[2], results)
        except CannotRun as reason:
            yield f"{page}: {reason}"
            continue
        if found[3] != measured:
            yield str(Difference(page, f"`{' '.join(found[2].split())}`", found[3], measured))


def first_difference(one: str, other: str) -> tuple[str, str]:
    """The first line in which two texts differ, of each of them; empty where one has ended."""
    ones, others = one.splitlines(), other.splitlines()
    for k in range(max(len(ones), len(others))):
        pair = ones[k] if k < len(ones) else "", others[k] if k < len(others) else ""
        if pair[0] != pair[1]:
            return pair
    return one, other


def mistakes(page: str, text: str) -> Iterator[str]:
    """Sentences on markers that are not closed, or that stand where Markdown would not hide them."""
    text = without_code(text)
    n_closed = len(SPAN.findall(text)) + len(TABLE.findall(text))
    if n_closed != len(OPENINGS.findall(text)):
        yield f"{page} opens {len(OPENINGS.findall(text))} figures and tables and closes {n_closed}. Close each one."
    for found in AT_LINE_START.finditer(text):
        line = text.count("\n", 0, found.start()) + 1
        yield f"{page}, line {line}: the marker of a figure begins the line. Put a word before it on the line."
    for found in SPAN.finditer(text):
        if "\n" in found[3]:
            yield f"{page}: the figure `{found[2]}` is broken over two lines. Put it on one line."


def unmarked(text: str) -> str:
    """A page without its marked spans and tables."""
    return outside_code(text, lambda piece: SPAN.sub("", TABLE.sub("", piece)))
