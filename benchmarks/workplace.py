"""Where rows of the acceptance table work: scenes, results, commands that are measured, figures with their bars."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
ZLOCUS = Path(sys.executable).with_name("zlocus")
RENDERED_VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")
# In a small process of its own: a child's peak memory counts from what its parent held when it was started.
MEASURE = """
import resource, subprocess, sys
status = subprocess.call(sys.argv[2:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
with open(sys.argv[1], "w") as file:
    print(used.ru_utime + used.ru_stime, used.ru_maxrss, file=file)
sys.exit(status)
"""


class CannotRun(Exception):
    """Why a row, or a benchmark, has no figures."""


def ended(main: Callable[[], object]) -> None:
    """Run a script to its end. What keeps it from running is said in one sentence, with status 1."""
    try:
        main()
    except CannotRun as reason:
        sys.exit(f"Error: {reason}")


@dataclass(frozen=True)
class Figure:
    """One line of the table. bar : lowest or highest value that passes, None where the figure is only reported."""

    what: str
    value: float
    unit: str = ""
    at_least: float | None = None
    at_most: float | None = None

    def cells(self) -> tuple[str, str, str, str]:
        """What, figure, bar and verdict as text."""
        unit = f" {self.unit}" if self.unit else ""
        bar = "" if self.at_least is None else f">= {self.at_least:g}{unit}"
        bar = bar if self.at_most is None else f"<= {self.at_most:g}{unit}"
        if self.at_least is not None and self.at_most is not None:
            bar = f"{self.at_least:g} to {self.at_most:g}{unit}"
        above = self.at_least is None or self.value >= self.at_least
        below = self.at_most is None or self.value <= self.at_most
        verdict = "" if not bar else "pass" if above and below else "SHORT"
        return self.what, f"{self.value:.4g}{unit}", bar, verdict


@dataclass(frozen=True)
class Usage:
    """What a command took: CPU with that of its children, memory of its largest process (GB of 1024^3 bytes)."""

    cpu_s: float
    peak_gb: float


@dataclass(frozen=True)
class Workplace:
    """Where the scenes are and where results go."""

    data: Path | None
    out: Path

    def scene(self, name: str) -> Path:
        """Folder of a shared scene."""
        if self.data is None:
            raise CannotRun("ZLOCUS_TEST_DATA is not set")
        folder = self.data / name
        if not folder.is_dir():
            raise CannotRun(f"{folder} is missing")
        return folder

    def judge(self, dsm: Path, scene: Path, *options: str) -> dict[str, dict[str, float]]:
        """The shared judge's figures, which share no code with ours."""
        if self.data is None:
            raise CannotRun("ZLOCUS_TEST_DATA is not set")
        script = self.data.parent / "tools" / "evaluate_dsm.py"
        if not script.exists():
            raise CannotRun(f"{script} is missing")
        command = [sys.executable, script, dsm, scene / "truth_dsm.tif", "--class", scene / "truth_class.tif", "--json"]
        return json.loads(subprocess.run([*command, *options], check=True, capture_output=True).stdout)


def run(command: list[Any], accept: tuple[int, ...] = (0,), cwd: Path | None = None) -> Usage:
    """Run a command to its end and measure it."""
    with tempfile.TemporaryDirectory() as scratch:
        usage = Path(scratch) / "usage"
        measured = [sys.executable, "-c", MEASURE, str(usage), *map(str, command)]
        done = subprocess.run(measured, capture_output=True, text=True, errors="replace", cwd=cwd)
        if done.returncode not in accept:
            said = (done.stderr.strip() or done.stdout.strip() or "nothing said").splitlines()
            raise CannotRun(f"`{' '.join(map(str, command[:3]))} ...` exits {done.returncode}: {said[-1]}")
        cpu_s, peak_kb = map(float, usage.read_text().split())
    return Usage(cpu_s, peak_kb / 1024**2)


def rendered_images(scene: Path, views: tuple[str, ...] = RENDERED_VIEWS) -> list[Path]:
    """Views of the same date, by default all six."""
    return [scene / f"img_{view}.tif" for view in views]


def render(scene: Path, kind: str, side_cells: int, *more: Any) -> None:
    """Render a scene with the six views of the same date into a folder."""
    command = [sys.executable, "-m", "zlocus.synthetic", "-o", scene, "--kind", kind, "--size", side_cells]
    run([*command, "--views", len(RENDERED_VIEWS), *more])
