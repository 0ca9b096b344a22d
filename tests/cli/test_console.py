"""What every command says: quietly or verbosely, as text or as one JSON object, and into a log file."""

from __future__ import annotations

import json
import logging
import re
import signal
import subprocess
import sys
import warnings

import pytest
from typer.testing import CliRunner

import zlocus
from zlocus.cli import exit_status
from zlocus.cli.answer import Answer
from zlocus.cli.app import COMMANDS, app
from zlocus.cli.commands import command_of
from zlocus.cli.config import ConfigOptions
from zlocus.cli.console import Console, OutputOptions
from zlocus.cli.exit_status import show_our_warnings
from zlocus.core.errors import CoverageError, ZlocusNote, ZlocusWarning
from zlocus.core.signals import Ended
from zlocus.io.run_record import Stopwatch

# A line of a log: time with its zone, and what was said.
LOG_LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d{4} ")


def test_every_command_has_the_options_of_output():
    for name, _, _ in COMMANDS:
        shown = CliRunner().invoke(app, [name, "--help"]).stdout
        assert [option for option in ("--quiet", "--verbose", "--log FILE", "--json") if option not in shown] == []


@pytest.fixture
def said(tmp_path):
    """Run a command that says a bit of everything: its exit status, standard output and standard error."""
    import typer

    def run(*arguments: object, answer: Answer | None = None, error: BaseException | None = None):
        def speak(options, console):
            """Speak."""
            with Stopwatch().stage("work"), console.progress.stage("Working"):
                console.progress.note("Half of it is done.")
            warnings.warn("mind this.", ZlocusWarning, stacklevel=1)
            warnings.warn("and this, which harms nothing.", ZlocusNote, stacklevel=1)
            if error is not None:
                raise error
            return answer or Answer("All is done.", {"coverage": 0.5})

        speaking = typer.Typer()
        speaking.command()(command_of("speak", ConfigOptions, speak))
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            show_our_warnings()
            return CliRunner().invoke(speaking, [str(each) for each in arguments])

    return run


def test_text_goes_to_standard_output_and_progress_to_standard_error(said):
    result = said()
    assert (result.exit_code, result.stdout) == (0, "All is done.\n")
    assert result.stderr.splitlines()[0] == "Half of it is done."
    assert "Working: done in" in result.stderr
    assert "zlocus: mind this." in result.stderr
    assert "zlocus: and this, which harms nothing." in result.stderr
    assert "Stage work" not in result.stderr


def test_quiet_leaves_warnings_errors_and_tables(said):
    assert said("--quiet").stdout == ""
    assert said("-q").stderr == "zlocus: mind this.\n"
    assert said("--quiet", answer=Answer("a table", is_asked_for=True)).stdout == "a table\n"
    failed = said("--quiet", error=CoverageError("too little. Give more."))
    assert (failed.exit_code, failed.stderr) == (3, "zlocus: mind this.\nzlocus: too little. Give more.\n")


def test_verbose_adds_versions_details_and_traces(said):
    result = said("-v")
    assert f"zlocus {zlocus.__version__}: " in result.stderr
    assert "Python 3." in result.stderr
    assert "Stage work: " in result.stderr
    assert result.stderr.count("Half of it is done.") == 1
    assert "Traceback" in said("-v", error=CoverageError("too little.")).stderr
    assert "Traceback" not in said(error=CoverageError("too little.")).stderr


def test_a_signal_has_no_trace(said, monkeypatch):
    # The children of this process, which are not those of a command, have to live on.
    monkeypatch.setattr(exit_status, "end_children", lambda: None)
    result = said("-v", error=Ended(signal.SIGTERM))
    assert result.exit_code == 143
    assert "Traceback" not in result.stderr


def test_json_keeps_notes_and_warnings_of_commands_that_give_them(said):
    kept = []
    console = Console("speak", OutputOptions(as_json=True))
    try:
        console.progress.note("Half of it is done.")
        logging.getLogger("zlocus").warning("zlocus: %s", "mind this.")
        kept = list(console.notes)
    finally:
        console.close()
    logging.getLogger("zlocus").warning("zlocus: %s", "too late.")
    assert kept == console.notes == ["Half of it is done.", "mind this."]


def test_quiet_and_verbose_exclude_each_other(said):
    result = said("-q", "-v")
    assert result.exit_code == 2
    assert result.stderr.startswith("zlocus: --quiet and --verbose exclude each other.")


def test_json_is_one_object_on_standard_output(said):
    result = said("--json")
    assert json.loads(result.stdout) == {
        "command": "speak", "version": zlocus.__version__, "exit_status": 0, "coverage": 0.5
    }  # fmt: skip
    assert "Half of it is done." in result.stderr


def test_json_holds_the_error_and_the_folder(said, tmp_path):
    result = said("--json", "-o", tmp_path / "out", error=CoverageError("too little. Give more."))
    assert result.exit_code == 3
    assert json.loads(result.stdout) == {
        "command": "speak", "version": zlocus.__version__, "exit_status": 3, "out": str(tmp_path / "out"),
        "error": "too little. Give more.",
    }  # fmt: skip
    answered = said("--json", answer=Answer("bad", {"verdict": "fails"}, exit_status=2))
    assert (answered.exit_code, json.loads(answered.stdout)["exit_status"]) == (2, 2)


@pytest.mark.parametrize("arguments", [["dsm", "--json"], ["dsm", "a.tif", "--json", "--resolution", "x", "-o", "o"]])
def test_json_holds_errors_of_usage_too(arguments, tmp_path):
    """As a program sees it, from the process itself."""
    done = subprocess.run(
        [sys.executable, "-m", "zlocus", *arguments], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 2
    record = json.loads(done.stdout)
    assert (record["command"], record["exit_status"]) == ("dsm", 2)
    assert record["error"]
    assert "Usage: zlocus dsm" in done.stderr


def test_a_log_keeps_everything_and_grows(said, tmp_path):
    log = tmp_path / "run.log"
    said("--log", log, "--quiet")
    first = log.read_text()
    lines = first.splitlines()
    assert all(LOG_LINE.match(line) for line in lines)
    told = [LOG_LINE.sub("", line) for line in lines]
    for part in (
        "Python 3.",
        "Half of it is done.",
        "Working: done in",
        "Stage work: ",
        "zlocus: mind this.",
        "All is",
    ):
        assert sum(part in line for line in told) == 1, part
    said("--log", log, error=CoverageError("too little."))
    assert log.read_text().startswith(first)
    assert "zlocus: too little." in log.read_text()
    assert "Traceback" in log.read_text()


def test_a_log_that_cannot_be_written_stops_the_command_first(said, tmp_path):
    result = said("--log", tmp_path / "none" / "run.log", "--json")
    assert result.exit_code == 2
    assert "cannot be written" in json.loads(result.stdout)["error"]
    assert "Half of it is done." not in result.stderr
