"""What a command found, for people and for programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class CommandOutcome:
    """What a command found and wrote. text : for people; values : the same for programs."""

    text: str
    values: Mapping[str, Any]
