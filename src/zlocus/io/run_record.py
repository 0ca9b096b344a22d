"""The file run.json: the request, inputs and versions of a run, its stages and their times."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from zlocus.core.errors import InputError
from zlocus.core.options import RunConfig
from zlocus.core.quoting import quoted
from zlocus.core.resources import peak_memory_mb
from zlocus.io.atomic_write import write_atomically
from zlocus.io.config import config_as_dict
from zlocus.io.open_raster import gdal_name
from zlocus.io.safe_documents import read_json
from zlocus.io.stored_files import is_remote

# Version of the keys of run.json and of the other JSON files of a result.
SCHEMA = 2
CHUNK_BYTES = 1 << 20
LOGGER = logging.getLogger(__name__)
LIBRARIES = (
    "zlocus",
    "numpy",
    "numba",
    "scipy",
    "rasterio",
    "pyproj",
    "odc-geo",
    "opencv-python-headless",
    "laspy",
    "lazrs",
)


@dataclass
class WorkerUsage:
    """Resources that a stage used in worker processes. cpu_s : sum of all; peak_mb : largest of one process."""

    cpu_s: float = 0.0
    peak_mb: float = 0.0


@dataclass
class Stopwatch:
    """Wall time, CPU time and peak memory of each stage of a run."""

    stages: list[dict[str, Any]] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[WorkerUsage]:
        """Time a block as a stage. The block adds what its workers used to the record that it gets."""
        wall, cpu, workers = time.perf_counter(), time.process_time(), WorkerUsage()
        yield workers
        used = {
            "name": name,
            "wall_s": round(time.perf_counter() - wall, 3),
            "cpu_s": round(time.process_time() - cpu + workers.cpu_s, 3),
            "peak_mb": round(max(peak_memory_mb(), workers.peak_mb), 1),
        }
        self.stages.append(used)
        LOGGER.debug("Stage %(name)s: %(wall_s)s s, CPU %(cpu_s)s s, largest memory so far %(peak_mb)s MB", used)


def inputs_record(paths: Iterable[Path]) -> list[dict[str, str | None]]:
    """Path and SHA-256 of every input file; None for files on servers, which are never read as a whole."""
    records: list[dict[str, str | None]] = []
    for path in paths:
        if is_remote(path):
            records.append({"path": gdal_name(path), "sha256": None})
            continue
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while chunk := file.read(CHUNK_BYTES):
                digest.update(chunk)
        records.append({"path": str(path), "sha256": digest.hexdigest()})
    return records


def request_as_dict(request: Any) -> dict[str, Any]:
    """A request, one of `zlocus.core.requests`, as values that JSON can hold."""
    record = {name: str(value) if isinstance(value, Path) else value for name, value in vars(request).items()}
    return record | {"inputs": [str(path) for path in request.inputs]}


def result_record(
    request: Any, config: RunConfig, inputs: Sequence[Mapping[str, str | None]], stopwatch: Stopwatch
) -> dict[str, Any]:
    """The entries of run.json that all commands share: configuration, versions, inputs and stages.

    inputs : see `inputs_record`.
    """
    return {
        "config": {"request": request_as_dict(request), "options": config_as_dict(config)},
        "versions": versions_record(),
        "inputs": list(inputs),
        "stages": stopwatch.stages,
    }


def origin_record(command: str, kernels: str) -> dict[str, Any]:
    """By which command, when, where and on what kind of processor a result was made, for run.json.

    kernels : digest of the sources of the compiled kernels.
    """
    return {
        "command": command,
        "created": utc_now(),
        "started_in": str(Path.cwd()),
        "processor": processor_name(),
        "kernels": kernels,
    }


def processor_name() -> str:
    """Kind of processor that kernels are compiled for, as LLVM names it, such as `znver4` or `skylake-avx512`."""
    from llvmlite.binding import get_host_cpu_name
    from numba import config

    return str(config.CPU_NAME or get_host_cpu_name())  # type: ignore[attr-defined]


def utc_now() -> str:
    """The current time in UTC, as ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def versions_record() -> dict[str, str]:
    """Versions of Python and of the libraries on which heights may depend."""
    return {"python": sys.version.split()[0], **{name: _version(name) for name in LIBRARIES}}


@cache
def _version(name: str) -> str:
    """Version of an installed package. It is kept, because a run asks several times, and each takes a millisecond."""
    return version(name)


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Write a JSON file atomically. Numbers that are not finite, which JSON cannot hold, become null.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    text = json.dumps(finite_only({"schema": SCHEMA, **record}), indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


def read_record(path: Path) -> dict[str, Any]:
    """The JSON object in a file of a result.

    Raises
    ------
    InputError
        It is damaged, or an earlier version of zlocus wrote it, whose keys had other names.
    """
    record = read_json(path, advice="Make the surface again.")
    if not isinstance(record, dict):
        raise InputError(f"{path} holds no JSON object. Make the surface again.")
    if record.get("schema") == 1:
        raise InputError(
            f"{path} was written by an earlier version of zlocus (schema 1, and this version reads schema {SCHEMA}). "
            "Make the surface again, or use that version."
        )
    return record


def check_not_aligned(run: Mapping[str, Any], path: Path) -> None:
    """Refuse a surface that was moved after the run: its images show its cells at other places.

    run : content of run.json; path : of the file.

    Raises
    ------
    InputError
        The surface was aligned.
    """
    if "alignment" in run:
        raise InputError(
            f"{path} is of a surface that was moved by `zlocus align`, so that its cameras do not go with it any more. "
            f"Give the surface as it was before, {quoted(run['alignment'].get('surface'))}."
        )


def finite_only(value: Any) -> Any:
    """The value with every number that is not finite replaced by None, also inside tables and lists."""
    if isinstance(value, dict):
        return {key: finite_only(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite_only(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
