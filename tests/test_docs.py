"""What the documents say of the code."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer.main

from zlocus.cli import app
from zlocus.io.importers.registry import IMPORTERS
from zlocus.io.scene_file import read_scene_file
from zlocus.io.vertical import KNOWN
from zlocus.products.item import PRODUCTS
from zlocus.surface import reasons
from zlocus.surface.reasons import EMPTY, Quality

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/*.md"), ROOT / "benchmarks" / "README.md"])


def fate(flag: Quality) -> str:
    if flag in EMPTY:
        return "none"
    return "filled" if flag is Quality.FILLED else "kept"


def test_the_table_of_quality_flags_is_that_of_the_code():
    source = Path(reasons.__file__).read_text(encoding="utf-8")
    said = dict(re.findall(r"^    ([A-Z_]+) = \d+  # (.+)$", source, re.MULTILINE))
    expected = [(str(int(flag)), flag.name, said[flag.name], fate(flag)) for flag in Quality]
    page = (ROOT / "docs" / "quality.md").read_text(encoding="utf-8")
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in page.splitlines()]
    assert [row for row in rows if row[0].isdigit()] == expected


def test_the_scene_file_of_the_documents_is_valid(tmp_path):
    page = (ROOT / "docs" / "scene.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "scene.yaml").write_text(example, encoding="utf-8")
    scene = read_scene_file(tmp_path / "scene.yaml")
    assert [view.name for view in scene.views] == ["nadir", "forward"]


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/examples/*.yaml")), ids=lambda p: p.name)
def test_the_examples_are_valid(path):
    assert len(read_scene_file(path).views) == 2
    assert f"examples/{path.name}" in (ROOT / "docs" / "scene.md").read_text(encoding="utf-8")


def test_every_importer_is_documented():
    page = (ROOT / "docs" / "import.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `([a-z]+)` \|", page, re.MULTILINE) == list(IMPORTERS)
    options = {name for importer in IMPORTERS.values() for name in importer.options} | {"images", "overwrite"}
    assert all(f"--{name}" in page for name in options)
    (argument,) = (p for p in typer.main.get_command(app).commands["import"].params if p.name == "kind")
    assert argument.help == ", ".join(list(IMPORTERS)[:-1]) + f" or {list(IMPORTERS)[-1]}."


def test_the_readme_lists_every_option_of_dsm():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    command = typer.main.get_command(app).commands["dsm"]
    options = {name for p in command.params for name in p.opts if name.startswith("--")} - {"--help"}
    assert options == set(re.findall(r"^\| `(?:-o, )?(--[a-z-]+)", readme, re.MULTILINE))


def test_the_page_of_vertical_datums_names_what_there_is():
    page = (ROOT / "docs" / "vertical.md").read_text(encoding="utf-8")
    for name, known in KNOWN.items():
        assert f"| `{name}` | {', '.join(f'`{grid}`' for grid in known.grids)} |" in page
        assert f"| `{name}` | {known.title}, " in page
        assert f"horizontal + EPSG:{known.epsg} |" in page
    commands = typer.main.get_command(app).commands
    for line in re.findall(r"^zlocus .+$", page, re.MULTILINE):
        _, name, *arguments = line.split()
        # An option that there is not raises.
        command = commands[name]
        command.make_parser(command.context_class(command)).parse_args(arguments)


def test_every_product_is_documented():
    rows = re.findall(r"^\| `(\S+)` \|", (ROOT / "docs" / "products.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(rows) == sorted([*(product.name for product in PRODUCTS), "item.json"])
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in readme for name in rows)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_paths_named_in_the_method_exist():
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    named = re.findall(r"\(`([a-z_/]+(?:\.py|/))`\)", text)
    assert len(named) == 17
    for path in named:
        assert (ROOT / "src" / "zlocus" / path).exists(), path
