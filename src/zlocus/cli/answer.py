"""What a command answers, for people and for programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Answer:
    """The end of a command.

    text : for people; values : the same for programs, which --json prints; is_asked_for : whether the text is what the
    command is for, such as a table, so that --quiet prints it too; exit_status : 0 where all is well.
    """

    text: str
    values: Mapping[str, Any] = field(default_factory=dict)
    is_asked_for: bool = False
    exit_status: int = 0
