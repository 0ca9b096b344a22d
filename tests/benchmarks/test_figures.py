"""Figures of the pages are those of the results files, and no other number of a page changes unnoticed."""

from __future__ import annotations

import ast
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from benchmark_scripts import BENCHMARKS, run_script
from pages import __main__ as command
from pages import all_pages, numbers, spans, tables
from places import ROOT
from result_files import RESULTS, Results, all_results, digest_of
from rows.registry import ROWS
from workplace import CannotRun, Figure

TEXTS = all_pages.texts_of()
ALL_RESULTS = all_results()
ACCEPTED = numbers.read_numbers(all_pages.NUMBERS)
# Digits of each page that are changed, one at a time, spread over the page.
N_CHANGED = 12
ROW_FILES = sorted([*BENCHMARKS.glob("rows/*.py"), BENCHMARKS / "inspecting.py"])


def sentences(page: str, text: str) -> list[str]:
    return all_pages.check_page(page, text, ALL_RESULTS, ACCEPTED)


def digits_of(text: str) -> list[int]:
    """Places of some digits of a text, spread over it."""
    places = [found.start() for found in re.finditer(r"[0-9]", text)]
    return places[:: max(len(places) // N_CHANGED, 1)]


def with_other_digit(text: str, place: int) -> str:
    return text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :]


@pytest.fixture
def copy(tmp_path) -> Path:
    """The pages and the pictures of the peers, in a folder of their own."""
    paths = [path.relative_to(ROOT) for path in all_pages.page_paths()]
    paths += [path.relative_to(ROOT) for path in (ROOT / "docs" / "reference").glob("peers*.png")]
    for path in paths:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / path, tmp_path / path)
    return tmp_path


def test_the_pages_show_their_results():
    assert all_pages.check_pages() == []


@pytest.mark.parametrize("page", TEXTS)
def test_a_changed_digit_is_noticed(page):
    for place in digits_of(TEXTS[page]):
        changed = with_other_digit(TEXTS[page], place)
        found = sentences(page, changed)
        assert found, f"{page}: nobody notices {changed[max(place - 40, 0) : place + 10]!r}"
        assert all(page in sentence for sentence in found)


@pytest.mark.parametrize(
    "page", ["README.md", "docs/reference/accuracy.md", "docs/reference/peers.md", "docs/explanation/semiglobal.md",
             "docs/development/experiments/growth.md"]
)  # fmt: skip
def test_pages_of_every_kind_have_digits_to_change(page):
    assert len(digits_of(TEXTS[page])) >= 5


def test_a_page_and_its_results_that_differ_are_named(copy):
    page = copy / "docs" / "explanation" / "semiglobal.md"
    text = page.read_text(encoding="utf-8")
    found = next(spans.SPAN.finditer(text))
    page.write_text(text.replace(found[0], f"{found[1]}12.3 %{found[4]}", 1), encoding="utf-8")
    (sentence,) = all_pages.check_pages(copy)
    assert sentence == (
        f"docs/explanation/semiglobal.md shows '12.3 %' for `{found[2]}`, and the results files give '{found[3]}'. "
        "Run `make figures`."
    )


def test_other_results_than_those_of_the_page_are_named(copy, tmp_path):
    """In a sentence, and in a table."""
    folder = tmp_path / "results"
    shutil.copytree(RESULTS, folder)
    path = folder / "features.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    for figure in record["figures"]:
        if figure["what"] == "uneven: within 1 m":
            figure["value"] = 0.5
    path.write_text(json.dumps(record), encoding="utf-8")
    found = all_pages.check_pages(copy, folder)
    pages = [sentence.split()[0] for sentence in found]
    assert pages == ["docs/explanation/semiglobal.md", "docs/reference/accuracy.md"]
    assert "the results files give '50.0 %'" in found[0]
    assert "for table `accuracy`" in found[1]
    assert all_pages.write_pages(copy, folder) == pages
    assert all_pages.check_pages(copy, folder) == []
    assert all_pages.write_pages(copy, folder) == []


def test_figures_are_written_only_where_they_differ(copy):
    """Of a fresh clone nothing is written; a damaged figure is written as it was."""
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in copy.rglob("*") if path.is_file()}
    assert all_pages.write_pages(copy) == []
    after = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in copy.rglob("*") if path.is_file()}
    peers = copy / all_pages.PEERS_PAGE
    assert {path: kept for path, kept in after.items() if path != peers} == {
        path: kept for path, kept in before.items() if path != peers
    }
    assert after[peers][0] == before[peers][0]
    page = copy / "docs" / "reference" / "accuracy.md"
    whole = page.read_text(encoding="utf-8")
    page.write_text(whole.replace(">= 0.955", ">= 0.5"), encoding="utf-8")
    assert all_pages.write_pages(copy) == ["docs/reference/accuracy.md"]
    assert page.read_text(encoding="utf-8") == whole


RESULT = Results("town", "c", "2026-01-01", {}, "make measure ROW=town", 1.0, {}, (Figure("within 1 m", 0.98765),))


def test_a_marker_says_which_figure_and_how_it_is_written():
    text = "a <!-- figure: town; within 1 m; .2% -->?<!-- / --> b <!-- figure: town;\nwithin 1 m; .3f -->?<!-- / -->"
    filled = spans.filled(text, {"town": RESULT}, {})
    assert re.sub("<!--.*?-->", "", filled, flags=re.DOTALL) == "a 98.77 % b 0.988"
    assert spans.unmarked(filled) == "a  b "


def test_a_marker_in_code_is_an_example():
    example = "```text\n<!-- table: nobody -->\n<!-- figure: town; within 1 m; .1f -->7<!-- / -->\n```\n"
    assert spans.filled(example, {}, {}) == example
    assert list(spans.differences("p", example, {}, {})) == []
    assert list(spans.mistakes("p", example)) == []
    assert spans.unmarked(example) == example


@pytest.mark.parametrize(
    ("marker", "told"),
    [
        ("town; within 1 m", "is not of the form `ROW; WHAT; FORMAT`"),
        ("city; within 1 m; .1f", r"There is no benchmarks/results/city\.json"),
        ("town; within 2 m; .1f", "has no figure `within 2 m`"),
        ("town; within 1 m; .1q", "is no format of a number"),
    ],
)
def test_a_marker_without_a_figure_is_told(marker, told):
    with pytest.raises(CannotRun, match=told):
        spans.figure_text(marker, {"town": RESULT})
    text = f"a <!-- figure: {marker} -->1<!-- / -->"
    (sentence,) = spans.differences("page.md", text, {"town": RESULT}, {})
    assert sentence.startswith("page.md: ")


def test_markers_that_markdown_would_show_or_that_do_not_end_are_told():
    marker = "<!-- figure: town; within 1 m; .1f -->"
    assert list(spans.mistakes("p", f"a {marker}1<!-- / --> b\n| {marker}1<!-- / --> |")) == []
    assert "line 2: the marker of a figure begins the line" in "".join(spans.mistakes("p", f"a\n{marker}1<!-- / -->"))
    assert "begins the line" in "".join(spans.mistakes("p", f"- {marker}1<!-- / -->"))
    assert "opens 1 figures and tables and closes 0" in "".join(spans.mistakes("p", f"a {marker}1"))
    assert "broken over two lines" in "".join(spans.mistakes("p", f"a {marker}1\n2<!-- / -->"))


def test_a_table_of_an_unknown_name_is_told():
    text = "<!-- table: nobody -->\n\n<!-- end of table -->\n"
    (sentence,) = spans.differences("p", text, {}, tables.TABLES)
    assert "No table is named `nobody`" in sentence
    assert "nobody" not in tables.TABLES
    printed = replace(RESULT, tables=([["a", "b"], ["1", "x | y"]],))
    assert tables.TABLES["town-1"]({"town": printed}) == "| a | b |\n|---|---|\n| 1 | x \\| y |"
    with pytest.raises(CannotRun, match="has 1 tables, and a page asks for number 2"):
        tables.TABLES["town-2"]({"town": printed})


def test_a_figure_that_misses_its_bar_stands_in_the_table():
    row = next(iter(ROWS))
    figures = (
        Figure("a", 0.5, at_least=0.6, fails_when="a fault", is_detail=True),
        Figure("b", 0.7, at_least=0.6, fails_when="a fault", is_detail=True),
        Figure("c", 12.0, "m", at_most=20, fails_when="another | fault"),
    )
    lines = tables.accuracy({row: replace(RESULT, row=row, figures=figures)}).splitlines()
    assert lines[2:4] == [
        f"| {row} | a | >= 0.6 | 0.5000 (short) | a fault |",
        f"| {row} | c | <= 20 m | 12 m | another \\| fault |",
    ]
    assert all("not measured yet" in line for line in lines[4:])
    assert len(lines) == 2 + 2 + sum(row.is_recorded for row in ROWS.values()) - 1


def test_the_command_tells_what_differs(monkeypatch, capsys, tmp_path):
    assert run_script(monkeypatch, command, "--check") == 0
    assert "All pages show their results." in capsys.readouterr().out
    monkeypatch.setattr(command, "check_pages", lambda: ["a page differs"])
    assert run_script(monkeypatch, command, "--check") == 1
    monkeypatch.setattr(command, "stale_results", lambda: ["a row is old"])
    assert run_script(monkeypatch, command, "--stale") == 0
    assert run_script(monkeypatch, command, "--stale", "--fail") == 1
    monkeypatch.setattr(command, "stale_results", list)
    assert run_script(monkeypatch, command, "--stale", "--fail") == 0


def test_results_older_than_the_code_are_listed(tmp_path):
    old = replace(ALL_RESULTS["city"], code=dict.fromkeys(ALL_RESULTS["city"].code, "0"))
    assert all_pages.stale_sentence(old).endswith(
        "is older than src/zlocus, benchmarks/rows/rendered.py: `make measure ROW=city`."
    )
    unknown = all_pages.stale_sentence(replace(old, code={}, command="not recorded"))
    assert unknown.endswith("does not say which code it measured: no command is recorded.")
    now = {part: digest_of(part) for part in old.code}
    assert all_pages.stale_sentence(replace(old, code=now)) == ""


def test_a_comparison_with_another_package_is_listed(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    monkeypatch.setattr(all_pages, "PEERS_RESULTS", path)
    monkeypatch.setattr(all_pages, "package_at", lambda commit: {"a": "other", "b": "same"}.get(commit, ""))
    monkeypatch.setattr(all_pages, "digest_of", lambda part: "same")
    rows = [{"program": "zlocus", "commit": commit} for commit in ("a", "b", "b-dirty")]
    rows.append({"program": "CARS", "commit": "c"})
    path.write_text(json.dumps({"surfaces": rows}))
    (sentence,) = all_pages.stale_peers()
    assert "measured at a, b-dirty, is older than src/zlocus: `make peers`" in sentence
    path.write_text(json.dumps({"surfaces": rows[1:2]}))
    assert all_pages.stale_peers() == []


def figure_calls(path: Path) -> list[ast.Call]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    named = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name))
    return [node for node in named if node.func.id == "Figure"]


def is_constant(node: ast.expr) -> bool:
    """Whether a value is made of literals and constants of the module only."""
    parts = list(ast.walk(node))
    names = [part.id for part in parts if isinstance(part, ast.Name)]
    return not any(isinstance(part, ast.Call | ast.Subscript) for part in parts) and all(map(str.isupper, names))


def lacking(calls: list[ast.Call]) -> list[int]:
    """Lines of figures that cannot miss their bar, because they are constant, or that do not say how they could."""
    lines = []
    for call in calls:
        keywords = {keyword.arg: keyword.value for keyword in call.keywords}
        value = call.args[1] if len(call.args) > 1 else keywords["value"]
        has_bar = len(call.args) > 3 or not keywords.keys().isdisjoint({"at_least", "at_most"})
        if is_constant(value) or (has_bar and "fails_when" not in keywords):
            lines.append(call.lineno)
    return lines


@pytest.mark.parametrize("path", ROW_FILES, ids=lambda path: path.name)
def test_every_figure_with_a_bar_says_how_it_could_miss_it(path):
    assert lacking(figure_calls(path)) == []


def test_a_figure_that_cannot_miss_its_bar_is_noticed(tmp_path):
    path = tmp_path / "row.py"
    path.write_text(
        "Figure('a', N_SIGNALS)\nFigure('b', 2 * 3, 'm')\nFigure('c', x, at_least=1)\nFigure('d', x, '', 1)\n"
        "Figure('e', x)\nFigure('f', float(N), at_most=1, fails_when='g')\n"
    )
    assert lacking(figure_calls(path)) == [1, 2, 3, 4]


@pytest.mark.parametrize("name", ROWS)
def test_a_row_of_the_registry_is_a_function_of_its_file(name):
    module, _, function = ROWS[name].function.partition(":")
    path = ROOT / ROWS[name].parts[-1]
    assert path == BENCHMARKS / f"{module.replace('.', '/')}.py"
    assert f"\ndef {function}(" in path.read_text(encoding="utf-8")


def test_the_roofs_of_the_demo_have_one_figure():
    """Pages tell the share within 1 m over the whole area; the limit of 0.42 m belongs to the mixed sensors."""
    share = ALL_RESULTS["demo"].value("within 1 m: building")
    for page, text in TEXTS.items():
        if page.startswith("docs/development/experiments/"):
            continue
        for form in (f"{share:.4f}", f"{share:.2%}".replace("%", " %")):
            assert form not in spans.unmarked(text), f"{page} tells the figure outside a marked table"
    told = [page for page, text in TEXTS.items() if f"{share:.4f}" in text]
    assert told == ["docs/reference/accuracy.md", "docs/reference/linescan.md"]
