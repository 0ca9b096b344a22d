"""events.jsonl: the events of a run as lines of JSON, for programs that watch it."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zlocus.core.requests import EVENTS

MIN_WITHOUT_DECIMALS = 1e5
LOGGER = logging.getLogger(__name__)


class EventLog:
    """Appends events to a file in a folder. A line that cannot be written is skipped, because the log only informs."""

    def __init__(self, folder: Path, name: str = EVENTS) -> None:
        self.path = folder / name

    def remove(self) -> None:
        """Remove the log of an earlier run."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)

    def add(self, event: str, **more: Any) -> None:
        """Add an event with the time and some details."""
        record = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **more}
        LOGGER.debug("Event %s: %s", event, ", ".join(f"{name} {_short(value)}" for name, value in more.items()))
        with suppress(OSError), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")

    def take_over(self, logs: Iterable[Path]) -> list[dict[str, Any]]:
        """Add the events of other logs that are not in this one yet, sort all by their time, and return them.

        Lines that are damaged are left out.
        """
        events: dict[str, dict[str, Any]] = {}
        for path in (self.path, *logs):
            with suppress(OSError):
                for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
                    with suppress(ValueError):
                        event = json.loads(line)
                        if isinstance(event, dict) and isinstance(event.get("time"), str):
                            events[line] = event
        lines = sorted(events, key=lambda line: str(events[line]["time"]))
        with suppress(OSError):
            self.path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
        return [events[line] for line in lines]


def _short(value: Any) -> Any:
    """A value for people: large numbers, such as those of bytes, without decimals, others with three."""
    if not isinstance(value, float):
        return value
    return round(value) if abs(value) >= MIN_WITHOUT_DECIMALS else round(value, 3)
