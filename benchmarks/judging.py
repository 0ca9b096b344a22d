"""What benchmarks of `zlocus dsm` share: a run with its work, judging its surface, and tables."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zlocus import cli
from zlocus.io.config import write_config
from zlocus.options import RunConfig

SHARED = Path(__file__).resolve().parents[2] / "shared"
JUDGE = SHARED / "tools" / "evaluate_dsm.py"


@dataclass(frozen=True)
class Work:
    """What matching took: NCC evaluated, in millions, and as a share of those of all images; CPU, s."""

    evaluations: float
    share: float
    cpu_s: float


def matched(images: Iterable[Path], out: Path, config: RunConfig, options: Iterable[str]) -> Work:
    """One run of `zlocus dsm` in this process, into an empty folder; its configuration lies beside it."""
    shutil.rmtree(out, ignore_errors=True)
    file = out.with_name(f"{out.name}.toml")
    file.write_text(write_config(config), encoding="utf-8")
    command = ["dsm", *map(str, images), "-o", str(out), "--config", str(file), *options]
    with redirect_stdout(sys.stderr):
        cli.app(command, standalone_mode=False)
    record = json.loads((out / "run.json").read_text())
    done, every = record["evaluations"]["done"], record["evaluations"]["all_images"]
    cpu = next(stage["cpu_s"] for stage in record["stages"] if stage["name"] == "match")
    return Work(done / 1e6, done / every, cpu)


def judged(dsm: Path, truth: Path, classes: Path, threshold_m: float = 1.0) -> dict[str, Any]:
    """Figures per class: of the independent script where it is at hand, else of our own evaluation."""
    if JUDGE.exists():
        command = [sys.executable, str(JUDGE), str(dsm), str(truth), "--class", str(classes), "--json"]
        command += ["--thr", str(threshold_m)]
        found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        return {kind: {**figures, "completeness": figures["complete"]} for kind, figures in found.items()}
    from zlocus.evaluation.evaluate import evaluate

    return evaluate(dsm, truth, classes=classes, threshold_m=threshold_m).as_dict()


def table_head(columns: dict[str, str]) -> str:
    """The head of a table. columns : how a value is written, by heading."""
    return "| " + " | ".join(columns) + " |\n|" + "---|" * len(columns)


def table_row(columns: dict[str, str], found: dict[str, Any]) -> str:
    """A row of figures, by the names that `columns` knows."""
    return "| " + " | ".join(form.format(**found) for form in columns.values()) + " |"


def write_table(found: list[dict[str, Any]], path: Path) -> None:
    """All figures as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, found[0])
        writer.writeheader()
        writer.writerows(found)
