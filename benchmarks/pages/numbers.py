"""Numbers of the pages that are no measured figures: options, years, examples, and records of dated experiments.

They are written by hand and kept in one file, so that a digit that is changed by mistake is noticed. `make numbers`
accepts the numbers of today; the change of the file is reviewed like any other.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path

from pages.spans import unmarked

NUMBER = re.compile(r"\d+(?:[.,]\d+)*")


def page_text(path: Path) -> str:
    """Text of a page in Markdown, or of the cells of a notebook that hold Markdown."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    cells = json.loads(text)["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def numbers_by_line(text: str) -> list[str]:
    """The numbers outside marked spans, one string for each line that has any."""
    lines = (" ".join(NUMBER.findall(line)) for line in unmarked(text).splitlines())
    return [line for line in lines if line]


def read_numbers(path: Path) -> dict[str, list[str]]:
    """Accepted numbers by page."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_numbers(texts: Mapping[str, str], path: Path) -> None:
    """Accept the numbers of all pages. texts : by the name of the page."""
    found = {page: numbers_by_line(text) for page, text in texts.items()}
    part = path.with_suffix(".tmp")
    part.write_text(json.dumps(found, indent=0, ensure_ascii=False) + "\n", encoding="utf-8")
    os.replace(part, path)


def changed_numbers(page: str, text: str, accepted: Mapping[str, list[str]]) -> list[str]:
    """A sentence on the first number of a page that differs from the accepted ones; none where all are equal."""
    if page not in accepted:
        return [f"{page} is new: review its numbers, then accept them with `make numbers`."]
    here, there = " ".join(numbers_by_line(text)).split(), " ".join(accepted[page]).split()
    for k, (now, before) in enumerate(zip_longest(here, there)):
        if now != before:
            around = " ".join(there[max(k - 3, 0) : k]) or "the beginning of the page"
            return [
                f"{page}: after {around} stands {now or 'nothing more'}, and accepted is {before or 'none'}. "
                "If the change is right, accept it with `make numbers`."
            ]
    return []
