"""Comparison of zlocus with other programs on the same images, area, grid and cores: `make peers`, or

    python benchmarks/peers [--scenes NAME ...] [--programs NAME ...] [--views N ...] [--side CELLS] [--runs N]
                            [--out FOLDER] [--cores 0,1] [--s2p PATH] [--micmac PATH] [--setsm PATH]

Installs CARS, Pandora with libSGM, and OpenCV from the package registry into environments of their own below FOLDER.
s2p, MicMac and SETSM run if a path to their command is given. Rendered scenes are made on demand; `seeds` are ten
realistic scenes whose seeds follow from the last commit that touches src/. The shared scenes are used if
`ZLOCUS_TEST_DATA` has them. The whole comparison takes hours; an
interrupted one is resumed. Writes results.json, and from it peers.md with its pictures; `--page FOLDER` only writes
the page, from `--results FILE`. For a first look, `--side` sets the size of the rendered scenes and `--runs` the
number of runs of zlocus.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Python puts the folder of this script first; there `middlebury` would be the module of this package.
sys.path[:] = [str(HERE.parent), *(path for path in sys.path if Path(path or ".").resolve() != HERE)]

from peers import builds, matchers  # noqa: E402
from peers.cars import Cars  # noqa: E402
from peers.environments import Environment, Missing, installed, this_checkout  # noqa: E402
from peers.frames import FRAMES  # noqa: E402
from peers.own import Own  # noqa: E402
from peers.page import write_page  # noqa: E402
from peers.running import OWN_RUNS, PeerComparison, Program, run_all  # noqa: E402
from peers.scenes import RENDERED  # noqa: E402
from seeds import fresh_seeds  # noqa: E402

NAMES = (*RENDERED, *FRAMES, "realistic", "seeds", "jax068", "pleiades", "middlebury", "kernels")
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
    parser.add_argument(
        "--views", nargs="+", type=int, metavar="N", help="numbers of views of rendered scenes; default: all"
    )
    parser.add_argument(
        "--side", type=int, metavar="CELLS", help="side of rendered scenes in cells of 0.5 m; default: their own"
    )
    parser.add_argument(
        "--runs", type=int, default=OWN_RUNS, metavar="N", help="runs of zlocus, of which the median counts"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("build/peers"), help="folder for environments, scenes and results"
    )
    parser.add_argument("--cores", help="numbers of the cores that all programs run on; default: the first two")
    parser.add_argument("--page", type=Path, metavar="FOLDER", help="only write the page and its pictures there")
    parser.add_argument(
        "--results", type=Path, default=HERE / "results.json", help="results of an earlier run, for --page"
    )
    for name in BUILDS:
        parser.add_argument(f"--{name.lower()}", type=Path, metavar="PATH", help=f"command of a build of {name}")
    return parser.parse_args()


def programs(options: argparse.Namespace, environments: dict[str, Environment]) -> list[Program]:
    """The requested programs that are available, zlocus first; a message names those that are not."""
    found: list[Program] = []
    for name in (name for name in PROGRAMS if name in options.programs):
        try:
            if name in BUILDS:
                if (path := getattr(options, name.lower())) is not None:
                    found.append(BUILDS[name](builds.working(path)))
                continue
            if name == "zlocus":
                environments["zlocus"] = this_checkout(options.out / "environments")
                found.append(Own(environments["zlocus"]))
                continue
            kind = "cars" if name == "CARS" else "matchers"
            if kind not in environments:
                environments[kind] = installed(kind, options.out / "environments")
            make = {"CARS": Cars, "OpenCV": matchers.opencv, "Pandora": matchers.pandora}[name]
            found.append(make(environments[kind]))
        except Missing as missing:
            print(f"{name} is left out: {missing}.", file=sys.stderr)
    return found


def main() -> None:
    options = parsed()
    if options.page is not None:
        print(write_page(options.results, options.page))
        return
    options.out = options.out.resolve()
    usable = sorted(os.sched_getaffinity(0))
    cores = tuple(map(int, options.cores.split(","))) if options.cores else tuple(usable[:2])
    environments: dict[str, Environment] = {}
    seeds = fresh_seeds() if "seeds" in options.scenes else ()
    comparison = PeerComparison(options.scenes, options.views, options.side, options.runs, seeds)
    results = run_all(programs(options, environments), comparison, options.out, cores, environments)
    print(write_page(results, options.out))


if __name__ == "__main__":
    main()
