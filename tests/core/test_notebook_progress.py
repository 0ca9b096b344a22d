"""What a notebook shows of a run, and that nothing is shown in a script."""

from __future__ import annotations

import io
import subprocess
import sys
from types import SimpleNamespace

import pytest

from zlocus.core import notebook_progress
from zlocus.core.errors import ConfigError
from zlocus.core.notebook_progress import NotebookProgress, progress_of, usual_progress
from zlocus.core.progress import BarProgress, LineProgress, SilentProgress


@pytest.fixture
def displayed(monkeypatch):
    """What IPython is asked to display: (whether it is new, text, HTML)."""
    calls = []

    def show(is_new):
        def call(content, raw, **more):
            assert raw
            calls.append((is_new, content["text/plain"], content["text/html"]))
            return SimpleNamespace(update=show(False)) if more else None

        return call

    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=show(True)))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(display=sys.modules["IPython.display"]))
    monkeypatch.setattr(notebook_progress, "UPDATE_INTERVAL_S", 0.0)
    return calls


def test_lines_are_updated_in_place(displayed):
    progress = NotebookProgress()
    with progress.stage("Matching", 4) as stage:
        stage.advance(1)
        stage.tell("1.5 GB")
        progress.note("Two images <are> excluded.")
    news, texts, pages = zip(*displayed, strict=True)
    assert news == (True, False, False, False, False)
    assert texts[0] == "Matching: 0 %"
    assert texts[1].startswith("Matching: 25 %, time left ")
    assert texts[2].endswith(", 1.5 GB")
    assert texts[3].splitlines()[1] == "Two images <are> excluded."
    assert texts[4].splitlines()[0].startswith("Matching: done in ")
    assert '<progress value="0.250"></progress>' in pages[1]
    assert "&lt;are&gt;" in pages[3]
    assert "<progress" not in pages[4]


def test_a_stage_that_fails_is_said_to_have_stopped(displayed):
    progress = NotebookProgress()
    with pytest.raises(ValueError, match="no"), progress.stage("Opening images"):
        raise ValueError("no")
    assert displayed[0][1] == "Opening images ..."
    assert displayed[-1][1].startswith("Opening images: stopped after ")


def test_updates_are_some_time_apart(displayed, monkeypatch):
    monkeypatch.setattr(notebook_progress, "UPDATE_INTERVAL_S", 3600.0)
    with NotebookProgress().stage("Matching", 1000) as stage:
        for _ in range(1000):
            stage.advance()
    assert len(displayed) == 2


def in_shell(monkeypatch, shell) -> None:
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))


def test_a_notebook_shows_progress_and_a_script_none(monkeypatch):
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    assert isinstance(usual_progress(), SilentProgress)
    in_shell(monkeypatch, None)
    assert isinstance(usual_progress(), SilentProgress)
    in_shell(monkeypatch, SimpleNamespace(kernel=object()))
    assert isinstance(usual_progress(), NotebookProgress)
    assert isinstance(progress_of(True), NotebookProgress)
    assert isinstance(progress_of(False), SilentProgress)
    in_shell(monkeypatch, SimpleNamespace())
    assert isinstance(usual_progress(), SilentProgress)
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    assert isinstance(usual_progress(), BarProgress)


def test_progress_that_is_asked_for(monkeypatch):
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    assert isinstance(progress_of(None), SilentProgress)
    assert isinstance(progress_of(True), LineProgress)
    own = SilentProgress()
    assert progress_of(own) is own
    with pytest.raises(ConfigError, match=r"^progress is a str \('yes'\)\. Give True, False, or a progress"):
        progress_of("yes")


def test_a_script_does_not_import_ipython():
    code = "import sys; from zlocus.core.notebook_progress import progress_of; progress_of(None); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "IPython" not in done.stdout.split()


def test_a_kernel_displays_it():
    """In a real kernel: one display, which is updated, and nothing on stderr."""
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed: no notebook is run")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed: no notebook is run")
    source = """
from zlocus.core.notebook_progress import progress_of
with progress_of(None).stage("Matching", 2) as stage:
    stage.advance(2)
"""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    (output,) = notebook.cells[0].outputs
    assert output.data["text/plain"].startswith("Matching: done in ")
    assert "Matching: done in" in output.data["text/html"]
