"""Runs of `zlocus dsm`, accuracy of their surfaces, and tables, for the benchmarks that need all three.

The shared scenes and the judge, a script that shares no code with zlocus, lie in `ZLOCUS_TEST_DATA`; where that is not
set, in the folder `shared` beside this checkout.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Collection, Iterable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workplace import CannotRun
from zlocus.cli.app import app as cli
from zlocus.core.options import RunConfig
from zlocus.io.config import write_config

DATA = Path(os.environ.get("ZLOCUS_TEST_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
JUDGE = DATA.parent / "tools" / "evaluate_dsm.py"
RENDERED_TOWN = DATA / "rendered-city"


@dataclass(frozen=True)
class Work:
    """Cost of matching: evaluated correlations in millions and as a share of those of all images; CPU in seconds."""

    evaluations: float
    share: float
    cpu_s: float


def rendered_scene(folder: Path) -> Path:
    """The given folder, after a check that it holds a rendered scene.

    Raises
    ------
    CannotRun
        The folder has no truth.
    """
    if not (folder / "truth_dsm.tif").exists():
        raise CannotRun(
            f"`{folder}` holds no truth_dsm.tif: name the folder of a rendered scene, which "
            "`python -m zlocus.synthetic -o FOLDER` makes, or set ZLOCUS_TEST_DATA."
        )
    return folder


def run_here(command: Sequence[str], accept: Collection[int | None] = (None, 0)) -> None:
    """Run a command of zlocus in this process, where a benchmark can observe it; its output goes to standard error.

    command : the words after `zlocus` on the command line; accept : exit statuses that are no failure.

    Raises
    ------
    CannotRun
        The command ends with another exit status.
    """
    with redirect_stdout(sys.stderr):
        # In this mode the command line returns the status of a failure instead of ending the process.
        status = cli(list(command), standalone_mode=False)
    if status not in accept:
        raise CannotRun(f"`zlocus {command[0]}` ends with status {status}: its message stands above.")


def matched(images: Iterable[Path], out: Path, config: RunConfig, options: Iterable[str]) -> Work:
    """Run `zlocus dsm` in this process, into an empty folder, with the configuration written beside it.

    No report is written: it would take longer than matching a small scene.
    """
    shutil.rmtree(out, ignore_errors=True)
    file = out.with_name(f"{out.name}.toml")
    file.write_text(write_config(config), encoding="utf-8")
    command = ["dsm", *map(str, images), "-o", str(out), "--config", str(file), "--no-report", *options]
    run_here(command)
    record = json.loads((out / "run.json").read_text())
    done, every = record["evaluations"]["done"], record["evaluations"]["all_images"]
    cpu = next(stage["cpu_s"] for stage in record["stages"] if stage["name"] == "match")
    return Work(done / 1e6, done / every, cpu)


def judged(dsm: Path, truth: Path, classes: Path, threshold_m: float = 1.0, align: bool = False) -> dict[str, Any]:
    """Accuracy of each class of cells: by the independent judge if there is one, else by `zlocus evaluate`.

    align : remove a common shift of the surface first, for images with pointing errors.
    """
    if JUDGE.exists():
        command = [sys.executable, str(JUDGE), str(dsm), str(truth), "--class", str(classes), "--json"]
        command += ["--thr", str(threshold_m), *(["--align"] if align else [])]
        found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        # The judge reports the removed shift beside the classes.
        classes_of = {kind: figures for kind, figures in found.items() if isinstance(figures, dict)}
        return {kind: {**figures, "completeness": figures["complete"]} for kind, figures in classes_of.items()}
    from zlocus.evaluation.comparison import Comparison
    from zlocus.evaluation.evaluate import evaluate

    return evaluate(dsm, Comparison(truth, classes=classes, threshold_m=threshold_m, align=align)).as_dict()


def table_head(columns: dict[str, str]) -> str:
    """The first two lines of a Markdown table. columns : format of a value, by heading."""
    return "| " + " | ".join(columns) + " |\n|" + "---|" * len(columns)


def table_row(columns: dict[str, str], found: dict[str, Any]) -> str:
    """A line of a Markdown table with the figures that `columns` names."""
    return "| " + " | ".join(form.format(**found) for form in columns.values()) + " |"


def write_table(found: list[dict[str, Any]], path: Path) -> None:
    """Write all figures as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, found[0])
        writer.writeheader()
        writer.writerows(found)
