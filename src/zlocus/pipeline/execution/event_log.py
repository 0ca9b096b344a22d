"""events.jsonl: what happened in a run, a line of JSON each, for programs that watch it."""

from __future__ import annotations

import json
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

NAME = "events.jsonl"


class EventLog:
    """Appends to `NAME` in a folder. A line that cannot be written is no reason to stop: the log is for watching."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME

    def remove(self) -> None:
        """Forget what happened before."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)

    def add(self, event: str, **more: Any) -> None:
        """Add an event with the time and what belongs to it."""
        record = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **more}
        with suppress(OSError), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
