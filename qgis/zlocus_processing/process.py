"""Runs a command as a process, which is shown, can be stopped, and answers in JSON. Nothing here is of QGIS."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import threading
import time
from typing import Any, Mapping, Sequence

from .progress import PREFIX, CommandProgress

# Seconds between two looks at whether the command is to be stopped, and what it has to tidy up before it is killed.
POLL_S, TIDYING_S = 0.2, 30.0


class Watcher:
    """Takes what a command says. Subclasses show it."""

    def is_canceled(self) -> bool:
        """Whether the command is to be stopped."""
        return False

    def say(self, line: str) -> None:
        """Show a line of the command."""

    def warn(self, line: str) -> None:
        """Show a warning of the command."""

    def set_percent(self, percent: float) -> None:
        """Show how much is done, 0 to 100."""


class Ended:
    """How a command ended. status : of its exit; answer : what it printed as JSON; error : its sentence, "" where all
    is well; was_stopped : whether it was asked to stop."""

    def __init__(self, status: int, answer: dict[str, Any], error: str, was_stopped: bool) -> None:
        self.status, self.answer, self.error, self.was_stopped = status, answer, error, was_stopped


def run_command(
    words: Sequence[str], environment: Mapping[str, str], watcher: Watcher, progress: CommandProgress
) -> Ended:
    """Run a command to its end, or until the watcher asks to stop it. It gets SIGTERM, and time to keep what it has."""
    try:
        process = subprocess.Popen(
            list(words), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env=dict(environment), encoding="utf-8", errors="replace", **_without_window(),
        )  # fmt: skip
    except OSError as error:
        return Ended(-1, {}, f"{words[0]} cannot be run: {error.strerror}. Correct its path in the settings.", False)
    lines: queue.Queue[str | None] = queue.Queue()
    printed: list[str] = []
    readers = [
        threading.Thread(target=_read_lines, args=(process.stderr, lines), daemon=True),
        threading.Thread(target=lambda: printed.append(process.stdout.read()), daemon=True),
    ]
    for reader in readers:
        reader.start()
    said, was_stopped = _watch(process, lines, watcher, progress)
    status = process.wait()
    for reader in readers:
        reader.join()
    for stream in (process.stdout, process.stderr):
        stream.close()
    answer = _object_in("".join(printed))
    error = str(answer.get("error") or "")
    if status and not error:
        error = said or f"The command {words[0]} ended with status {status}, and said nothing."
    if said and said != error and said != PREFIX + error:
        watcher.warn(said)
    return Ended(status, answer, error.replace(PREFIX, "", 1) if error.startswith(PREFIX) else error, was_stopped)


def _watch(
    process: subprocess.Popen[str], lines: queue.Queue[str | None], watcher: Watcher, progress: CommandProgress
) -> tuple[str, bool]:
    """Show what a process says until it ends. The result: its last line where that is a warning or an error, which is
    not shown yet, and whether it was stopped."""
    kept, stopped_s, is_open = "", None, True
    while is_open:
        try:
            line = lines.get(timeout=POLL_S)
            is_open = line is not None
        except queue.Empty:
            line = None
        if line:
            if kept:
                watcher.warn(kept)
            kept = line if line.startswith(PREFIX) else ""
            if not kept:
                watcher.say(line)
            progress.read_line(line)
        progress.read_events()
        watcher.set_percent(progress.percent)
        if stopped_s is None and watcher.is_canceled():
            stopped_s = time.monotonic()
            process.terminate()
        if stopped_s is not None and time.monotonic() - stopped_s > TIDYING_S and process.poll() is None:
            process.kill()
    return kept, stopped_s is not None


def _read_lines(stream: Any, lines: queue.Queue[str | None]) -> None:
    for line in stream:
        lines.put(line.rstrip())
    lines.put(None)


def _object_in(text: str) -> dict[str, Any]:
    """The object that a command printed; empty where it printed none."""
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _without_window() -> dict[str, Any]:
    """On Windows, no console appears."""
    return {"creationflags": subprocess.CREATE_NO_WINDOW} if os.name == "nt" else {}
