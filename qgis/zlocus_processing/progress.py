"""The progress of a command, from its lines and from the event log of a run. Nothing here is of QGIS."""

from __future__ import annotations

import json
import os
import re

# Stages of the commands, by what their lines begin with, and the percent at which each of them begins and ends.
STAGES = {
    "Opening images": (0.0, 3.0), "Tie points": (3.0, 15.0), "Matching": (15.0, 85.0), "Writing": (85.0, 90.0),
    "Match curves": (90.0, 92.0), "Products": (92.0, 97.0), "Report": (97.0, 99.0),
}  # fmt: skip
# Of other commands: a stage fills all of it.
WHOLE = (0.0, 99.0)
DONE = re.compile(r"^(?P<stage>[^:]+): done in ")
STEPS = re.compile(r"^(?P<stage>[^:]+): (?P<done>\d+) of (?P<total>\d+), ")
# Lines of warnings and errors.
PREFIX = "zlocus: "


class CommandProgress:
    """How much of a command is done. It never goes back.

    percent : 0 to 100. stages : those that the command has; a stage that is not among them says nothing.
    """

    def __init__(self, out: str = "", is_surface: bool = True) -> None:
        """out : folder of a run, whose event log tells of tiles; is_surface : whether a surface is made."""
        self.percent = 0.0
        self._is_surface = is_surface
        self._events = TileEvents(os.path.join(out, "events.jsonl")) if out and is_surface else None

    def read_line(self, line: str) -> None:
        """Take a line that the command printed."""
        done, steps = DONE.match(line), STEPS.match(line)
        if done:
            self._reach(done.group("stage"), 1.0)
        elif steps and int(steps.group("total")):
            self._reach(steps.group("stage"), int(steps.group("done")) / int(steps.group("total")))

    def read_events(self) -> None:
        """Look for tiles that were finished since."""
        share = self._events.share() if self._events is not None else None
        if share is not None:
            self._reach("Matching", share)

    def _reach(self, stage: str, share: float) -> None:
        ends = STAGES.get(stage) if self._is_surface else WHOLE
        if ends is not None:
            low, high = ends
            self.percent = max(self.percent, low + min(share, 1.0) * (high - low))


class TileEvents:
    """The tiles in the event log of a run, from the events that were added since this object was made."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._offset = _size(path)
        self._rest = b""
        self._n_tiles, self._n_done = 0, 0

    def share(self) -> float | None:
        """Share of the tiles that are done, 0 to 1; None before the first is begun."""
        for line in self._new_lines():
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if not isinstance(event, dict):
                continue
            if event.get("event") == "began":
                self._n_tiles, self._n_done = int(event.get("n_tiles", 0)), int(event.get("tiles_there", 0))
            elif event.get("event") == "tile":
                self._n_done += 1
        return min(self._n_done / self._n_tiles, 1.0) if self._n_tiles else None

    def _new_lines(self) -> list[bytes]:
        size = _size(self._path)
        if size < self._offset:  # another run began a new log
            self._offset, self._rest = 0, b""
        if size == self._offset:
            return []
        try:
            with open(self._path, "rb") as file:
                file.seek(self._offset)
                added = file.read(size - self._offset)
        except OSError:
            return []
        self._offset += len(added)
        *lines, self._rest = (self._rest + added).split(b"\n")
        return lines


def _size(path: str) -> int:
    try:
        return os.path.getsize(path)
    except OSError:
        return 0
