"""`zlocus docs`: the pages of the documentation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console


@dataclass(frozen=True)
class DocsOptions:
    """Arguments of `zlocus docs`."""

    page: Annotated[
        str | None, typer.Argument(metavar="PAGE", help="A page, such as quality or how-to/scripts; none lists all.")
    ] = None


def docs(options: DocsOptions, console: Console) -> Answer:
    """Read the documentation, which is installed with the program."""
    from zlocus.io.documentation import page, pages

    del console
    if options.page is None:
        known = pages()
        width = max(len(each.name) for each in known)
        text = "\n".join(f"{each.name.ljust(width)}  {each.title}" for each in known)
        return Answer(text, {"pages": [{"name": each.name, "title": each.title} for each in known]}, is_asked_for=True)
    found = page(options.page)
    return Answer(found.text, {"name": found.name, "title": found.title, "text": found.text}, is_asked_for=True)
