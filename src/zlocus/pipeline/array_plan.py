"""The plan of a run whose tiles are made by independent processes: stored beside the tiles, read by each of them."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import zlocus
from zlocus.core.errors import ConfigError, InputError, OutputError
from zlocus.core.jit import kernels_digest
from zlocus.core.progress import duration
from zlocus.core.quoting import counted
from zlocus.core.requests import FINISHED, held_files
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import inputs_record, read_record, versions_record
from zlocus.io.stored_files import file_state
from zlocus.pipeline.execution.checkpoint import FOLDER, MANIFEST, PLAN, TileCheckpoint, write_atomically
from zlocus.pipeline.execution.packed_values import packed, unpacked
from zlocus.pipeline.finished_record import read_finished
from zlocus.products.report.file_names import RECORD

# Names beside the tiles: what people and programs may read, and everything that tiles and products are made of.
VALUES = "plan.bin"
SCHEMA = 1
# The entry of run.json that says of how many tasks a surface was made.
TASKS = "tasks"
COMMAND = "zlocus dsm"
# A sentence names at most so many groups of tasks.
MAX_NAMED_GROUPS = 12


@dataclass(frozen=True)
class ArrayPlan:
    """A run in tasks, numbered from 1, of which each process makes one.

    out : folder of the result; n_tasks : number of tasks; names : of the tiles to be matched, in the order in which
    they are dealt out; key : all that the tiles depend on, as the checkpoint holds it; digest : SHA-256 of the run
    setup; values_sha256 : of the stored values; started_in : folder in which relative paths begin; inputs : path and
    SHA-256 of every input; task_mb : memory of a task with one worker; task_s, assemble_s : estimated times of the
    longest task and of the assembly.
    """

    out: Path
    n_tasks: int
    names: tuple[str, ...]
    key: dict[str, Any] = field(repr=False)
    digest: str
    values_sha256: str
    started_in: str
    inputs: tuple[dict[str, Any], ...]
    task_mb: float
    task_s: float
    assemble_s: float

    def names_of(self, number: int) -> tuple[str, ...]:
        """Names of the tiles of a task: neighbours, because they share images. Where there are more tasks than tiles,
        some tasks have none.

        Raises
        ------
        ConfigError
            There is no task of this number.
        """
        if not 1 <= number <= self.n_tasks:
            raise ConfigError(
                f"{self.out} is planned in {self.n_tasks} tasks, numbered from 1 to {self.n_tasks}, and {number} is "
                "none of them. Give a number of that range."
            )
        first, after = (k * len(self.names) // self.n_tasks for k in (number - 1, number))
        return self.names[first:after]

    @property
    def with_work(self) -> list[int]:
        """Numbers of the tasks that have tiles."""
        return self.left(())

    def left(self, finished: Iterable[str]) -> list[int]:
        """Numbers of the tasks that have tiles which are not among those finished."""
        done = set(finished)
        return [n for n in range(1, self.n_tasks + 1) if not done.issuperset(self.names_of(n))]

    def checkpoint(self) -> TileCheckpoint:
        """The tiles of the run that are finished so far."""
        return TileCheckpoint.of(self.out, self.key, is_resumed=True, overwrite=False)

    @property
    def content(self) -> bytes | None:
        """The stored values as bytes; None where their file is missing or damaged."""
        with suppress(OSError):
            content = (self.out / FOLDER / VALUES).read_bytes()
            if hashlib.sha256(content).hexdigest() == self.values_sha256:
                return content
        return None

    def values(self) -> Any:
        """The stored values.

        Raises
        ------
        ConfigError
            This machine has another version of zlocus, Python or a library than the one that planned the run.
        InputError
            The file is damaged.
        """
        self._check_versions()
        content = self.content
        if content is None:
            raise InputError(
                f"{self.out / FOLDER / VALUES} is missing or damaged. Give the same `zlocus tiles plan` again, with "
                "its inputs and options; finished tiles are kept."
            )
        return unpacked(content)

    def _check_versions(self) -> None:
        now = {**versions_record(), "kernels": kernels_digest(Path(zlocus.__file__).parent)}
        planned = {**self.key.get("versions", {}), "kernels": self.key.get("kernels")}
        for name, version in now.items():
            if planned.get(name) != version:
                raise ConfigError(
                    f"{self.out} was planned with {name} {planned.get(name)}, and this machine has {name} {version}. "
                    "Use the same installation for all tasks, or plan the run anew with --overwrite."
                )

    def current_inputs(self) -> InputFiles:
        """The inputs with their present states, once it is sure that they hold what they held when the run was planned.

        A file of the same size and time of change is taken as it is; of others the checksum is compared.

        Raises
        ------
        InputError
            An input has changed or is missing.
        """
        planned, now = self.key.get("inputs", {}), {}
        for record in self.inputs:
            path, state = Path(record["path"]), planned.get(record["path"])
            now[record["path"]] = file_state(path)
            if record["sha256"] is None or now[record["path"]] == state:
                continue
            if not path.is_file():
                raise InputError(
                    f"The input {path} of the run planned in {self.out} is missing on this machine. Every machine must "
                    "see the inputs under the same names."
                )
            self.check_content(inputs_record([path]))
        return InputFiles(now)

    def check_content(self, records: Sequence[dict[str, Any]]) -> None:
        """Refuse inputs whose checksums are not those of the plan. records : see `inputs_record`.

        Raises
        ------
        InputError
            One has changed.
        """
        planned = {record["path"]: record["sha256"] for record in self.inputs}
        for record in records:
            if planned.get(record["path"]) != record["sha256"]:
                raise InputError(
                    f"The input {record['path']} has changed since {self.out} was planned. Put the file back, or plan "
                    "the run anew with `zlocus tiles plan`, the inputs and --overwrite."
                )

    @contextmanager
    def folder_of_paths(self) -> Iterator[ArrayPlan]:
        """Work, in the block, in the folder in which the relative paths of the inputs begin; yields the plan for there.

        Raises
        ------
        InputError
            This machine does not have the folder.
        """
        is_relative = any(not Path(record["path"]).is_absolute() for record in self.inputs)
        if not is_relative or Path.cwd() == Path(self.started_in):
            yield self
            return
        if not Path(self.started_in).is_dir():
            raise InputError(
                f"The run in {self.out} was planned in {self.started_in}, where the paths of its inputs begin, and "
                "this machine does not have that folder. Mount it under the same name, or plan with absolute paths."
            )
        there = ArrayPlan(**vars(self) | {"out": self.out.absolute()})
        with contextlib.chdir(self.started_in):
            yield there

    def __str__(self) -> str:
        if not self.n_tasks:
            return f"{self.out}: no tile shows ground that two images see."
        most = most_tiles(len(self.names), self.n_tasks)
        tasks = "one task, number 1"
        if self.n_tasks > 1:
            tasks = f"{self.n_tasks} tasks, numbered from 1 to {self.n_tasks}, each of at most {counted(most, 'tile')}"
        if len(self.with_work) < self.n_tasks:
            number = as_ranges(self.with_work, MAX_NAMED_GROUPS)
            tasks += f"; only task {number} has any" if len(self.with_work) == 1 else f"; only tasks {number} have any"
        return (
            f"{self.out}: {counted(len(self.names), 'tile')} in {tasks}. A task needs about "
            f"{self.task_mb / 1e3:.2g} GB of memory and up to {duration(self.task_s)} of one core; assembling takes "
            f"about {duration(self.assemble_s)}."
        )


def most_tiles(n_tiles: int, n_tasks: int) -> int:
    """Number of tiles of the largest task."""
    return -(-n_tiles // max(n_tasks, 1))


def write_plan(array_plan: ArrayPlan, content: bytes) -> None:
    """Store a plan beside the tiles; its own file comes last. content : see `packed_plan_values`.

    Raises
    ------
    OutputError
        The files cannot be written.
    """
    folder = array_plan.out / FOLDER
    record = {name: value for name, value in vars(array_plan).items() if name not in ("out", "key")}
    try:
        write_atomically(folder / VALUES, content)
        write_atomically(folder / PLAN, json.dumps({"schema": SCHEMA, **record}, indent=1).encode())
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written: {error.strerror or error}. Choose another folder for the result."
        ) from error


def packed_plan_values(value: Any) -> tuple[bytes, str]:
    """What a plan stores of everything that tiles and products are made of, and its SHA-256."""
    content = packed(value)
    return content, hashlib.sha256(content).hexdigest()


def stored_plan(out: Path) -> ArrayPlan | None:
    """The plan that is stored in a folder; None where there is none, or it is damaged."""
    try:
        record = json.loads((out / FOLDER / PLAN).read_text(encoding="utf-8"))
        key = json.loads((out / FOLDER / MANIFEST).read_text(encoding="utf-8"))["key"]
        if record.pop("schema") != SCHEMA or not isinstance(key, dict):
            return None
        record |= {"names": tuple(record["names"]), "inputs": tuple(record["inputs"])}
        return ArrayPlan(out=out, key=key, **record)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


@dataclass(frozen=True)
class FinishedTasks:
    """A surface that is finished.

    n_tasks : number of tasks from which it was assembled, 0 where one run made it; coverage : see `DsmResult`;
    shortcoming : why it is no success, "" where it is one.
    """

    out: Path
    n_tasks: int
    coverage: float = 0.0
    shortcoming: str = ""

    def as_dict(self) -> dict[str, Any]:
        """The same for programs."""
        return {"tasks": self.n_tasks, "left": [], "is_assembled": True, "coverage": self.coverage}

    def __str__(self) -> str:
        tasks = f", assembled from {counted(self.n_tasks, 'task')}" if self.n_tasks else ""
        return f"{self.out}: already finished{tasks}. Nothing is left."


def plan_or_finished(out: Path) -> ArrayPlan | FinishedTasks:
    """The plan in a folder, or what was made of it.

    Raises
    ------
    InputError
        The folder holds neither.
    """
    found = stored_plan(out) or finished_tasks(out)
    if found is not None:
        return found
    advice = f"Plan one with `zlocus tiles plan {out} INPUT...`"
    if not out.is_dir():
        raise InputError(f"{out} is no folder of a run in tasks: there is no such folder. {advice}.")
    held = [*held_files(out), *([FOLDER] if (out / FOLDER).exists() else [])]
    if held:
        raise InputError(
            f"{out} holds another run ({', '.join(held)}) and no plan of tasks. Name another folder, or give "
            "`zlocus tiles plan` with the inputs and options of that run to make what it lacks in tasks."
        )
    raise InputError(f"{out} holds no plan of tasks. {advice}.")


def finished_tasks(out: Path) -> FinishedTasks | None:
    """The surface of a folder, if it was assembled from tasks and is finished; else None."""
    finished = read_finished(out) if (out / FINISHED).exists() else None
    if finished is None or finished.key.get("command") != COMMAND:
        return None
    try:
        record = read_record(out / RECORD)
        return FinishedTasks(out, int(record[TASKS]), float(record["coverage"]), finished.shortcoming)
    except (InputError, KeyError, TypeError, ValueError):
        return None


def as_ranges(numbers: Sequence[int], most: int | None = None) -> str:
    """Numbers in rising order as schedulers read them: 1-3,7. most : groups after which "and more" follows; None
    writes all."""
    starts = [numbers[0]] if numbers else []
    ends = []
    for one, following in pairwise(numbers):
        if following != one + 1:
            ends.append(one)
            starts.append(following)
    ends += numbers[-1:]
    groups = [f"{a}-{b}" if b > a else f"{a}" for a, b in zip(starts, ends, strict=True)]
    if most is not None and len(groups) > most:
        return f"{','.join(groups[:most])} and more"
    return ",".join(groups)
