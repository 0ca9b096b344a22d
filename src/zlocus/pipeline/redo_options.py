"""What a part of a surface is redone with: the request and the options of its run, with those that differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

from zlocus.core.errors import ConfigError
from zlocus.core.options import RunConfig
from zlocus.core.redo_request import RedoRequest
from zlocus.core.requests import DsmRequest
from zlocus.io.config import config_as_dict, values_of_file
from zlocus.io.run_record import request_as_dict
from zlocus.io.settings import with_settings
from zlocus.pipeline.recorded_run import config_of, request_of
from zlocus.products.report.file_names import RECORD

# What stays as it is in the run: the grid, the area, the heights' datum, and its water.
OF_GRID = ("crs", "bounds", "like", "area", "mask", "vertical")
OF_WATER = ("water", "water_level", "level_water")
# What may differ, and what is of this command alone.
OF_MATCHING = ("heights", "dem", "dem_vertical", "reference", "views", "method", "selection", "fill")
OF_COMMAND = ("inputs", "workers", "scheduler", "memory_gb", "resume", "partial")
# Groups of options that stay as they are: cameras, water, and products.
KEPT_GROUPS = ("orientation", "water", "products")


def redo_request(request: RedoRequest, run: Mapping[str, Any]) -> DsmRequest:
    """The request with which a part is matched. run : content of run.json.

    An option that is not given, or has its default value, is that of the run. The grid is that of the run, whatever
    told it.

    Raises
    ------
    ConfigError
        An option differs that has to be that of the run, or the part would be matched in image space.
    """
    given, recorded = request.dsm_request, request_of(request.dsm_request.out / RECORD, run)
    of_run = {name: getattr(recorded, name) for name in (*OF_GRID, *OF_WATER)}
    for name in (*OF_GRID, *OF_WATER):
        if _is_given(given, name) and not _same(getattr(given, name), of_run[name]):
            raise ConfigError(
                f"--{name.replace('_', '-')} {_text(getattr(given, name))} is not that of the run in {given.out} "
                f"({_text(of_run[name])}), which --redo keeps. Leave it out."
            )
    cell_m = float(run["grid"]["transform"][0])
    if given.resolution is not None and abs(given.resolution - cell_m) > 1e-6 * cell_m:
        raise ConfigError(
            f"--resolution {given.resolution:g} is not that of the run in {given.out} ({cell_m:g} m), which --redo "
            "keeps. Leave it out."
        )
    matching = {name: getattr(given if _is_given(given, name) else recorded, name) for name in OF_MATCHING}
    for one, other in (("heights", "dem"), ("dem", "heights")):
        if _is_given(given, one) and not _is_given(given, other):
            matching[other] = None
    if matching["dem"] is None:
        matching["dem_vertical"] = None
    merged = replace(
        recorded, **matching, **{name: getattr(given, name) for name in OF_COMMAND}, out=given.out,
        resolution=None if recorded.like is not None else cell_m, overwrite=False,
    )  # fmt: skip
    if merged.is_in_image_space and request.level is None:
        raise ConfigError(
            f"--redo matches on the ground grid, and not by --method {merged.method}. Add --method mvll-sgm."
        )
    if request.break_lines is not None and merged.method != "mvll-sgm":
        raise ConfigError(
            f"--break-lines need the semi-global constraint, and --method {merged.method} has none. Give mvll-sgm."
        )
    return merged


def redo_config(request: RedoRequest, run: Mapping[str, Any]) -> RunConfig:
    """The options with which a part is matched: those of the run, with those that are given in place of them.

    Raises
    ------
    ConfigError
        An option is not known, or one of the cameras, of water or of products differs from that of the run.
    """
    of_run = config_as_dict(config_of(request.dsm_request.out / RECORD, run))
    values = dict(of_run) if request.config is None else values_of_file(request.config)
    config = with_settings(
        {group: dict(options) if isinstance(options, dict) else options for group, options in values.items()},
        str(request.config or request.dsm_request.out / RECORD), request.settings,
    )  # fmt: skip
    if request.config is not None:  # which says nothing of these groups, unless it names them
        kept = {group: of_run[group] for group in KEPT_GROUPS if group not in values}
        config = with_settings(config_as_dict(config) | kept, str(request.config), ())
    now = config_as_dict(config)
    for group in KEPT_GROUPS:
        for name, value in now[group].items():
            if value != of_run[group].get(name):
                raise ConfigError(
                    f"{group}.{name} = {value} is not that of the run in {request.dsm_request.out} "
                    f"({of_run[group].get(name)}), which --redo keeps. Leave it out."
                )
    return config


def differing(request: DsmRequest, config: RunConfig, run: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The options of the matching that differ from those of the run, by their names: what they were, and are."""
    asked, then = request_as_dict(request), run["config"]["request"]
    found = {
        name: {"was": then.get(name), "is": _plain(asked[name])}
        for name in OF_MATCHING
        if not _same(_plain(asked[name]), then.get(name))
    }
    now, before = config_as_dict(config), run["config"]["options"]
    for group, options in now.items():
        for name, value in options.items():
            if value != before.get(group, {}).get(name):
                found[f"{group}.{name}"] = {"was": before.get(group, {}).get(name), "is": value}
    return found


def _is_given(request: DsmRequest, name: str) -> bool:
    """Whether a field of a request has another value than where nothing is said."""
    (default,) = (field.default for field in fields(request) if field.name == name)
    return bool(default is MISSING or getattr(request, name) != default)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _same(one: Any, other: Any) -> bool:
    """Whether two values of an option are the same; files are by their true places."""
    one, other = _plain(one), _plain(other)
    if one is None or other is None or not isinstance(one, str | Path) or not isinstance(other, str | Path):
        return bool(one == other)
    return str(one) == str(other) or (Path(one).exists() and Path(one).resolve() == Path(other).resolve())


def _text(value: Any) -> str:
    return "not given" if value is None else " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
