"""The help of commands, and the completion of their names by a shell."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from zlocus.cli.app import COMMANDS, app, in_our_words, main
from zlocus.cli.help_text import EXAMPLES, MAX_WIDTH, short_help


def test_the_help_of_dsm_shows_options_in_groups_and_examples():
    shown = CliRunner().invoke(app, ["dsm", "--help"]).stdout
    lines = shown.splitlines()
    headings = [line[:-1] for line in lines if line and line[0] != " " and line.endswith(":")]
    assert headings == [
        "Arguments", "Result", "Area and grid", "Heights", "Matching", "Run", "A part of a finished run", "Messages",
        "Examples",
    ]  # fmt: skip
    matching = shown[shown.index("Matching:") : shown.index("Run:")]
    assert "--method" in matching
    assert "--set NAME=VALUE" in matching
    assert "--crs" not in matching
    assert "  zlocus dsm img_1.tif img_2.tif img_3.tif -o surface --resolution 0.5" in lines
    assert "list[Path]" not in shown


def test_no_summary_is_cut_short():
    shown = " ".join(CliRunner().invoke(app, ["--help"]).stdout.split())
    for name, _, run in COMMANDS:
        first = " ".join(inspect.cleandoc(run.__doc__ or "").split("\n\n")[0].split())
        assert short_help(run) == first
        assert f"{name} {first}" in shown


TILES = ("tiles plan", "tiles run", "tiles assemble")


def test_every_command_has_an_example():
    assert set(EXAMPLES) == {*(name for name, _, _ in COMMANDS), *TILES}


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_are_commands_with_known_options(name):
    shown = CliRunner().invoke(app, [*name.split(), "--help"]).stdout
    for line in inspect.cleandoc(EXAMPLES[name]).splitlines():
        assert line.startswith(f"zlocus {name} ")
        assert f"  {line}" in shown.splitlines()
        assert [word for word in line.split() if word.startswith("--") and word not in shown] == []


def test_no_line_of_help_is_cut_at_80_columns():
    for words in ([], ["tiles"], ["dsm"], ["paper"]):
        lines = CliRunner().invoke(app, [*words, "--help"]).stdout.splitlines()
        texts = [line for line in lines if not line.startswith(("  zlocus ", "Usage: "))]
        assert not any(line.endswith("...") for line in texts)
        assert max(map(len, texts)) <= 80


def test_the_help_is_as_wide_as_the_terminal_up_to_a_limit():
    environment = {**os.environ, "COLUMNS": "300"}
    words = [sys.executable, "-m", "zlocus", "--help"]
    lines = subprocess.run(words, capture_output=True, text=True, env=environment).stdout.splitlines()
    assert 85 < max(map(len, lines)) <= MAX_WIDTH


@pytest.mark.parametrize(
    ("name", "usage"),
    [
        ("dsm", "INPUT..."), ("paper", "FIGURE [INPUT...]"), ("tiles plan", "OUT [INPUT...]"), ("tiles run", "OUT N"),
        ("evaluate", "DSM REFERENCE..."),
    ],
)  # fmt: skip
def test_arguments_have_one_form(name, usage):
    shown = CliRunner().invoke(app, [*name.split(), "--help"]).stdout.splitlines()
    (line,) = (line for line in shown if line.startswith("Usage: "))
    assert line.endswith(f" {name} [OPTIONS] {usage}")
    assert not any("[[" in line or "{" in line for line in shown)


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [
        ("Input should be a valid integer, unable to parse string as an integer", "a whole number is needed"),
        ("Input should be a valid number, unable to parse string as a number", "a number is needed"),
        ("Input should be less than or equal to 65535", "it must be 65535 at most"),
        ("Input should be one of two", "it must be one of two"),
        ("No such option: --nope", "No such option: --nope"),
    ],
)
def test_usage_errors_are_in_our_words(theirs, ours):
    assert in_our_words(theirs) == ours


def test_a_task_that_is_no_number_is_said_in_our_words(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["tiles", "run", "out", "five", "--json"])
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert "Input should" not in said.err + said.out
    assert "a whole number is needed" in said.err
    assert "a whole number is needed" in said.out


def completed(shell: str, words: str, number: int) -> str:
    """What a shell is offered for the word with a number."""
    environment = {
        **os.environ, "_ZLOCUS_COMPLETE": f"complete_{shell}", "COMP_WORDS": words, "COMP_CWORD": str(number),
        "_TYPER_COMPLETE_ARGS": words, "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }  # fmt: skip
    done = subprocess.run([sys.executable, "-m", "zlocus"], capture_output=True, text=True, env=environment)
    return done.stdout


def test_shells_complete_commands_and_options():
    assert completed("bash", "zlocus do", 1).split() == ["doctor", "docs"]
    assert "--products" in completed("bash", "zlocus dsm --pro", 2)
    assert "doctor" in completed("zsh", "zlocus do", 1)
    assert "doctor" in completed("fish", "zlocus do", 1)


@pytest.mark.parametrize("name", ["dsm", "doctor", "tiles plan"])
def test_the_help_names_every_kind_of_input(name):
    text = " ".join(CliRunner().invoke(app, [*name.split(), "--help"]).stdout.replace("│", " ").split())
    assert "Images with RPC, folders or archives of deliveries, or one scene.yaml." in text
