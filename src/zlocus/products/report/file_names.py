"""Names of the report and of the files of a run from which it is made."""

from __future__ import annotations

from pathlib import Path

REPORT, RECORD, CURVES, FOOTPRINTS, RANKING = (
    "report.html", "run.json", "curves.json", "footprints.geojson", "ranking.gpkg",
)  # fmt: skip


def remove_report(out: Path) -> None:
    """Remove the report of an earlier run and the files that were made for it."""
    for name in (REPORT, CURVES, FOOTPRINTS):
        (out / name).unlink(missing_ok=True)
