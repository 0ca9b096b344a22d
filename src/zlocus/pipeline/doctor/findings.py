"""What the doctor found, in sentences, and how bad it is."""

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
    """level : `STOPS` a run; makes a `POOR` surface; or worth a `NOTE`. about : views concerned, or none."""

    level: str
    sentence: str
    about: tuple[str, ...] = ()


def poor(name: str, sentence: str) -> Finding:
    """What makes one view poor."""
    return Finding(POOR, f"{name}: {sentence}", (name,))


def worst(findings: Iterable[Finding]) -> str:
    """The worst level of all findings, `NOTE` without any."""
    levels = {finding.level for finding in findings}
    return next((level for level in (STOPS, POOR) if level in levels), NOTE)
