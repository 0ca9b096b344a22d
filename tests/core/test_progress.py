"""What a run reports: lines in a log, bars on a terminal, nothing where nobody looks."""

from __future__ import annotations

import io

import pytest

from zlocus.core import progress as progress_module
from zlocus.core.progress import BarProgress, LineProgress, SilentProgress, progress_for


class Clock:
    """A clock that is set by hand."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    """The clock the reports go by."""
    hand = Clock()
    monkeypatch.setattr(progress_module, "time", hand)
    return hand


def run(progress, clock, steps: int = 4, seconds: float = 6.0) -> None:
    """A stage of equal steps."""
    with progress.stage("Matching", total=steps) as stage:
        for _ in range(steps):
            clock.now += seconds
            stage.advance()


def test_lines_tell_the_share_done_and_the_time_left(clock):
    log = io.StringIO()
    run(LineProgress(log), clock, steps=5, seconds=30)
    assert log.getvalue().splitlines() == [
        "Matching: 1 of 5, 20 %, time left 2 min 0 s",
        "Matching: 2 of 5, 40 %, time left 1 min 30 s",
        "Matching: 3 of 5, 60 %, time left 1 min 0 s",
        "Matching: 4 of 5, 80 %, time left 30.0 s",
        "Matching: done in 2 min 30 s",
    ]


def test_what_is_told_stands_beside_the_steps(clock):
    log = io.StringIO()
    with LineProgress(log).stage("Matching", total=2) as stage:
        stage.tell("1.5 GB")
        clock.now += 20
        stage.advance()
    assert log.getvalue().splitlines()[0] == "Matching: 1 of 2, 50 %, time left 20.0 s, 1.5 GB"


def test_lines_are_at_least_ten_seconds_apart(clock):
    log = io.StringIO()
    run(LineProgress(log), clock, steps=100, seconds=0.3)
    assert len(log.getvalue().splitlines()) == 3


def test_a_stage_that_fails_is_not_reported_as_done(clock):
    log = io.StringIO()
    with pytest.raises(ValueError, match="planted"), LineProgress(log).stage("Ties"):
        raise ValueError("planted")
    assert log.getvalue() == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (59.9, "59.9 s"),
        (59.96, "1 min 0 s"),
        (3599.4, "59 min 59 s"),
        (3600, "1 h 0 min"),
        (7860, "2 h 11 min"),
    ],
)
def test_durations(seconds, text):
    assert progress_module.duration(seconds) == text


def test_bars_count_nest_and_end(monkeypatch, clock):
    shown = []
    new_bars = progress_module._new_bars

    def quiet_bars():
        bars = new_bars()
        bars.console.file = io.StringIO()
        shown.append(bars)
        return bars

    monkeypatch.setattr(progress_module, "_new_bars", quiet_bars)
    progress = BarProgress()
    with progress.stage("Matching", total=3) as stage:
        stage.advance(2)
        progress.note("[shift] applied")
        with progress.stage("Level"):
            pass
    run(progress, clock)
    first, second = shown
    assert [(task.completed, task.total) for task in first.tasks] == [(3, 3), (1, 1)]
    assert [(task.completed, task.total) for task in second.tasks] == [(4, 4)]
    assert "[shift] applied" in first.console.file.getvalue()
    assert not first.live.is_started


def test_silence(clock, capfd):
    run(SilentProgress(), clock)
    SilentProgress().note("nothing")
    assert capfd.readouterr() == ("", "")


def test_bars_are_for_terminals_only():
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    assert isinstance(progress_for(Terminal()), BarProgress)
    assert isinstance(progress_for(io.StringIO()), LineProgress)


def test_a_stage_of_one_step_shows_that_something_is_done():
    """Its bar would stand at 0 until the end, so it has none that fills."""
    progress = BarProgress()
    with progress.stage("Matching", 1):
        assert progress._bars.tasks[0].total is None
    with progress.stage("Matching", 2) as stage:
        stage.advance()
        assert progress._bars.tasks[0].percentage == 50.0
