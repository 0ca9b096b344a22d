"""Restore the match scene of a finished run from run.json and the observations that the run wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from zlocus.core.errors import InputError
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress, SilentProgress
from zlocus.core.requests import DsmRequest, SetupRequest
from zlocus.io.config import config_from_dict
from zlocus.io.open_raster import is_remote
from zlocus.pipeline.fingerprint import digest_of
from zlocus.pipeline.report_inputs import ReportedRun
from zlocus.pipeline.setup import open_inputs, orient_views, set_up_run
from zlocus.products.report.file_names import RECORD
from zlocus.products.tie_observations import OBSERVATIONS, read_observations

# Fields of a request that name files. --vertical and --dem-vertical may name files, too.
FILES = ("like", "area", "mask", "dem")
DATUMS = ("vertical", "dem_vertical")


@dataclass(frozen=True)
class Restored:
    """The scene of a finished run.

    is_same : whether cameras, heights and grey values are the same as in the run; None where the run recorded no
    fingerprint.
    """

    run: ReportedRun
    config: RunConfig
    is_same: bool | None


def restored(
    out: Path, run: Mapping[str, Any], may_read_remote: bool = False, progress: Progress | None = None
) -> Restored:
    """Restore the scene of the run in a folder.

    run : content of run.json; may_read_remote : whether images that it names on a server may be read.

    Raises
    ------
    InputError
        An image or another file of the run was moved, or the observations of the ties are missing.
    ConfigError, GeometryError
        run.json is not what a run writes.
    """
    request, config, progress = request_of(out, run), config_of(out, run), progress or SilentProgress()
    remote = [each["path"] for each in run["inputs"] if is_remote(Path(each["path"]))]
    remote += [str(path) for path in request.inputs if is_remote(path)]
    if remote and not may_read_remote:
        raise InputError(
            f"The run read {remote[0]} from a server, which is not read again without permission. Add --remote to see "
            "match curves."
        )
    opened = open_inputs(SetupRequest.of(request), progress)
    ties = read_observations(out, len(opened.scene.views))
    if ties is None and run["orientation"].get("n_ties"):
        raise InputError(
            f"{out / OBSERVATIONS} is missing or damaged. The cameras of the run cannot be restored without it. "
            "Make the surface again."
        )
    orientation = orient_views(opened.scene, config.orientation, progress, known_ties=ties)
    setup = set_up_run(SetupRequest.of(request), opened, orientation, config, progress)
    known = run.get("setup_sha256")
    is_same = None if known is None else digest_of(setup.match_scene, orientation) == known
    return Restored(ReportedRun.of(setup, opened.vertical_datum), config, is_same)


def config_of(out: Path, run: Mapping[str, Any]) -> RunConfig:
    """Options of a run."""
    return config_from_dict(run["config"]["options"], str(out / RECORD))


def request_of(out: Path, run: Mapping[str, Any]) -> DsmRequest:
    """Request of a run, with the present paths of its files.

    Raises
    ------
    InputError
        run.json is not what a run writes.
    """
    values = dict(run["config"]["request"])
    base = folder_of(out, run)

    def placed(path: str) -> str:
        return path if is_remote(Path(path)) else str(base / path)

    try:
        values["inputs"] = [placed(path) for path in values["inputs"]]
        for name in FILES:
            values[name] = None if values.get(name) is None else placed(values[name])
        for name in DATUMS:
            if (value := values.get(name)) is not None and (base / value).is_file():
                values[name] = placed(value)
        known = {field.name for field in fields(DsmRequest)}
        values = {name: value for name, value in values.items() if name in known} | {"out": out, "overwrite": False}
        return TypeAdapter(DsmRequest).validate_python(values)
    except (KeyError, TypeError, AttributeError, ValidationError) as error:
        raise InputError(f"{out / RECORD} does not hold the request of the run. Make the surface again.") from error


def folder_of(out: Path, run: Mapping[str, Any]) -> Path:
    """Folder where relative paths of a run start: the one in which the run was started, or the one that holds them now.

    Where the output folder was moved together with the images, the latter is found by the same relative path.
    """
    started, asked = run.get("started_in"), Path(str(run["config"]["request"]["out"]))
    candidates = [Path(started)] if isinstance(started, str) else []
    place, n = out.resolve(), len(asked.parts)
    if not asked.is_absolute() and ".." not in asked.parts and place.parts[len(place.parts) - n :] == asked.parts:
        candidates.append(place.parents[n - 1] if n else place)
    candidates.append(Path.cwd())
    local = [Path(each["path"]) for each in run["inputs"] if not is_remote(Path(each["path"]))]
    for folder in candidates:
        if all(_is_file(folder / path) for path in local):
            return folder
    return candidates[0]


def _is_file(path: Path) -> bool:
    """Whether a file exists; False for names that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
