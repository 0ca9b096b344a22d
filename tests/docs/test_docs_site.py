"""The documentation site: it builds without network and warnings, loads nothing from elsewhere, leaves nothing out."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from html.parser import HTMLParser
from pathlib import Path

import cv2
import nbformat
import numpy as np
import pytest
import yaml
from nbclient import NotebookClient

import zlocus
from docs_commands import all_commands
from places import ROOT
from zlocus.core.options import RunConfig

DOCS = ROOT / "docs"
NOTEBOOKS = sorted(DOCS.glob("tutorials/notebooks/*.ipynb"))
# Sphinx, in a process that can reach nothing.
OFFLINE = """
import socket, sys

def refuse(*args, **kwargs):
    raise OSError("The documentation is built without network.")

socket.socket.connect = socket.getaddrinfo = refuse
from sphinx.cmd.build import main

sys.exit(main(sys.argv[1:]))
"""
# Of reduced pictures, whose letters are a blur: other versions of Matplotlib draw a little differently.
REDUCED_COLUMNS, SAME_GREY, SAME_SIZE = 64, 4.0, 0.03
# Of the cells of a notebook's surface, those without a height included.
LEAST_WITHIN = 0.9


def build(source: Path, out: Path) -> subprocess.CompletedProcess[str]:
    words = ["-W", "--keep-going", "-E", "-q", "-b", "html", "-D", "nb_execution_mode=off", "-d", out / "trees"]
    command = [sys.executable, "-c", OFFLINE, *map(str, (*words, source, out / "html"))]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built pages, notebooks as they are."""
    folder = tmp_path_factory.mktemp("site")
    done = build(DOCS, folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return folder / "html"


class Loaded(HTMLParser):
    """What a page loads, and what it shows."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        if tag != "a":
            self.loaded += [found[key] for key in ("src", "srcset", "href", "data") if found.get(key)]
        self.loaded += re.findall(r"url\(([^)]*)\)", found.get("style") or "")

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def page(site: Path, name: str) -> Loaded:
    return Loaded((site / name).read_text(encoding="utf-8"))


def test_nothing_is_loaded_from_elsewhere(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 25
    for path in pages:
        for target in page(site, path.relative_to(site).as_posix()).loaded:
            assert not re.match(r"(?:[a-z]+:)?//", target), f"{path.name} loads {target}"
            if not target.startswith(("data:", "#")):
                assert (path.parent / target.partition("?")[0].partition("#")[0]).exists(), f"{path.name}: {target}"
    for style in site.rglob("*.css"):
        for found in re.findall(r"url\(([^)]*)\)|@import ([^;]*)", style.read_text(encoding="utf-8")):
            target = "".join(found)
            assert "data:" in target or "//" not in target, f"{style.name} loads {target}"


def test_a_page_that_loads_from_elsewhere_is_noticed():
    text = '<script src="https://cdn.net/x.js"></script><a href="https://example.org">x</a><img src="a.png">'
    assert Loaded(text).loaded == ["https://cdn.net/x.js", "a.png"]


def letters(text: str) -> str:
    """What is left of a sentence whatever it was set in."""
    return re.sub(r"[^a-z0-9]", "", text.lower())


def test_all_commands_and_options_are_there(site):
    commands = letters(page(site, "reference/commands.html").text)
    for name, command in all_commands().items():
        if hasattr(command, "commands"):
            continue  # a group, whose commands follow
        assert letters(f"zlocus {name}{command.help}") in commands
        for parameter in command.params:
            assert letters(parameter.help) in commands, parameter
            shown = parameter.metavar if parameter.param_type_name == "argument" else parameter.opts[-1]
            assert letters(shown) in commands, parameter
            for contrary in parameter.secondary_opts:
                assert letters(f"{parameter.opts[-1]} {contrary} {parameter.help}") in commands, parameter

    def sentences(options):
        for f in fields(options):
            value = getattr(options, f.name)
            yield from sentences(value) if is_dataclass(value) else [f"{f.name} {value or ''}", f.metadata["doc"]]

    options = letters(page(site, "reference/options.html").text)
    for sentence in sentences(RunConfig()):
        assert letters(sentence) in options, sentence


def test_the_interface_is_described(site):
    anchors = (site / "reference" / "api.html").read_text(encoding="utf-8")
    of_errors = {name for name in zlocus.__all__ if name.endswith(("Error", "Warning"))}
    functions = {name for name in zlocus.__all__ if name.islower() and not name.startswith("_")} - {"is_empty"}
    for name in {"LocusStack", "SemiGlobalHeights"} | of_errors | functions:
        assert f'id="{getattr(zlocus, name).__module__}.{name}"' in anchors, name


def test_parameters_stand_in_a_list(site):
    """Those of every function, by name, where its docstring says something of them."""
    text = (site / "reference" / "api.html").read_text(encoding="utf-8")
    listed = set(re.findall(r"<li><p><strong>([\w,]+)</strong>", text.replace("</strong><strong>", "")))
    for names in ("inputs", "bounds", "step_cells", "reference", "window", "area,mask", "dem_vertical", "x,y"):
        assert names in listed, names
    assert "ortho : (r, c)" not in Loaded(text).text
    assert "dem_vertical : what" not in Loaded(text).text


def test_a_docstring_with_parameters_in_its_sentences():
    sys.path.insert(0, str(DOCS))
    try:
        from reference_pages import with_listed_parameters
    finally:
        sys.path.remove(str(DOCS))
    lines = [
        "What it does.", "", "More words. one : (r, c) m; NaN is", "empty. two, three : of both. Returns (n,) m.", "",
        "Not one : this.", "", ":raises Fault: What happens; one : stays.", "",
    ]  # fmt: skip
    assert with_listed_parameters(lines, ["one", "two", "three"]) == [
        "What it does.", "", "More words.", "", "Returns (n,) m.", "", "Not one : this.", "",
        ":param one: (r, c) m; NaN is empty.", ":param two,three: of both.", "",
        ":raises Fault: What happens; one : stays.", "",
    ]  # fmt: skip
    assert with_listed_parameters(["Only words."], []) == ["Only words."]


def test_every_page_is_listed_in_the_index():
    """Readers reach every page from the index, or from an index that it lists."""
    listed = set()
    for index in DOCS.glob("**/index.md"):
        folder = index.parent.relative_to(DOCS).as_posix()
        for name in re.findall(r"^([a-z_/-]+)$", index.read_text(encoding="utf-8"), re.MULTILINE):
            listed.add(name if folder == "." else f"{folder}/{name}")
    pages = {path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.glob("**/*.md")}
    assert pages - listed == {"index"}


def test_a_mistake_in_a_page_is_a_failure(tmp_path):
    for name in ("conf.py", "reference_pages.py"):
        (tmp_path / name).write_bytes((DOCS / name).read_bytes())
    (tmp_path / "index.md").write_text("# Pages\n\n[one](nowhere.md#at-all)\n")
    done = build(tmp_path, tmp_path / "out")
    assert done.returncode != 0
    assert "nowhere.md" in done.stderr


def test_the_figures_are_those_of_the_code(tmp_path):
    """`python docs/figures.py` makes what is committed, and pages show all of it."""
    subprocess.run([sys.executable, DOCS / "figures.py", tmp_path], check=True, capture_output=True)
    committed = {path.name: path for path in DOCS.glob("figures/*.png")}
    assert {path.name for path in tmp_path.glob("*.png")} == set(committed)
    pages = [page.read_text(encoding="utf-8") for page in DOCS.glob("explanation/*.md")]
    shown = re.findall(r"figures/([a-z_]+\.png)\)", "".join(pages))
    assert sorted(shown) == sorted(committed)
    for name, path in committed.items():
        made, kept = (cv2.imread(str(each), cv2.IMREAD_GRAYSCALE) for each in (tmp_path / name, path))
        np.testing.assert_allclose(made.shape, kept.shape, rtol=SAME_SIZE)
        size = (REDUCED_COLUMNS, REDUCED_COLUMNS * kept.shape[0] // kept.shape[1])
        reduced = [cv2.resize(each, size, interpolation=cv2.INTER_AREA).astype(float) for each in (made, kept)]
        assert np.abs(reduced[0] - reduced[1]).mean() < SAME_GREY, name


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_run(path):
    """They are kept without outputs; run, they find the surface and draw it."""
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(DOCS)}}).execute()
    outputs = [output for cell in code for output in cell.outputs]
    said = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    shares = dict(re.findall(r"^(.*?)within 1 m: ([\d.]+)", said, re.MULTILINE))
    winner_takes_all = shares.pop("census, winner takes all ", "0")
    assert shares
    assert all(float(share) > max(LEAST_WITHIN, float(winner_takes_all)) for share in shares.values()), said
    assert any("image/png" in output.get("data", {}) for output in outputs)


def test_there_are_three_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["first_surface", "why_this_cell", "your_own_cost"]
    index = (DOCS / "tutorials" / "notebooks" / "index.md").read_text(encoding="utf-8")
    assert all(f"\n{path.stem}\n" in index for path in NOTEBOOKS)


def test_the_citation_is_of_this_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == zlocus.__version__
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    page_text = (DOCS / "reference" / "cite.md").read_text(encoding="utf-8")
    assert len(cited["references"]) == 3
    for reference in cited["references"]:
        assert reference["title"].split(":")[0] in " ".join(page_text.split())
        assert str(reference["year"]) in page_text
        assert all(author["family-names"] in page_text for author in reference["authors"])
