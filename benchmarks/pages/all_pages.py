"""All pages of the project: write their figures, compare them with the results files, list results that are old."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

from pages import numbers, scene_tables, spans  # noqa: F401 (scene_tables registers its tables)
from pages.tables import TABLES
from peers.page import OWN, page_of, write_page
from result_files import DIRTY, NOT_RECORDED, PACKAGE, RESULTS, Results, all_results, digest_at, digest_of, stale_parts
from workplace import ROOT, CannotRun

NUMBERS = ROOT / "benchmarks" / "unmeasured_numbers.json"
PEERS_RESULTS, PEERS_PAGE = ROOT / "benchmarks" / "peers" / "results.json", "docs/reference/peers.md"


def page_paths(root: Path = ROOT) -> list[Path]:
    """Every page in Markdown that a reader may be sent to, and the notebooks."""
    found = [root / "README.md", root / "benchmarks" / "README.md"]
    return sorted(path for path in [*found, *root.glob("docs/**/*.md"), *root.glob("docs/**/*.ipynb")] if path.exists())


def texts_of(root: Path = ROOT) -> dict[str, str]:
    """Text of all pages by their path below the root."""
    return {path.relative_to(root).as_posix(): numbers.page_text(path) for path in page_paths(root)}


def write_pages(root: Path = ROOT, folder: Path = RESULTS) -> list[str]:
    """Write the pages that differ from the results files, each under a temporary name first; return their names."""
    results, written = all_results(folder), []
    for path in page_paths(root):
        if path.suffix != ".md":
            continue
        before = path.read_text(encoding="utf-8")
        after = spans.filled(before, results, TABLES)
        if after != before:
            part = path.with_suffix(".tmp")
            part.write_text(after, encoding="utf-8")
            os.replace(part, path)
            written.append(path.relative_to(root).as_posix())
    if PEERS_RESULTS.exists():
        page = root / PEERS_PAGE
        before = page.read_text(encoding="utf-8") if page.exists() else ""
        write_page(PEERS_RESULTS, page.parent)
        written += [PEERS_PAGE] if page.read_text(encoding="utf-8") != before else []
    return written


def check_pages(root: Path = ROOT, folder: Path = RESULTS) -> list[str]:
    """Sentences on all that differs: markers, marked figures and tables, the page of the peers, and other numbers."""
    results, accepted, texts = all_results(folder), numbers.read_numbers(NUMBERS), texts_of(root)
    found = [sentence for page, text in texts.items() for sentence in check_page(page, text, results, accepted)]
    return [*found, *(f"{page} is gone: accept that with `make numbers`." for page in accepted if page not in texts)]


def check_page(page: str, text: str, results: Mapping[str, Results], accepted: Mapping[str, list[str]]) -> list[str]:
    """Sentences on what differs in one page. accepted : numbers of each page that are no measured figures."""
    if page == PEERS_PAGE:
        return peers_differences(text) if PEERS_RESULTS.exists() else []
    found = [*spans.mistakes(page, text), *spans.differences(page, text, results, TABLES)]
    return [*found, *numbers.changed_numbers(page, text, accepted)]


def peers_differences(shown: str) -> list[str]:
    """The first line of the page of the peers that differs from their results, as a sentence; none if all agree."""
    made = page_of(json.loads(PEERS_RESULTS.read_text(encoding="utf-8")))
    if made == shown:
        return []
    there, here = spans.first_difference(shown, made)
    return [str(spans.Difference(PEERS_PAGE, "a line that benchmarks/peers/results.json makes", there, here))]


def accept_numbers() -> None:
    """Accept the numbers outside marked spans in all pages but that of the peers, which is written as a whole."""
    numbers.write_numbers({page: text for page, text in texts_of().items() if page != PEERS_PAGE}, NUMBERS)


def stale_results(folder: Path = RESULTS) -> list[str]:
    """One sentence for each results file that is older than the code that it measures, that of the peers included."""
    found = [sentence for results in all_results(folder).values() if (sentence := stale_sentence(results))]
    return [*found, *stale_peers()]


def stale_peers() -> list[str]:
    """A sentence if zlocus was compared with other programs at commits whose package was another, else nothing."""
    if not PEERS_RESULTS.exists():
        return []
    rows = json.loads(PEERS_RESULTS.read_text(encoding="utf-8"))["surfaces"]
    commits = sorted({row["commit"] for row in rows if row["program"] == OWN})
    now = digest_of(PACKAGE)
    old = [commit for commit in commits if commit.endswith(DIRTY) or package_at(commit) != now]
    if not old:
        return []
    return [f"The comparison with other programs, measured at {', '.join(old)}, is older than {PACKAGE}: `make peers`."]


def package_at(commit: str) -> str:
    """Digest of the package at a commit; empty where the history does not reach it."""
    try:
        return digest_at(PACKAGE, commit)
    except CannotRun:
        return ""


def stale_sentence(results: Results) -> str:
    """What has changed since a row was measured, or nothing."""
    how = "no command is recorded" if results.command == NOT_RECORDED else f"`{results.command}`"
    if not results.code:
        return f"{results.row}, of {results.date[:10]}, does not say which code it measured: {how}."
    changed = stale_parts(results)
    if not changed:
        return ""
    return (
        f"{results.row}, measured {results.date[:10]} at {results.commit}, is older than {', '.join(changed)}: {how}."
    )
