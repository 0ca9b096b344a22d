from __future__ import annotations

import pytest

from places import ROOT
from zlocus.core.errors import InputError
from zlocus.io.documentation import page, pages

DOCS = ROOT / "docs"


def test_all_pages_are_listed_with_their_titles():
    known = {each.name: each.title for each in pages()}
    assert set(known) == {path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.rglob("*.md")}
    assert known["reference/quality"] == "Quality flags"


def test_a_page_is_found_by_its_path_or_its_last_part():
    assert page("quality") == page("reference/quality.md") == page("Reference/Quality")
    assert "| 1 | OUTSIDE |" in page("quality").text
    assert "<!--" not in page("quality").text


def test_comments_at_the_ends_of_lines_take_nothing_else_with_them():
    """Figures stand between comments, which make their lines longer or shorter than what is read."""
    text = page("water").text
    assert "are 100 % and 100 % water, and" in text
    paragraph = next(each for each in text.split("\n\n") if "100 % and 100 %" in each)
    assert all(80 < len(line) <= 120 for line in paragraph.splitlines()[:-1])
    assert "cells of 0.5 m:\n\n| lake | two views" in text


@pytest.mark.parametrize(
    ("name", "says"), [("nothing", "`zlocus docs` lists all pages"), ("qual", "Near to it: reference/quality")]
)
def test_a_page_that_is_not_there(name, says):
    with pytest.raises(InputError, match=says):
        page(name)
