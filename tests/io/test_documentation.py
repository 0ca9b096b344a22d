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


@pytest.mark.parametrize(
    ("name", "says"), [("nothing", "`zlocus docs` lists all pages"), ("qual", "Near to it: reference/quality")]
)
def test_a_page_that_is_not_there(name, says):
    with pytest.raises(InputError, match=says):
        page(name)
