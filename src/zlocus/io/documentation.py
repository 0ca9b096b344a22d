"""The pages of the documentation, which the wheel holds and a clone has in docs/."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted

# Comments mark figures that are written from measurements, and say nothing to a reader: whole lines, or inside a text.
COMMENT_LINES = re.compile(r"^<!--(?:(?!-->).)*-->\n\n?", re.DOTALL | re.MULTILINE)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
LINE_CHARACTERS = 120
# A paragraph with a line that begins like this is no running text: its lines stay as they are.
NO_TEXT = re.compile(r"^(\||#|- |```|    |>|\d+\. )", re.MULTILINE)


@dataclass(frozen=True)
class Page:
    """A page. name : its path below the folder of all pages, without suffix; title : its first heading."""

    name: str
    title: str
    path: Path

    @property
    def text(self) -> str:
        """The page as Markdown, without comments; paragraphs that had some are filled again."""
        whole = COMMENT_LINES.sub("", self.path.read_text(encoding="utf-8"))
        return "\n\n".join(_without_comments(paragraph) for paragraph in whole.split("\n\n"))


def _without_comments(paragraph: str) -> str:
    """A paragraph without comments, in lines of usual length where it had some."""
    text = COMMENT.sub("", paragraph)
    if text == paragraph or NO_TEXT.search(text):
        return text
    end = "\n" if text.endswith("\n") else ""
    return textwrap.fill(text, LINE_CHARACTERS, break_long_words=False, break_on_hyphens=False) + end


def pages() -> list[Page]:
    """All pages in order of their names.

    Raises
    ------
    InputError
        They were not installed.
    """
    package = Path(__file__).parents[1]
    folder = next((each for each in (package / "pages", package.parents[1] / "docs") if each.is_dir()), None)
    if folder is None:
        raise InputError("The pages of the documentation are not installed. Install zlocus from its wheel again.")
    paths = sorted(folder.rglob("*.md"), key=lambda path: (len(path.relative_to(folder).parts), path))
    return [Page(path.relative_to(folder).with_suffix("").as_posix(), _title(path), path) for path in paths]


def page(name: str) -> Page:
    """The page of a name: `how-to/deliveries`, or its last part where only one page has it.

    Raises
    ------
    InputError
        There is no such page, or several.
    """
    wanted = name.removesuffix(".md").strip("/").lower()
    known = pages()
    found = [each for each in known if each.name.lower() == wanted]
    found = found or [each for each in known if each.name.rpartition("/")[2].lower() == wanted]
    if len(found) != 1:
        near = [each.name for each in (found or known) if found or wanted in each.name.lower()]
        advice = f"Near to it: {', '.join(near)}" if near else "`zlocus docs` lists all pages"
        raise InputError(f"There is no single page {quoted(name)}. {advice}.")
    return found[0]


def _title(path: Path) -> str:
    with path.open(encoding="utf-8") as file:
        return next((line.removeprefix("# ").strip() for line in file if line.startswith("# ")), path.stem)
