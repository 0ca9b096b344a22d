"""What the documents say of the code."""

from __future__ import annotations

import ast
import importlib
import json
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest
import typer.main

import zlocus
from docs_commands import PAGES
from places import ROOT
from zlocus.cli.app import app
from zlocus.core.options import RunConfig
from zlocus.core.requests import FINISHED
from zlocus.io.importers.registry import IMPORTERS
from zlocus.io.scene_file import read_scene_file
from zlocus.io.vertical import KNOWN_GEOIDS
from zlocus.matching import quality as reasons
from zlocus.matching.quality import EMPTY, Quality
from zlocus.products.stac_item import PRODUCTS


def fate(flag: Quality) -> str:
    if flag in EMPTY:
        return "none"
    if flag is Quality.IMAGE_EXCLUDED:
        return "either"
    return "filled" if flag is Quality.FILLED else "kept"


def test_the_table_of_quality_flags_is_that_of_the_code():
    source = Path(reasons.__file__).read_text(encoding="utf-8")
    said = dict(re.findall(r"^    ([A-Z_]+) = \d+  # (.+)$", source, re.MULTILINE))
    expected = [(str(int(flag)), flag.name, said[flag.name], fate(flag)) for flag in Quality]
    page = (ROOT / "docs" / "reference" / "quality.md").read_text(encoding="utf-8")
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in page.splitlines()]
    assert [row for row in rows if row[0].isdigit()] == expected


def test_the_scene_file_of_the_documents_is_valid(tmp_path):
    page = (ROOT / "docs" / "reference" / "scene.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "scene.yaml").write_text(example, encoding="utf-8")
    scene = read_scene_file(tmp_path / "scene.yaml")
    assert [view.name for view in scene.views] == ["nadir", "forward"]


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/reference/examples/*.yaml")), ids=lambda p: p.name)
def test_the_examples_are_valid(path):
    assert len(read_scene_file(path).views) == 2
    assert f"examples/{path.name}" in (ROOT / "docs" / "reference" / "scene.md").read_text(encoding="utf-8")


def test_every_importer_is_documented():
    page = (ROOT / "docs" / "how-to" / "import.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `([a-z]+)` \|", page, re.MULTILINE) == list(IMPORTERS)
    options = {name for importer in IMPORTERS.values() for name in importer.options} | {"images", "overwrite"}
    assert all(f"--{name}" in page for name in options)
    (argument,) = (p for p in typer.main.get_command(app).commands["import"].params if p.name == "kind")
    assert argument.help == ", ".join(list(IMPORTERS)[:-1]) + f" or {list(IMPORTERS)[-1]}."


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 110


def test_the_page_of_vertical_datums_names_what_there_is():
    page = (ROOT / "docs" / "how-to" / "vertical.md").read_text(encoding="utf-8")
    for name, known in KNOWN_GEOIDS.items():
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
    rows = re.findall(
        r"^\| `(\S+)` \|", (ROOT / "docs" / "reference" / "products.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert sorted(rows) == sorted([*(product.name for product in PRODUCTS), "item.json", FINISHED])


STAGES = re.findall(
    r"^\| [^|]+ \| `(zlocus(?:\.[a-z_]+)+)` \|",
    (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8"),
    re.MULTILINE,
)
FUNCTIONS = {name for name in zlocus.__all__ if name.islower() and not name.startswith("_")}
# Folders in pages that are not those of the repository.
NOT_OURS = {"cameras/", "drone/", "images/", "many/", "point/", "scene/", "surface/", "sparse/"}
# Keys of run.json that begin like an option.
IN_RUN_JSON = {"orientation.excluded_images", "orientation.doubts"}
# Files that a reader of the page makes, or that stand for any.
MADE_BY_READER = re.compile(r"src/zlocus/a/b\.py|tests/a/test_b\.py|New file `([\w/.]+)`")
# One or more sizes: (n,), (r, c), (4, r, c).
SHAPE = re.compile(r"\((?:[a-z]|\d+)(?:,|(?:, (?:[a-z]|\d+))+)\)")


def documented(path: str) -> list[str]:
    """Docstrings of a function and of the classes of arrays that it takes and gives."""
    if path.count(".") == 1:
        found = getattr(zlocus, path.partition(".")[2])
    else:
        module, _, name = path.rpartition(".")
        found = getattr(importlib.import_module(module), name)
    assert callable(found)
    classes = [each for each in get_type_hints(found).values() if is_dataclass(each)]
    return [found.__doc__, *(each.__doc__ for each in classes if each.__module__ != "zlocus.core.options")]


def test_stages_are_listed():
    assert len(STAGES) == len(set(STAGES)) == 19
    own = {path for path in STAGES if path.count(".") == 1}
    assert own == {f"zlocus.{name}" for name in FUNCTIONS} - {
        "zlocus.is_empty", "zlocus.match", "zlocus.open_scene", "zlocus.open_surface", "zlocus.read_config",
    }  # fmt: skip


def test_every_function_is_listed_and_every_stage_has_an_example():
    """`tests/docs/test_docs_commands.py` runs the examples."""
    page = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| \{py:func\}`zlocus\.([a-z_]+) <", page, re.MULTILINE))
    assert listed == FUNCTIONS - {"is_empty", "open_surface"} | {"open"}
    shown = "\n".join(re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE))
    assert {name for name in listed if f"zlocus.{name}(" in shown} == listed - {"read_config"}


@pytest.mark.parametrize("path", STAGES)
def test_every_stage_can_be_had_and_says_its_shapes(path):
    own, *of_classes = documented(path)
    assert own, f"{path} has no docstring"
    assert any(SHAPE.search(text) for text in (own, *of_classes)), f"{path} says no shape"


def test_a_docstring_without_shapes_is_noticed():
    assert SHAPE.findall("xyz : (n, 3) m; (4, r, c) uint16; (n,) float64") == ["(n, 3)", "(4, r, c)", "(n,)"]
    assert not SHAPE.search("heights (m) above the ellipsoid (see `match`), (zmin, zmax) m")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_files_named_in_pages_exist(page):
    """Files of the package are named from `src/zlocus`, all others from the root of the repository."""
    text = MADE_BY_READER.sub("", page.read_text(encoding="utf-8"))
    named = re.findall(r"`((?:[a-z_]+/)+(?:[a-z_]+\.py)?)`", text)
    roots = (ROOT, ROOT / "src" / "zlocus", ROOT / "src" / "zlocus" / "matching", page.parent)
    missing = [path for path in named if path not in NOT_OURS and not any((root / path).exists() for root in roots)]
    assert not missing


def test_the_method_names_the_files_of_its_steps():
    text = (ROOT / "docs" / "explanation" / "method.md").read_text(encoding="utf-8")
    assert len(re.findall(r"`(?:matching|orientation|sensors)/", text)) > 15


def option_names(options=None, prefix="") -> set[str]:
    """Names of all options of a run, with those of their groups, and of the groups themselves."""
    options = RunConfig() if options is None else options
    names = set()
    for field in fields(options):
        value = getattr(options, field.name)
        names.add(f"{prefix}{field.name}")
        if is_dataclass(value):
            names |= option_names(value, f"{prefix}{field.name}.")
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_options_named_in_pages_exist(page):
    """As `[group]`, or as `group.option`."""
    known, text = option_names(), page.read_text(encoding="utf-8")
    groups = {name.partition(".")[0] for name in known}
    named = re.findall(r"`([a-z]+(?:\.[a-z0-9_]+)+)(?: = [^`]*)?`", text)
    named = [name for name in named if name.partition(".")[0] in groups and not name.endswith((".tif", ".json", ".py"))]
    named += re.findall(r"`\[([a-z_.]+)\]`", text)
    assert set(named) <= known | IN_RUN_JSON, set(named) - known


def test_options_of_the_choice_of_images_exist():
    text = (ROOT / "docs" / "explanation" / "selection.md").read_text(encoding="utf-8")
    known = {name.rpartition(".")[2] for name in option_names()}
    named = set(re.findall(r"`([a-z]+(?:_[a-z]+)+)`", text))
    assert len(named) > 8
    assert named <= known | {"all_images"}


def code_of(path: Path) -> str:
    """The Python of a script, or of all code cells of a notebook."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return text
    cells = json.loads(text)["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@pytest.mark.parametrize("path", sorted([*ROOT.glob("docs/*.py"), *ROOT.glob("docs/**/*.ipynb")]), ids=lambda p: p.name)
def test_names_that_scripts_and_notebooks_import_exist(path):
    """A rename is noticed before the notebooks are run, which takes minutes."""
    for node in ast.walk(ast.parse(code_of(path))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("zlocus"):
            module = importlib.import_module(node.module)
            for name in node.names:
                assert hasattr(module, name.name), f"{node.module} has no {name.name}"
