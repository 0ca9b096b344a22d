"""zlocus beside other programs, on the same images, area, grid and cores: `make peers`, or

    python benchmarks/peers [--scenes NAME ...] [--programs NAME ...] [--views N ...] [--side CELLS] [--runs N]
                            [--out FOLDER] [--cores 0,1] [--s2p PATH] [--micmac PATH] [--setsm PATH]

Installs CARS, Pandora with libSGM, and OpenCV from the package registry into environments of their own below FOLDER;
s2p, MicMac and SETSM are run when a path to their command is given. Renders its scenes; the Pleiades sets and
Middlebury's photographs are used where `ZLOCUS_TEST_DATA` has them. Hours; a run that was cut off goes on. Writes
results.json, and from it peers.md with its pictures; `--page FOLDER` writes the page alone, from `--results FILE`.
`--side` makes the rendered scenes smaller or larger, and `--runs` says how often zlocus is run, for a first look.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Python puts the folder of this script first, where `middlebury` would be another module than beside it.
sys.path[:] = [str(HERE.parent), *(path for path in sys.path if Path(path or ".").resolve() != HERE)]

from peers import builds, matchers  # noqa: E402
from peers.cars import Cars  # noqa: E402
from peers.environments import Environment, Missing, installed, this_checkout  # noqa: E402
from peers.own import Own  # noqa: E402
from peers.page import write_page  # noqa: E402
from peers.running import OWN_RUNS, Asked, Program, run_all  # noqa: E402
from peers.scenes import RENDERED  # noqa: E402

NAMES = (*RENDERED, "pleiades", "middlebury", "kernels")
PROGRAMS = ("zlocus", "CARS", "OpenCV", "Pandora", "s2p", "MicMac", "SETSM")
BUILDS = {"s2p": builds.S2p, "MicMac": builds.MicMac, "SETSM": builds.Setsm}


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python benchmarks/peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", choices=NAMES, default=NAMES, metavar="NAME", help=", ".join(NAMES))
    parser.add_argument(
        "--programs", nargs="+", choices=PROGRAMS, default=PROGRAMS, metavar="NAME", help=", ".join(PROGRAMS)
    )
    parser.add_argument("--views", nargs="+", type=int, metavar="N", help="of rendered scenes, these numbers alone")
    parser.add_argument("--side", type=int, metavar="CELLS", help="of 0.5 m, of rendered scenes; else each has its own")
    parser.add_argument("--runs", type=int, default=OWN_RUNS, metavar="N", help="of zlocus, whose median counts")
    parser.add_argument(
        "--out", type=Path, default=Path("build/peers"), help="folder for environments, scenes and results"
    )
    parser.add_argument("--cores", help="numbers of the cores that everything is pinned to; by default the first two")
    parser.add_argument("--page", type=Path, metavar="FOLDER", help="write the page and its pictures there and end")
    parser.add_argument("--results", type=Path, default=HERE / "results.json", help="of an earlier run, for --page")
    for name in BUILDS:
        parser.add_argument(f"--{name.lower()}", type=Path, metavar="PATH", help=f"the command of a build of {name}")
    return parser.parse_args()


def programs(given: argparse.Namespace, environments: dict[str, Environment]) -> list[Program]:
    """Those asked for that can be had, zlocus first; says what cannot."""
    found: list[Program] = []
    for name in (name for name in PROGRAMS if name in given.programs):
        try:
            if name in BUILDS:
                if (path := getattr(given, name.lower())) is not None:
                    found.append(BUILDS[name](builds.working(path)))
                continue
            if name == "zlocus":
                environments["zlocus"] = this_checkout(given.out / "environments")
                found.append(Own(environments["zlocus"]))
                continue
            kind = "cars" if name == "CARS" else "matchers"
            if kind not in environments:
                environments[kind] = installed(kind, given.out / "environments")
            make = {"CARS": Cars, "OpenCV": matchers.opencv, "Pandora": matchers.pandora}[name]
            found.append(make(environments[kind]))
        except Missing as missing:
            print(f"{name} is left out: {missing}.", file=sys.stderr)
    return found


def main() -> None:
    given = parsed()
    if given.page is not None:
        print(write_page(given.results, given.page))
        return
    given.out = given.out.resolve()
    usable = sorted(os.sched_getaffinity(0))
    cores = tuple(map(int, given.cores.split(","))) if given.cores else tuple(usable[:2])
    environments: dict[str, Environment] = {}
    asked = Asked(given.scenes, given.views, given.side, given.runs)
    results = run_all(programs(given, environments), asked, given.out, cores, environments)
    print(write_page(results, given.out))


if __name__ == "__main__":
    main()
