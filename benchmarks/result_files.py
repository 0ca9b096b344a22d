"""Results files: the figures of a row, with the commit, date, machine and command that they were measured with.

One JSON file per row in benchmarks/results. The pages take every measured figure from these files (`make figures`).
"""

from __future__ import annotations

import datetime
import hashlib
import json
import math
import os
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from workplace import ROOT, CannotRun, Figure

RESULTS = ROOT / "benchmarks" / "results"
NOT_RECORDED = "not recorded"
DIRTY = "-dirty"
# Parts of the source that rows measure. A folder stands for its Python files, without the parts listed inside it.
PACKAGE, RENDERER = "src/zlocus", "src/zlocus/synthetic"
# Figures are kept to so many significant digits.
DIGITS = 7

# Cells of a table as text, by line; the first line is its heading.
Table = list[list[str]]


@dataclass(frozen=True)
class Results:
    """Figures of a row and the circumstances of their measurement.

    commit : of the checkout; it ends in `DIRTY` where measured files differed from it. date : UTC, ISO 8601. machine :
    processor, cores, memory_gb, system, python. seconds : wall time, None where it is not recorded. code : digest of
    each measured part of the source. inputs : noted by the row, such as its seeds. note : where the figures come from,
    if not from the command. tables : printed by a script, see `recording.py`.
    """

    row: str
    commit: str
    date: str
    machine: dict[str, Any]
    command: str
    seconds: float | None
    code: dict[str, str]
    figures: tuple[Figure, ...]
    inputs: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    tables: tuple[Table, ...] = ()

    def figure(self, what: str) -> Figure:
        """The figure with this label.

        Raises
        ------
        CannotRun
            The row has no such figure.
        """
        for figure in self.figures:
            if figure.what == what:
                return figure
        raise CannotRun(
            f"benchmarks/results/{self.row}.json has no figure `{what}`: correct the name in the page, "
            f"or measure it (`{self.command}`)."
        )

    def value(self, what: str) -> float:
        """Value of the figure with this label."""
        return self.figure(what).value


def read_results(row: str, folder: Path = RESULTS) -> Results:
    """The results file of a row.

    Raises
    ------
    CannotRun
        There is none.
    """
    path = folder / f"{row}.json"
    if not path.exists():
        raise CannotRun(f"{path} is missing: measure the row with `make measure {row}`.")
    found = json.loads(path.read_text(encoding="utf-8"))
    figures = tuple(Figure(**_with_nan(figure)) for figure in found.pop("figures"))
    return Results(**found | {"figures": figures, "tables": tuple(found.get("tables", ()))})


def write_results(results: Results, folder: Path = RESULTS) -> Path:
    """Write the results file of a row under a temporary name, then rename it.

    Raises
    ------
    CannotRun
        Two figures have the same label, so that a page could not name them.
    """
    labels = [figure.what for figure in results.figures]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise CannotRun(f"Row {results.row} has two figures named `{twice[0]}`. Give each figure its own label.")
    record = asdict(results)
    record["figures"] = [_figure_record(figure) for figure in results.figures]
    ordered = {key: record[key] for key in KEYS if key not in OPTIONAL_KEYS or record[key]}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{results.row}.json"
    part = path.with_suffix(".tmp")
    part.write_text(json.dumps(ordered, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, path)
    return path


# Order of the keys in a file; the optional ones are left out where they are empty.
KEYS = ("row", "commit", "date", "machine", "command", "seconds", "code", "inputs", "note", "figures", "tables")
OPTIONAL_KEYS = ("inputs", "note", "tables")


def record_results(
    row: str,
    figures: Iterable[Figure],
    command: str,
    *,
    seconds: float | None = None,
    code: dict[str, str] | None = None,
    inputs: dict[str, Any] | None = None,
    tables: Sequence[Table] = (),
    folder: Path = RESULTS,
) -> Results:
    """Write the results file of figures that were measured just now with the code of this checkout.

    code : digests of the measured parts before the measurement began (`code_of`), None for those of the package now.
    Where they are others now, files were changed meanwhile, and the commit is marked. Scripts call it with their
    figures; `make measure ROW` calls it for the rows of the acceptance table.
    """
    code = code_of((PACKAGE,)) if code is None else code
    commit = commit_of(list(code))
    if code != code_of(code) and not commit.endswith(DIRTY):
        commit += DIRTY
    results = Results(
        row=row,
        commit=commit,
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        machine=this_machine(),
        command=command,
        seconds=None if seconds is None else round(seconds, 1),
        code=code,
        figures=tuple(replace(figure, value=_rounded(figure.value)) for figure in figures),
        inputs=dict(inputs or {}),
        tables=tuple(tables),
    )
    write_results(results, folder)
    return results


def all_results(folder: Path = RESULTS) -> dict[str, Results]:
    """All results files by row."""
    return {path.stem: read_results(path.stem, folder) for path in sorted(folder.glob("*.json"))}


def stale_parts(results: Results) -> list[str]:
    """Measured parts of the source that differ from those of today; none where no code is recorded."""
    return [part for part, digest in results.code.items() if digest != digest_of(part)]


def code_of(parts: Iterable[str]) -> dict[str, str]:
    """Digest of each part of the source as it lies in this checkout."""
    return {part: digest_of(part) for part in parts}


def digest_of(part: str) -> str:
    """Digest of a part of the source as it lies in this checkout; it needs no git history. See `digest_at`."""
    path = ROOT / part
    files = [path] if path.is_file() else sorted(path.rglob("*.py")) if path.is_dir() else []
    blobs = {}
    for file in files:
        name = file.relative_to(ROOT).as_posix()
        data = file.read_bytes()
        blobs[name] = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
    return _digest(part, blobs)


def digest_at(part: str, commit: str) -> str:
    """Digest of a part of the source at a commit: that of `digest_of` in a checkout of the commit."""
    listed = git("ls-tree", "-r", commit, "--", part)
    blobs = {}
    for line in listed.splitlines():
        about, name = line.split("\t")
        if name.endswith(".py"):
            blobs[name] = about.split()[2]
    return _digest(part, blobs)


def _digest(part: str, blobs: dict[str, str]) -> str:
    """Digest of the names and git blob hashes of a part's files, without those of the parts inside it."""
    inside = tuple(f"{other}/" for other in (PACKAGE, RENDERER) if other.startswith(f"{part}/"))
    lines = [f"{name} {blob}" for name, blob in sorted(blobs.items()) if not name.startswith(inside or ("\0",))]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def commit_of(parts: Sequence[str]) -> str:
    """Commit of this checkout, with a mark where the measured parts differ from it."""
    try:
        commit = git("rev-parse", "--short=12", "HEAD").strip()
        left_out = [f":(exclude){RENDERER}"] if RENDERER not in parts else []
        changed = git("status", "--porcelain", "--", *parts, *left_out).strip()
    except CannotRun:
        return NOT_RECORDED
    return commit + (DIRTY if changed else "")


def git(*words: str) -> str:
    """What a command of git prints.

    Raises
    ------
    CannotRun
        git fails, or is not installed.
    """
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise CannotRun("git is not installed, and this needs the history of the repository.") from error
    if done.returncode:
        raise CannotRun(f"`git {' '.join(words[:2])}` fails: {done.stderr.strip() or 'no reason given'}")
    return done.stdout


def this_machine() -> dict[str, Any]:
    """Processor, cores, memory and system of this machine, and the version of Python."""
    from peers.results import machine

    found = machine(sorted(os.sched_getaffinity(0)))
    return {key: found[key] for key in ("processor", "cores", "memory_gb", "system", "python")}


def _figure_record(figure: Figure) -> dict[str, Any]:
    """A figure as JSON holds it: NaN is null, and what is not set is left out, but for its bar."""
    record = asdict(figure) | {"value": None if math.isnan(figure.value) else figure.value}
    if not record["is_detail"]:
        del record["is_detail"]
    return record


def _with_nan(record: dict[str, Any]) -> dict[str, Any]:
    return record | {"value": math.nan if record["value"] is None else record["value"]}


def _rounded(value: float) -> float:
    return float(f"{float(value):.{DIGITS}g}")
