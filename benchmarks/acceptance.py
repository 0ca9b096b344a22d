"""The acceptance table: figures of the real commands on the shared scenes, beside the bars that they must reach.

    python benchmarks/acceptance.py [ROW ...] [--slow] [--keep FOLDER]

Rows: see `ROWS`; without any, all but the slow ones. The exit status is 1 if a row could not be run. A figure that
misses its bar is marked SHORT and does not change the exit status.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

import inspecting
from rows import demo, large_areas, methods, other_programs, photographs, rendered, resources, satellite
from workplace import CannotRun, Figure, Workplace

ROWS: dict[str, Callable[[Workplace], list[Figure]]] = {
    "demo": demo.demo, "mixed": demo.mixed,
    "calanques": satellite.calanques,
    "city": rendered.city, "city-views": rendered.city_views, "hills": rendered.hills, "joint": rendered.joint,
    "new-scenes": rendered.new_scenes,
    "ventoux": satellite.ventoux, "datum": satellite.datum,
    "ortho": rendered.ortho,
    "dmc": photographs.dmc, "tuniu": photographs.tuniu, "herzjesu": photographs.herzjesu,
    "kernels": resources.kernels,
    "selection": methods.selection, "features": methods.features, "middlebury": methods.middlebury,
    "memory": resources.memory, "speed": resources.speed,
    "inspect": inspecting.inspect, "inspect-large": inspecting.inspect_large,
    "halo": large_areas.halo, "growth": large_areas.growth,
    "signals": resources.signals, "clone": resources.clone,
    "peers": other_programs.peers,
}  # fmt: skip
SLOW = ("new-scenes", "memory", "speed", "inspect-large", "growth", "clone")


def show(name: str, lines: list[tuple[str, str, str, str]]) -> None:
    for what, value, bar, verdict in lines:
        print(f"{name:<10} {what:<34} {value:>20}  {bar:<22} {verdict}".rstrip(), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--slow", action="store_true", help="the slow rows too")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave the results here")
    options = parser.parse_args()
    if unknown := [name for name in options.rows if name not in ROWS]:
        parser.error(f"no row {unknown[0]}; there are {', '.join(ROWS)}")
    chosen = options.rows or [name for name in ROWS if options.slow or name not in SLOW]
    data = os.environ.get("ZLOCUS_TEST_DATA")
    failed = 0
    show("row", [("what", "figure", "bar", "")])
    with tempfile.TemporaryDirectory() as scratch:
        for name in chosen:
            out = (options.keep or Path(scratch)).absolute() / name
            try:
                figures = ROWS[name](Workplace(Path(data) if data else None, out))
            except CannotRun as reason:
                failed += 1
                print(f"{name:<10} cannot be run: {reason}", flush=True)
            except Exception:
                failed += 1
                print(f"{name:<10} fails:\n{traceback.format_exc()}", flush=True)
            else:
                show(name, [figure.cells() for figure in figures])
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
