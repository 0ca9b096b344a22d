"""The acceptance table: figures of the real commands on the shared scenes, beside the bars that they must reach.

    python benchmarks/acceptance.py [ROW ...] [--slow] [--keep FOLDER] [--record]

Rows: see `rows/registry.py`; without any, all but the slow ones. With `--record` (`make measure ROW`) the figures of
each row are also written to its results file in benchmarks/results, from which the pages are written (`make figures`).
The exit status is 1 if a row could not be run. A figure that misses its bar is marked SHORT and does not change the
exit status.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import traceback
from pathlib import Path

from result_files import code_of, record_results
from rows.registry import ROWS
from rows.resources import peaks_by_plan
from workplace import CannotRun, Figure, Workplace


def show(name: str, lines: list[tuple[str, str, str, str]]) -> None:
    for what, value, bar, verdict in lines:
        print(f"{name:<10} {what:<34} {value:>20}  {bar:<22} {verdict}".rstrip(), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--slow", action="store_true", help="the slow rows too")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave the results here")
    parser.add_argument("--record", action="store_true", help="write the results file of each row")
    options = parser.parse_args()
    if unknown := [name for name in options.rows if name not in ROWS]:
        parser.error(f"no row {unknown[0]}; there are {', '.join(ROWS)}")
    chosen = options.rows or [name for name in ROWS if options.slow or not ROWS[name].is_slow]
    failed = 0
    show("row", [("what", "figure", "bar", "")])
    with tempfile.TemporaryDirectory() as scratch:
        for name in chosen:
            try:
                figures = measured(name, (options.keep or Path(scratch)).absolute() / name, options.record)
            except CannotRun as reason:
                failed += 1
                print(f"{name:<10} cannot be run: {reason}", flush=True)
            except Exception:
                failed += 1
                print(f"{name:<10} fails:\n{traceback.format_exc()}", flush=True)
            else:
                show(name, [figure.cells() for figure in figures])
    return 1 if failed else 0


def measured(name: str, out: Path, is_recorded: bool) -> list[Figure]:
    """Measure a row in the folder `out`, and write its results file if that is asked for.

    To its own figures are added how far the memory of its runs is from their plans.
    """
    row, data = ROWS[name], os.environ.get("ZLOCUS_TEST_DATA")
    workplace, code, start = Workplace(Path(data) if data else None, out), code_of(row.parts), time.monotonic()
    figures = [*row.measure(workplace), *peaks_by_plan(out)]
    if is_recorded and row.is_recorded:
        seconds, command = time.monotonic() - start, f"make measure ROW={name}"
        record_results(name, figures, command, seconds=seconds, code=code, inputs=workplace.inputs)
    return figures


if __name__ == "__main__":
    sys.exit(main())
