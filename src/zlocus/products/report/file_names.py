"""Names of the report, and of the files of a run that it is made of."""

from __future__ import annotations

from pathlib import Path

REPORT, RECORD, CURVES, FOOTPRINTS, RANKING = (
    "report.html", "run.json", "curves.json", "footprints.geojson", "ranking.gpkg",
)  # fmt: skip


def forget_report(out: Path) -> None:
    """Remove the report of an earlier run, which is not this one's."""
    for name in (REPORT, CURVES, FOOTPRINTS):
        (out / name).unlink(missing_ok=True)
