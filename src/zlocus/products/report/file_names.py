"""Names of the report and of the files of a run from which it is made."""

from __future__ import annotations

from pathlib import Path

from zlocus.io.atomic_write import remove_earlier

REPORT, RECORD, CURVES, FOOTPRINTS, RANKING = (
    "report.html", "run.json", "curves.json", "footprints.geojson", "ranking.gpkg",
)  # fmt: skip


def remove_report(out: Path) -> None:
    """Remove the report of an earlier run and the files that were made for it.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    remove_earlier(out, (REPORT, CURVES, FOOTPRINTS))
