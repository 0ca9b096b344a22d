"""The request and the options of a run, read back from its run.json, with the present paths of its files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from zlocus.core.errors import InputError
from zlocus.core.options import RunConfig
from zlocus.core.requests import CloudRequest, DsmRequest
from zlocus.io.config import config_from_dict
from zlocus.io.run_record import check_not_aligned
from zlocus.io.stored_files import is_remote

# Fields of a request that name files. --vertical and --dem-vertical may name files, too.
FILES = ("like", "area", "mask", "water", "dem")
DATUMS = ("vertical", "dem_vertical")
Request = TypeVar("Request", bound=DsmRequest | CloudRequest)


def config_of(record: Path, run: Mapping[str, Any]) -> RunConfig:
    """Options of a run. record : its run.json, for messages; run : the content.

    A cloud adapts the options to its images, and has those that it was given in `given_options`.
    """
    return config_from_dict(run.get("given_options", run["config"]["options"]), str(record))


def request_of(record: Path, run: Mapping[str, Any]) -> DsmRequest:
    """Request of the run of a surface, with the present paths of its files and the folder of its record as result.

    Raises
    ------
    InputError
        run.json is not what a run writes.
    """
    base = folder_of(record.parent, run)
    return request_with(record, run, DsmRequest, lambda path: base / path, {"out": record.parent, "overwrite": False})


def request_with(
    record: Path,
    run: Mapping[str, Any],
    kind: type[Request],
    place: Callable[[str], Path],
    others: Mapping[str, Any],
) -> Request:
    """Request of a run of a kind, with files at other places and other values of some fields.

    place : present place of a file, by its recorded path; others : values by name of the field.

    Raises
    ------
    InputError
        run.json is not what such a run writes, or its surface was moved since.
    """

    check_not_aligned(run, record)

    def placed(path: str) -> str:
        return path if is_remote(Path(path)) else str(place(path))

    try:
        values = dict(run["config"]["request"])
        values["inputs"] = [placed(path) for path in values["inputs"]]
        for name in FILES:
            if values.get(name) is not None:
                values[name] = placed(values[name])
        for name in DATUMS:
            if (value := values.get(name)) is not None and _is_file(place(value)):
                values[name] = placed(value)
        known = {field.name for field in fields(kind)}
        values = {name: value for name, value in values.items() if name in known} | dict(others)
        return TypeAdapter(kind).validate_python(values)
    except (KeyError, TypeError, AttributeError, ValidationError) as error:
        raise InputError(f"{record} does not hold the request of the run. Make the surface again.") from error


def folder_of(out: Path, run: Mapping[str, Any]) -> Path:
    """Folder where relative paths of a run start: the one in which the run was started, or the one that holds them now.

    Where the output folder was moved together with the images, the latter is found by the same relative path. Of
    several folders the one that holds most of the inputs counts.
    """
    started, asked = run.get("started_in"), Path(str(run["config"]["request"]["out"]))
    candidates = [Path(started)] if isinstance(started, str) else []
    place, n = out.resolve(), len(asked.parts)
    if not asked.is_absolute() and ".." not in asked.parts and place.parts[len(place.parts) - n :] == asked.parts:
        candidates.append(place.parents[n - 1] if n else place)
    candidates += [Path.cwd(), place]
    local = [Path(each["path"]) for each in run["inputs"] if not is_remote(Path(each["path"]))]
    return max(candidates, key=lambda folder: sum(_is_file(folder / path) for path in local))


def _is_file(path: Path) -> bool:
    """Whether a file exists; False for names that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
