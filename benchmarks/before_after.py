"""Two results files of a row side by side: its figures before and after a change of a default.

    python benchmarks/before_after.py BEFORE.json AFTER.json

Figures are paired by their labels. A figure that stands in one file only has no value in the other (`-`). The last
column says whether the figure passes its bar after the change, and which bar that is.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from workplace import CannotRun, Figure, ended

HEADING = ("figure", "before", "after", "change", "bar")
ABSENT = "-"
# Figures are printed with so many significant digits.
DIGITS = 4


def main() -> None:
    """Read the command line and print the table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, metavar="BEFORE", help="results file, as benchmarks/results holds them")
    parser.add_argument("after", type=Path, metavar="AFTER", help="results file of the same row, measured later")
    given = parser.parse_args()
    before, after = read_figures(given.before), read_figures(given.after)
    print("\n".join(f"| {' | '.join(line)} |" for line in [HEADING, *table(before, after)]).replace("\n", RULE, 1))


RULE = "\n|---|---:|---:|---:|---|\n"


def read_figures(path: Path) -> dict[str, Figure]:
    """Figures of a results file by their labels.

    Raises
    ------
    CannotRun
        The file is missing, or no results file.
    """
    try:
        listed: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["figures"]
        known = Figure.__dataclass_fields__.keys()
        figures = [Figure(**{key: value for key, value in each.items() if key in known}) for each in listed]
        # A figure without a value is null in the file.
        figures = [figure if figure.value is not None else replace(figure, value=math.nan) for figure in figures]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CannotRun(f"{path} is no results file ({error}). Measure the row with `make measure ROW`.") from error
    return {figure.what: figure for figure in figures}


def table(before: dict[str, Figure], after: dict[str, Figure]) -> list[tuple[str, ...]]:
    """Cells of the table, a line per figure: those of the second file in their order, then those that it lacks."""
    lines = []
    for what in [*after, *(name for name in before if name not in after)]:
        old, new = (figures.get(what) for figures in (before, after))
        unit = (new or old).unit
        values = [math.nan if each is None else each.value for each in (old, new)]
        bar = "" if new is None else " ".join(new.cells()[2:]).strip()
        label = f"{what} ({unit})" if unit else what
        lines.append((label, *map(as_text, values), as_text(values[1] - values[0], "+"), bar))
    return lines


def as_text(value: float, sign: str = "") -> str:
    """A value for the table."""
    return ABSENT if math.isnan(value) else f"{value:{sign}.{DIGITS}g}"


if __name__ == "__main__":
    ended(main)
