"""Progress of a run in a notebook: lines of text that are updated in place, with a bar for each running stage."""

from __future__ import annotations

import html
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from zlocus.core.argument_checks import kind_of
from zlocus.core.errors import ConfigError
from zlocus.core.progress import Progress, SilentProgress, duration, progress_for

# rich draws in notebooks through ipywidgets, which many do not have. IPython itself can replace what it has displayed.
UPDATE_INTERVAL_S = 0.25


@dataclass
class NotebookProgress:
    """Shows the stages of a run below a notebook's cell: what is done, how much is left, and what there is to note."""

    _rows: list[str | _NotebookStage] = field(default_factory=list, init=False)
    _handle: Any = field(default=None, init=False)
    _shown_at: float = field(default=0.0, init=False)

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[_NotebookStage]:
        """See `Progress`."""
        stage = _NotebookStage(self, name, total, time.monotonic())
        self._rows.append(stage)
        self.show()
        try:
            yield stage
            stage.end = "done in"
        finally:
            stage.end = stage.end or "stopped after"
            stage.ended_at = time.monotonic()
            self.show()

    def note(self, sentence: str) -> None:
        """See `Progress`."""
        self._rows.append(sentence)
        self.show()

    def show(self) -> None:
        """Display all lines, in place of those that are there."""
        self._shown_at = time.monotonic()
        content = {"text/plain": self.text(), "text/html": self.html()}
        if self._handle is not None:
            self._handle.update(content, raw=True)
            return
        from IPython.display import display

        self._handle = display(content, raw=True, display_id=True)  # type: ignore[no-untyped-call]

    def show_soon(self) -> None:
        """Display all lines, unless they were displayed a moment ago."""
        if time.monotonic() - self._shown_at >= UPDATE_INTERVAL_S:
            self.show()

    def text(self) -> str:
        """All lines as plain text."""
        return "\n".join(map(str, self._rows))

    def html(self) -> str:
        """All lines as HTML, with a bar for each running stage whose length is known."""
        rows = (f"<div>{html.escape(str(row))}{row.bar() if isinstance(row, _NotebookStage) else ''}</div>" for row in
                self._rows)  # fmt: skip
        return f'<div style="max-width: 60em; font-size: 90%">{"".join(rows)}</div>'


@dataclass
class _NotebookStage:
    progress: NotebookProgress
    name: str
    total: float | None
    start: float
    done: float = 0.0
    told: str = ""
    end: str = ""
    ended_at: float = 0.0

    def tell(self, text: str) -> None:
        self.told = text
        self.progress.show_soon()

    def advance(self, n: float = 1) -> None:
        self.done += n
        self.progress.show_soon()

    def bar(self) -> str:
        if self.end or not self.total:
            return ""
        return f' <progress value="{min(self.done / self.total, 1.0):.3f}"></progress>'

    def __str__(self) -> str:
        if self.end:
            return f"{self.name}: {self.end} {duration(self.ended_at - self.start)}"
        if not self.total:
            return f"{self.name} ..."
        share = min(self.done / self.total, 1.0)
        spent = time.monotonic() - self.start
        left = f", time left {duration(spent * (1 - share) / share)}" if 0 < share < 1 else ""
        told = f", {self.told}" if self.told else ""
        return f"{self.name}: {100 * share:.0f} %{left}{told}"


def usual_progress() -> Progress:
    """The progress of a caller who asks for none: a display in a notebook, bars at IPython's prompt, else nothing."""
    shell = _interactive_shell()
    if shell is None:
        return SilentProgress()
    if hasattr(shell, "kernel"):
        return NotebookProgress()
    return progress_for(sys.stderr) if sys.stderr.isatty() else SilentProgress()


def progress_of(progress: Progress | bool | None) -> Progress:
    """The progress that a caller of the Python interface asks for.

    progress : None is `usual_progress`, True shows lines or bars also in a script, False shows nothing.

    Raises
    ------
    ConfigError
        It is none of these, and no progress.
    """
    if progress is None:
        return usual_progress()
    if progress is True:
        usual = usual_progress()
        return progress_for(sys.stderr) if isinstance(usual, SilentProgress) else usual
    if progress is False:
        return SilentProgress()
    if not (callable(getattr(progress, "stage", None)) and callable(getattr(progress, "note", None))):
        raise ConfigError(
            f"progress is {kind_of(progress)}. Give True, False, or a progress such as zlocus.LineProgress(sys.stderr)."
        )
    return progress


def _interactive_shell() -> Any:
    """IPython's shell, where this process is one of IPython; else None. IPython is not imported for it."""
    ipython = sys.modules.get("IPython")
    return None if ipython is None else ipython.get_ipython()
