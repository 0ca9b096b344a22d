"""Shared parts of the acceptance rows: folders of scenes and results, measured commands, figures with their bars."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
ZLOCUS = Path(sys.executable).with_name("zlocus")
RENDERED_VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")
# Exit status of a run of which too little was matched; its products are kept.
COVERAGE_SHORT = 3
# Runs a command from a small process, because the peak memory of a child begins with the memory of its parent.
MEASURE = """
import resource, subprocess, sys, time
begun = time.perf_counter()
status = subprocess.call(sys.argv[2:])
wall_s = time.perf_counter() - begun
used = resource.getrusage(resource.RUSAGE_CHILDREN)
with open(sys.argv[1], "w") as file:
    print(used.ru_utime + used.ru_stime, used.ru_maxrss, wall_s, file=file)
sys.exit(status)
"""


class CannotRun(Exception):
    """Reason why a row or a benchmark has no figures."""


def table_line(cells: Iterable[object]) -> str:
    """A line of a table in Markdown."""
    return "| " + " | ".join(map(str, cells)) + " |"


def ended(main: Callable[[], object]) -> None:
    """Run the main function of a script. If it cannot run, end with status 1 and one sentence that says why."""
    try:
        main()
    except CannotRun as reason:
        sys.exit(f"Error: {reason}")


@dataclass(frozen=True)
class Figure:
    """One line of the table. what : label, once in a row.

    at_least, at_most : values that pass; a figure with neither is only reported. fails_when : the fault that would make
    the figure miss its bar, in a few words; every figure with a bar has it. is_detail : the figure stands in the
    results file and not in the table of the accuracy page.
    """

    what: str
    value: float
    unit: str = ""
    at_least: float | None = None
    at_most: float | None = None
    fails_when: str = ""
    is_detail: bool = False

    def cells(self) -> tuple[str, str, str, str]:
        """Label, figure, bar and verdict as text."""
        unit = f" {self.unit}" if self.unit else ""
        verdict = "" if not self.bar else "pass" if self.passes else "SHORT"
        return self.what, f"{self.value:.4g}{unit}", self.bar, verdict

    @property
    def bar(self) -> str:
        """The bar as text with its unit, empty without one."""
        unit = f" {self.unit}" if self.unit else ""
        if self.at_least is not None and self.at_most is not None:
            return f"{self.at_least:g} to {self.at_most:g}{unit}"
        if self.at_most is not None:
            return f"<= {self.at_most:g}{unit}"
        return "" if self.at_least is None else f">= {self.at_least:g}{unit}"

    @property
    def passes(self) -> bool:
        """Whether the figure reaches its bar; a value that is NaN reaches none."""
        above = self.at_least is None or self.value >= self.at_least
        below = self.at_most is None or self.value <= self.at_most
        return above and below


@dataclass(frozen=True)
class Usage:
    """CPU of a command with its children, memory of its largest process (GB of 1024^3 bytes), its exit status, the time
    from its start to its end, and all that it said."""

    cpu_s: float
    peak_gb: float
    status: int = 0
    wall_s: float = 0.0
    said: str = ""


@dataclass(frozen=True)
class Workplace:
    """Folder of the shared scenes (None if there is none), and folder for the results of a row.

    inputs : what the row notes about its inputs, such as its seeds; the results file holds it.
    """

    data: Path | None
    out: Path
    inputs: dict[str, Any] = field(default_factory=dict, compare=False)

    def scene(self, name: str) -> Path:
        """Folder of a shared scene."""
        if self.data is None:
            raise CannotRun("ZLOCUS_TEST_DATA is not set")
        folder = self.data / name
        if not folder.is_dir():
            raise CannotRun(f"{folder} is missing")
        return folder

    def judge(self, dsm: Path, scene: Path, *options: str) -> dict[str, dict[str, float]]:
        """Accuracy of a surface by class, from the shared judge, which shares no code with zlocus."""
        if self.data is None:
            raise CannotRun("ZLOCUS_TEST_DATA is not set")
        script = self.data.parent / "tools" / "evaluate_dsm.py"
        if not script.exists():
            raise CannotRun(f"{script} is missing")
        command = [sys.executable, script, dsm, scene / "truth_dsm.tif", "--class", scene / "truth_class.tif", "--json"]
        return json.loads(subprocess.run([*command, *options], check=True, capture_output=True).stdout)

    def judge_twice(self, dsm: Path, scene: Path, *options: str) -> dict[str, dict[str, dict[str, float]]]:
        """Accuracy of a surface as it is (key `absolute`) and after its shift was removed (key `aligned`)."""
        return {"absolute": self.judge(dsm, scene, *options), "aligned": self.judge(dsm, scene, "--align", *options)}

    def judge_registered(self, dsm: Path, reference: Path, classes: Path) -> dict[str, Any]:
        """Accuracy of a surface by class after one shift in x, y and height, from the shared judge of lidar scenes."""
        if self.data is None:
            raise CannotRun("ZLOCUS_TEST_DATA is not set")
        script = self.data.parent / "tools" / "judge_registered.py"
        if not script.exists():
            raise CannotRun(f"{script} is missing")
        command = [sys.executable, script, reference, dsm, "--classes", classes, "--json"]
        return json.loads(subprocess.run(command, check=True, capture_output=True).stdout)


def run(command: list[Any], accept: tuple[int, ...] = (0,), cwd: Path | None = None) -> Usage:
    """Run a command and measure it. accept : exit statuses that are no failure."""
    with tempfile.TemporaryDirectory() as scratch:
        usage = Path(scratch) / "usage"
        measured = [sys.executable, "-c", MEASURE, str(usage), *map(str, command)]
        done = subprocess.run(measured, capture_output=True, text=True, errors="replace", cwd=cwd)
        if done.returncode not in accept:
            said = (done.stderr.strip() or done.stdout.strip() or "nothing said").splitlines()
            raise CannotRun(f"`{' '.join(map(str, command[:3]))} ...` exits {done.returncode}: {said[-1]}")
        cpu_s, peak_kb, wall_s = map(float, usage.read_text().split())
    return Usage(cpu_s, peak_kb / 1024**2, done.returncode, wall_s, done.stdout + done.stderr)


def rendered_images(scene: Path, views: tuple[str, ...] = RENDERED_VIEWS) -> list[Path]:
    """Views of the same date, by default all six."""
    return [scene / f"img_{view}.tif" for view in views]


def render(scene: Path, kind: str, side_cells: int, *more: Any) -> None:
    """Render a scene with the six views of the same date into a folder."""
    command = [sys.executable, "-m", "zlocus.synthetic", "-o", scene, "--kind", kind, "--size", side_cells]
    run([*command, "--views", len(RENDERED_VIEWS), *more])
