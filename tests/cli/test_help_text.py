"""The help of commands, and the completion of their names by a shell."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from zlocus.cli.app import COMMANDS, app
from zlocus.cli.help_text import EXAMPLES, short_help


def test_the_help_of_dsm_shows_options_in_groups_and_examples():
    shown = CliRunner().invoke(app, ["dsm", "--help"]).stdout
    lines = shown.splitlines()
    headings = [line[:-1] for line in lines if line and line[0] != " " and line.endswith(":")]
    assert headings == [
        "Arguments", "Result", "Area and grid", "Heights", "Matching", "Run", "Messages", "Examples",
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


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_are_commands_with_known_options(name):
    known = CliRunner().invoke(app, [name, "--help"]).stdout
    for line in inspect.cleandoc(EXAMPLES[name]).splitlines():
        program, command, *words = line.split()
        assert (program, command) == ("zlocus", name)
        assert [word for word in words if word.startswith("-") and word not in known] == []


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
