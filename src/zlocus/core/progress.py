"""Progress of a run: bars with the remaining time on a terminal, plain lines elsewhere, or nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress as RichBars
    from rich.progress import TaskID

LINE_INTERVAL_S = 10.0


class Stage(Protocol):
    """A part of a run whose progress is counted in steps."""

    def advance(self, n: float = 1) -> None:
        """Count n more steps as done."""
        ...

    def tell(self, text: str) -> None:
        """Show a text beside the steps from now on, such as the memory in use."""
        ...


class Progress(Protocol):
    """Receiver of the progress of a run.

    >>> with progress.stage("Matching", total=len(tiles)) as stage:
    ...     stage.advance()
    """

    def stage(self, name: str, total: float | None = None) -> AbstractContextManager[Stage]:
        """A stage of `total` steps (None: unknown), which ends with the block."""
        ...

    def note(self, sentence: str) -> None:
        """Print a sentence for the user, such as the corrections that were applied."""
        ...


class SilentProgress:
    """Shows nothing."""

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Stage]:
        """See `Progress`."""
        yield _SilentStage()

    def note(self, sentence: str) -> None:
        """See `Progress`."""


@dataclass
class KeptNotes(SilentProgress):
    """Keeps the sentences for the user in a list, and shows nothing."""

    sentences: list[str] = field(default_factory=list)

    def note(self, sentence: str) -> None:
        """See `Progress`."""
        self.sentences.append(sentence)


class _SilentStage:
    def advance(self, n: float = 1) -> None:
        pass

    def tell(self, text: str) -> None:
        pass


@dataclass
class ManifoldProgress:
    """Shows the same in several ways, such as on a terminal and in a log."""

    progresses: tuple[Progress, ...]

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Stage]:
        """See `Progress`."""
        with ExitStack() as stack:
            yield _ManifoldStage(tuple(stack.enter_context(each.stage(name, total)) for each in self.progresses))

    def note(self, sentence: str) -> None:
        """See `Progress`."""
        for each in self.progresses:
            each.note(sentence)


@dataclass
class _ManifoldStage:
    stages: tuple[Stage, ...]

    def advance(self, n: float = 1) -> None:
        for each in self.stages:
            each.advance(n)

    def tell(self, text: str) -> None:
        for each in self.stages:
            each.tell(text)


@dataclass
class LineProgress:
    """Prints one line when a stage ends, and one every ten seconds of a long stage: for logs."""

    stream: TextIO

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Stage]:
        """See `Progress`."""
        start = time.monotonic()
        yield _LineStage(self, name, total, start, start)
        self.note(f"{name}: done in {duration(time.monotonic() - start)}")

    def note(self, sentence: str) -> None:
        """See `Progress`."""
        print(sentence, file=self.stream, flush=True)


@dataclass
class _LineStage:
    progress: LineProgress
    name: str
    total: float | None
    start: float
    last_line: float
    done: float = 0.0
    told: str = ""

    def tell(self, text: str) -> None:
        self.told = text

    def advance(self, n: float = 1) -> None:
        self.done += n
        now = time.monotonic()
        if not self.total or not 0 < self.done < self.total or now - self.last_line < LINE_INTERVAL_S:
            return
        self.last_line = now
        left = (now - self.start) * (self.total - self.done) / self.done
        told = f", {self.told}" if self.told else ""
        steps = f"{self.done:.0f} of {self.total:.0f}, {100 * self.done / self.total:.0f} %"
        self.progress.note(f"{self.name}: {steps}, time left {duration(left)}{told}")


@dataclass
class BarProgress:
    """Shows a bar with the remaining time for each stage; stages may be nested."""

    _bars: RichBars | None = field(default=None, init=False)
    _depth: int = field(default=0, init=False)

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Stage]:
        """See `Progress`."""
        bars = self._bars or _new_bars()
        if self._depth == 0:
            self._bars = bars
            bars.start()
        self._depth += 1
        # A stage of one step would stand at nothing until its end: its bar moves to and fro instead.
        task = bars.add_task(name, total=None if total == 1 else total, told="")
        try:
            yield _BarStage(bars, task)
            done = total if total is not None else 1
            bars.update(task, total=done, completed=done)
        finally:
            self._depth -= 1
            if self._depth == 0:
                bars.stop()
                self._bars = None

    def note(self, sentence: str) -> None:
        """See `Progress`."""
        if self._bars is not None:
            self._bars.console.print(sentence, markup=False, highlight=False)
        else:
            print(sentence, file=sys.stderr)


@dataclass
class _BarStage:
    bars: RichBars
    task: TaskID

    def tell(self, text: str) -> None:
        self.bars.update(self.task, told=text)

    def advance(self, n: float = 1) -> None:
        self.bars.advance(self.task, n)


def _new_bars() -> RichBars:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as RichBars

    columns = (
        TextColumn("{task.description:<14}"), BarColumn(), TaskProgressColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TextColumn("time left"), TimeRemainingColumn(), TextColumn("{task.fields[told]}"),
    )  # fmt: skip
    return RichBars(*columns, console=Console(stderr=True))


def duration(seconds: float) -> str:
    """A duration as people write it: 4.2 s, 3 min 5 s, 2 h 10 min."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def progress_for(stream: TextIO) -> Progress:
    """The progress for a stream: bars where it is a terminal, lines elsewhere."""
    return BarProgress() if stream.isatty() else LineProgress(stream)
