"""All commands of the documents are run. Of those that take hours, or run these tests, only the options are checked."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import fields
from functools import cache
from pathlib import Path

import httpx
import pytest
import typer.main
from typer.testing import CliRunner

from docs_commands import (
    IN_SMALL,
    INLINE,
    LAID_OUT,
    PAGES,
    PAGES_WITH_COMMANDS,
    PROJ_GRIDS,
    Step,
    all_commands,
    command_name,
    in_small,
    inline_commands,
    name_of,
    steps_of,
)
from places import ROOT
from typed_commands import is_run_here, run_here, runnable
from zlocus.cli.app import app
from zlocus.cli.console import OutputOptions
from zlocus.io.styles.file_names import OF_SURFACE, style_files
from zlocus.synthetic.__main__ import _parser

COMMANDS = all_commands()
# Per cent, of the figures in the tutorial.
TOLD_TO = 0.5
ENDS_WITHIN_S = 10.0


def options_of(text: str) -> set[str]:
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]*|(?<![\w-])-o\b", text))


def check_zlocus(text: str) -> None:
    """The command and the options of a line of `zlocus` exist."""
    name = command_name(text.split())
    assert name in COMMANDS or name.startswith("--"), text
    command = COMMANDS[name] if name in COMMANDS else typer.main.get_command(app)
    known = {option for parameter in command.params for option in parameter.opts} | {"--help"}
    assert options_of(text) <= known, text


def check_synthetic(text: str) -> None:
    known = set(_parser()._option_string_actions)
    assert options_of(text) <= known, text


def check_make(text: str) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(rf"^{text.split()[1]}:", makefile, re.MULTILINE), text


# Starts scripts, each in a process of its own that has loaded already what most of them import, and keeps what they say
# of themselves in files that are numbered as the scripts are. A script that does not end after `--help` has failed.
HELP = """
import gc, os, runpy, sys
from pathlib import Path
import cv2
import zlocus.evaluation.evaluate, zlocus.pipeline.dsm, zlocus.synthetic.files

folder, *scripts = sys.argv[1:]
gc.freeze()
for number, script in enumerate(scripts):
    if not (process := os.fork()):
        said = os.open(f"{folder}/{number}", os.O_CREAT | os.O_WRONLY)
        os.dup2(said, 1)
        sys.argv, sys.path[0] = [script, "--help"], script if Path(script).is_dir() else str(Path(script).parent)
        try:
            runpy.run_path(script, run_name="__main__")
        except SystemExit as end:
            sys.stdout.flush()
            os._exit(end.code or 0)
        os._exit(3)
    if status := os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]):
        sys.exit(f"{script} --help ends with exit status {status}")
"""


@cache
def help_of_scripts() -> dict[str, str]:
    """What the scripts of benchmarks/ that pages name say of themselves."""
    scripts = sorted(
        {
            shlex.split(step.text)[1]
            for page in PAGES_WITH_COMMANDS
            for step in steps_of(page)
            if step.text.startswith("python benchmarks/")
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run([sys.executable, "-c", HELP, folder, *scripts], capture_output=True, text=True, cwd=ROOT)
        assert done.returncode == 0, done.stderr
        return {script: (Path(folder) / str(i)).read_text(encoding="utf-8") for i, script in enumerate(scripts)}


def check_benchmark(text: str) -> None:
    """The script starts, and has the options."""
    assert options_of(text) <= options_of(help_of_scripts()[shlex.split(text)[1]]), text


def check_pytest(text: str) -> None:
    """There is something to be run."""
    words = [*shlex.split(text)[1:], "--collect-only", "-q", "-p", "no:cacheprovider"]
    # Where these tests run in several processes, pytest-benchmark would believe that the benchmarks do so too.
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_XDIST_WORKER"}
    subprocess.run([sys.executable, *words], capture_output=True, cwd=ROOT, check=True, env=environment)


# Not run, and why.
ONLY_CHECKED = {
    "make ": check_make,  # environments, this very test, hours of benchmarks
    "python benchmarks/": check_benchmark,  # minutes to hours on one core
    "python -m pytest benchmarks": check_pytest,  # times, which mean nothing beside other tests
}


def run(step: Step, folder: Path) -> None:
    """Runs one step in a folder as a reader would; commands that are alternatives to others begin anew."""
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    environment["PROJ_USER_WRITABLE_DIRECTORY"] = str(folder / PROJ_GRIDS)
    command = [sys.executable, "-c", step.text] if step.is_python else ["bash", "-c", runnable(step.text)]
    words = [] if step.is_python else shlex.split(runnable(step.text))
    out = folder / words[words.index("-o") + 1] if "-o" in words else folder / "scene.yaml"
    if words[:2] == ["zlocus", "import"] or ("-o" in words and "--redo" not in words):
        shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)
    if words[:2] == ["zlocus", "inspect"]:
        check_page(words, folder, environment)
        return
    if is_run_here(step, folder):
        run_here(words, folder)
        return
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{step.text}\n{done.stdout}\n{done.stderr}"


def check_page(words: list[str], folder: Path, environment: dict[str, str]) -> None:
    """A command that serves a page prints its address, which answers, and ends when it is told to: not by Ctrl-C, which
    is ignored where the tests run in the background of a shell."""
    with subprocess.Popen(words, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert httpx.get(address).status_code == 200
        process.send_signal(signal.SIGTERM)
        assert process.wait(ENDS_WITHIN_S) == 143


@pytest.mark.parametrize(
    "page", [p for p in PAGES_WITH_COMMANDS if steps_of(p)], ids=lambda p: p.relative_to(ROOT).as_posix()
)
def test_the_commands_of_a_page_work(page, tmp_path):
    lay_out = LAID_OUT.get(name_of(page))
    if lay_out:
        lay_out(tmp_path)
    for step in steps_of(page):
        only_checked = [check for start, check in ONLY_CHECKED.items() if step.text.startswith(start)]
        if only_checked:
            only_checked[0](step.text)
            continue
        if step.text.startswith("zlocus "):
            check_zlocus(step.text)
        # Without a layout a page's files are not there: its command line alone is checked.
        if lay_out:
            run(in_small(page, step), tmp_path)
    if name_of(page) in TOLD:
        TOLD[name_of(page)](tmp_path)


def check_tutorial(folder: Path) -> None:
    """The figures that it tells are those of its surface, rounded as there; they change with the code."""
    words = ["evaluate", "surface/dsm.tif", "scene/truth_dsm.tif", "--classes", "scene/truth_class.tif", "--json"]
    done = CliRunner().invoke(app, [str(folder / word) if "/" in word else word for word in words])
    found = json.loads(done.stdout)
    told = " ".join((ROOT / "docs" / "tutorials" / "first_surface.md").read_text(encoding="utf-8").split())
    numbers = re.search(
        r"truth ([\d.]+) % lie within 1 m .*: ([\d.]+) % of the ground, ([\d.]+) % of the roofs, ([\d.]+) %", told
    )
    assert numbers
    for name, share in zip(("all", "ground", "building", "tree"), numbers.groups(), strict=True):
        assert abs(100 * found[name]["within"] - float(share)) < TOLD_TO, name
    coverage = json.loads((folder / "surface" / "run.json").read_text(encoding="utf-8"))["coverage"]
    assert f"says that {100 * coverage:.0f} % of the cells" in told
    # Another run of `zlocus dsm`, to which no products were added.
    page = (ROOT / "docs" / "tutorials" / "first_surface.md").read_text(encoding="utf-8")
    (section,) = re.findall(r"^## 3\..*?(?=^## 4\.)", page, re.DOTALL | re.MULTILINE)
    first_columns = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    named = re.findall(r"`([a-z_]+\.[a-z]+)`", " ".join(first_columns))
    styles = {style for name in named if name in OF_SURFACE for style in style_files(name)}
    assert sorted({*named, *styles}) == sorted(path.name for path in (folder / "again").iterdir())


# After the commands of a page: whether what it says of them is so.
TOLD = {"docs/tutorials/first_surface.md": check_tutorial}


def test_commands_in_sentences_exist():
    found = [(page, text) for page in PAGES for text in inline_commands(page)]
    assert len(found) > 50
    for _, text in found:
        program = text.split()[0]
        check = check_make if program == "make" else check_zlocus if program == "zlocus" else check_synthetic
        check(text)


def without_a_layout(pages: list[Path]) -> list[str]:
    """Names of pages that tell a reader to run something for which no layout has the files: nothing would be run."""
    told = [
        page.name
        for page in pages
        if name_of(page) not in LAID_OUT
        if any(not step.text.startswith(tuple(ONLY_CHECKED)) for step in steps_of(page))
    ]
    return sorted(told)


def test_every_page_with_commands_has_a_layout():
    assert without_a_layout(PAGES_WITH_COMMANDS) == []


def test_a_page_without_a_layout_is_noticed(tmp_path):
    texts = {
        "new.md": "```\nzlocus doctor a.tif b.tif\n```\n",
        "python.md": "```python\nimport zlocus\n```\n",
        "figures.md": "```\nmake acceptance\n```\n\n    python benchmarks/speed.py --help\n",
        "words.md": "```yaml\nviews: []\n```\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert without_a_layout([tmp_path / name for name in texts]) == ["new.md", "python.md"]


@pytest.mark.parametrize("name", IN_SMALL)
def test_words_that_are_replaced_are_on_the_page(name):
    texts = [step.text for step in steps_of(ROOT / name)]
    for words in IN_SMALL[name]:
        assert any(words in text for text in texts), words


def test_every_layout_has_its_page():
    """No layout is left whose page has gone, or has no commands any more."""
    laid_out = {name_of(page) for page in PAGES if steps_of(page)} & set(LAID_OUT)
    assert laid_out == set(LAID_OUT)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_usage_lines_name_all_options(page):
    """A line that shows options in brackets shows all that there are."""
    for step in steps_of(page):
        if step.text.startswith("zlocus ") and "[--" in step.text:
            command = COMMANDS[command_name(step.text.split())]
            of_all = {field.name for field in fields(OutputOptions)}  # the page on scripts tells them once
            known = {p.opts[0] for p in command.params if p.param_type_name == "option" and p.name not in of_all}
            assert options_of(step.text) >= known - {"--overwrite"}, step.text


def test_blocks_of_commands_are_found():
    """The steps of a known page are those that a reader sees there."""
    steps = [step.text for step in steps_of(ROOT / "docs" / "how-to" / "import.md")]
    assert steps[0] == "zlocus import colmap PROJECT -o scene.yaml"
    assert steps[-1] == "zlocus dsm scene.yaml -o facade"
    assert len(steps) == 9
    assert len(steps_of(ROOT / "benchmarks" / "README.md")) > 20
    assert INLINE.findall("as `zlocus dsm IN` says") == ["zlocus dsm IN"]
