"""Findings of the doctor: sentences, each with a level of severity."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

STOPS, POOR, NOTE = "stops", "poor", "note"
VERDICTS = {
    STOPS: "A run will fail. What stops it stands above.",
    POOR: "A run will work, but its surface may be poor: see above.",
    NOTE: "Nothing speaks against a run.",
}


@dataclass(frozen=True)
class Finding:
    """One finding. level : `STOPS` a run, makes a `POOR` surface, or is a `NOTE`; about : names of its views."""

    level: str
    sentence: str
    about: tuple[str, ...] = ()


def poor(name: str, sentence: str) -> Finding:
    """A finding that one view will make a poor surface."""
    return Finding(POOR, f"{name}: {sentence}", (name,))


def worst(findings: Iterable[Finding]) -> str:
    """The most severe level of all findings; `NOTE` where there are none."""
    levels = {finding.level for finding in findings}
    return next((level for level in (STOPS, POOR) if level in levels), NOTE)
