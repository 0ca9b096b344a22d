"""events.jsonl: the events of a run as lines of JSON, for programs that watch it."""

from __future__ import annotations

import json
import logging
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

NAME = "events.jsonl"
LOGGER = logging.getLogger(__name__)


class EventLog:
    """Appends events to `NAME` in a folder. A line that cannot be written is skipped, because the log only informs."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME

    def remove(self) -> None:
        """Remove the log of an earlier run."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)

    def add(self, event: str, **more: Any) -> None:
        """Add an event with the time and some details."""
        record = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **more}
        LOGGER.debug("Event %s: %s", event, ", ".join(f"{name} {value}" for name, value in more.items()))
        with suppress(OSError), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
