"""Results of the comparison, on disk after each measurement, and the machine that they were measured on."""

from __future__ import annotations

import datetime
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import psutil

from bench_kernels import processor


class Results:
    """All measurements, written to disk after each one, so that an interrupted comparison is resumed.

    cores : the cores that all programs run on. Measurements on other cores, or of other versions, are made again.
    """

    def __init__(self, path: Path, cores: Sequence[int]) -> None:
        self.path = path
        self.found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        self.found["machine"] = machine(cores)
        for part in ("programs", "scenes"):
            self.found.setdefault(part, {})
        for part in ("surfaces", "differences", "kernels", "middlebury"):
            self.found.setdefault(part, [])

    def has(self, part: str, **what: object) -> bool:
        """Whether a measurement was made on these cores without failure."""
        same = what | {"cores": self.found["machine"]["cores"]}
        return any(same.items() <= row.items() for row in self.found[part] if "failed" not in row)

    def add(self, part: str, row: dict[str, Any], *key: str) -> None:
        """Add a measurement, replace an earlier one with the same key, and write all."""
        same = {name: row[name] for name in key}
        kept = [each for each in self.found[part] if not same.items() <= each.items()]
        it = self.found["machine"]
        self.found[part] = [*kept, row | {"when": now(), "cores": it["cores"], "commit": it["commit"]}]
        self.write()

    def forget_scenes(self, matches: Callable[[str], object], but: Sequence[str]) -> None:
        """Drop the measurements of scenes that match, but of those whose name begins with one of `but`."""
        gone = {name for name in self.found["scenes"] if matches(name) and not name.startswith(tuple(but))}
        self.found["scenes"] = {name: it for name, it in self.found["scenes"].items() if name not in gone}
        self.found["surfaces"] = [row for row in self.found["surfaces"] if row["scene"] not in gone]
        self.write()

    def describe(self, part: str, name: str, what: dict[str, Any]) -> None:
        """Set the description of a program or a scene; the page lists them in the order of the last run."""
        self.found[part].pop(name, None)
        self.found[part][name] = what
        self.write()

    def write(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_suffix(".tmp")
        fresh.write_text(json.dumps(self.found, indent=1) + "\n", encoding="utf-8")
        os.replace(fresh, self.path)


def now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def machine(cores: Sequence[int]) -> dict[str, Any]:
    """Processor, cores, memory and system of this machine, and the commit that is measured."""
    return {
        "processor": processor(), "cores": list(cores), "of_cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 1024**3, 1),
        "system": f"{platform.system()} {platform.release().split('-')[0]}", "python": platform.python_version(),
        "commit": commit(), "started": now(),
    }  # fmt: skip


def commit() -> str:
    """Commit of this checkout, with a mark if files differ from it."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=Path(__file__).parent
    )
    return done.stdout.strip() or "unknown"


def say(what: str) -> None:
    print(f"{now()} {what}", file=sys.stderr, flush=True)
