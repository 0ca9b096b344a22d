"""The command that makes a surface again, put together from its run.json."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields
from typing import Any

from zlocus.core.requests import DEFAULT_PRODUCTS, DsmRequest
from zlocus.products.report.tables import known_options, nested_values

# Fields of a request whose options have other names.
OPTION_NAMES = {"memory_gb": "memory"}
# Options that are switched off by a word in front.
SWITCHED_OFF = {"report", "resume"}
# What is said of the run, and makes no other surface: a copied command overwrites nothing.
LEFT_OUT = {"inputs", "out", "overwrite", "workers", "scheduler"}


def command_line(run: Mapping[str, Any]) -> str:
    """`zlocus dsm` with the inputs and all options that are not the default ones. run : content of run.json."""
    request = run["config"]["request"]
    words = ["zlocus", "dsm", *request["inputs"], "-o", str(request["out"])]
    defaults = {field.name: field.default for field in fields(DsmRequest) if field.default is not MISSING}
    for name, default in defaults.items():
        value = request.get(name, default)
        if name not in LEFT_OUT and _plain(value) != _plain(default):
            words += _option(name, value)
    return shlex.join([*words, *_settings(run["config"]["options"])])


def _plain(value: Any) -> Any:
    """A value as JSON has it."""
    return list(value) if isinstance(value, tuple) else value


def _option(name: str, value: Any) -> list[str]:
    """The words of an option that is not the default one."""
    option = f"--{OPTION_NAMES.get(name, name).replace('_', '-')}"
    if name == "products":
        return [option, ",".join(each for each in value if each not in DEFAULT_PRODUCTS) if value else "none"]
    if isinstance(value, bool):
        return [f"--no-{name}" if name in SWITCHED_OFF else option]
    return [option, *(f"{each:.12g}" if isinstance(each, float) else str(each) for each in _as_list(value))]


def _as_list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _settings(options: Mapping[str, Any]) -> Iterator[str]:
    """--set of every option of a stage that is not the default one."""
    known = {name: default for name, default, _ in known_options()}
    for name, value in nested_values(options):
        if name in known and _plain(value) != _plain(known[name]):
            text = value if isinstance(value, str) else json.dumps(value)
            yield from ("--set", f"{name}={text}")
