"""The configuration file: written as complete commented TOML, read from strict TOML or YAML."""

from __future__ import annotations

import difflib
import json
import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.options import RunConfig
from zlocus.core.options.renamed_keys import REMOVED_KEYS, RENAMED_KEYS
from zlocus.io.safe_documents import read_yaml
from zlocus.io.safe_text import check_last_line_ended, read_text

COMMENT_WIDTH = 100
# A complete configuration has a tenth of this.
MAX_CONFIG_BYTES = 200_000
HEADING = "# Every option of zlocus, in TOML. What is left out keeps its default; read with --config FILE.toml."
# Types of options, as users call them.
KIND_WORDS: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
T = TypeVar("T")


def config_as_dict(config: Any) -> dict[str, Any]:
    """All options as nested plain values, as `run.json` holds them. None means unset."""
    values: dict[str, Any] = {}
    for f in fields(config):
        value = getattr(config, f.name)
        values[f.name] = (
            config_as_dict(value) if is_dataclass(value) else list(value) if isinstance(value, tuple) else value
        )
    return values


def config_from_dict(values: Mapping[str, Any], where: str) -> RunConfig:
    """The configuration with these values; options that they leave out keep their defaults.

    where : source of the values, for messages.

    Raises
    ------
    ConfigError
        A key is unknown, or a value is of the wrong type or out of range.
    """
    return _build(RunConfig, values, where, prefix="")


def read_config(path: Path) -> RunConfig:
    """The configuration in a TOML file, or in a YAML file if its name ends in .yaml or .yml.

    Raises
    ------
    ConfigError
        The file cannot be read; see also `config_from_dict`.
    """
    return config_from_dict(values_of_file(path), str(path))


def values_of_file(path: Path) -> Any:
    """The values in a configuration file, as they stand there.

    Raises
    ------
    ConfigError
        The file cannot be read.
    """
    try:
        is_yaml = path.suffix.lower() in (".yaml", ".yml")
        values = read_yaml(path, MAX_CONFIG_BYTES) if is_yaml else _read_toml(path)
    except InputError as error:
        raise ConfigError(f"{error} `zlocus config -o FILE` writes a complete one.") from error
    return {} if values is None else values


def _read_toml(path: Path) -> dict[str, Any]:
    text = read_text(path, MAX_CONFIG_BYTES)
    check_last_line_ended(text.rstrip(" \t"), path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a valid configuration file: {' '.join(str(error).split())}.") from error


def write_config(config: RunConfig) -> str:
    """All options as commented TOML text. `read_config` returns an equal configuration for it."""
    return "\n".join([HEADING, *_lines(config, prefix="")]) + "\n"


def _build(kind: type[T], values: Any, where: str, prefix: str) -> T:
    """An options class from plain values, the groups of options inside it first."""
    if not isinstance(values, Mapping):
        name = f"{where}: {prefix.rstrip('.')}" if prefix else where
        raise ConfigError(f"{name} must hold named options, not {values!r}. See `zlocus config`.")
    known = {f.name: f for f in fields(kind)}  # type: ignore[arg-type]
    types = get_type_hints(kind)
    chosen: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            _check_renamed(f"{prefix}{name}", value, where)
            raise ConfigError(_unknown(str(name), list(known), where, prefix))
        if is_dataclass(types[name]):
            chosen[name] = _build(types[name], value, where, f"{prefix}{name}.")
        else:
            chosen[name] = _typed(types[name], value, f"{where}: {prefix}{name}")
    try:
        return kind(**chosen)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


def _typed(kind: Any, value: Any, where: str) -> Any:
    """`value` as the type of its option. An integer is accepted for a float and a list for a tuple, nothing else."""
    try:
        # For JSON, pydantic's strict mode accepts lists for tuples, which is what TOML and YAML can express.
        return TypeAdapter(kind).validate_json(json.dumps(value), strict=True)
    except (ValidationError, TypeError) as error:
        raise ConfigError(f"{where} = {value!r} is of the wrong type: {_in_words(kind)} is needed.") from error


def _in_words(kind: Any) -> str:
    """A type of an option, as a user calls it. An option that may be unset has the type of its values."""
    kinds = [part for part in get_args(kind) if part is not NoneType] if isinstance(kind, UnionType) else [kind]
    return " or ".join(KIND_WORDS.get(each, "a list of texts") for each in kinds)


def _check_renamed(key: str, value: Any, where: str) -> None:
    """Refuse a key that earlier versions used, with the key that replaces it or the value that always applies.

    key : with the names of its groups; value : where it is a group, the first of its old keys is named.

    Raises
    ------
    ConfigError
        The key, or one inside it, was renamed or removed.
    """
    inside = [f"{key}.{name}" for name in value] if isinstance(value, Mapping) else []
    for old in (*inside, key):
        if old in RENAMED_KEYS:
            raise ConfigError(f"{where}: {old} is now called {RENAMED_KEYS[old]}. Rename it in the file.")
        if old in REMOVED_KEYS:
            raise ConfigError(f"{where}: {old} is no longer an option; {REMOVED_KEYS[old]}. Remove it from the file.")


def _unknown(name: str, known: list[str], where: str, prefix: str) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    advice = f"Did you mean {prefix}{near[0]}?" if near else f"Known here: {', '.join(known)}."
    return f"{where}: {prefix}{name} is not an option. {advice}"


def _lines(options: Any, prefix: str) -> Iterator[str]:
    """The lines of a group of options: its own options first, as TOML requires, then the groups inside it."""
    stages = [f for f in fields(options) if is_dataclass(getattr(options, f.name))]
    for f in fields(options):
        if f not in stages:
            yield from _option_lines(f, getattr(options, f.name))
    for f in stages:
        yield ""
        yield from _comment(f.metadata["doc"])
        yield f"[{prefix}{f.name}]"
        yield from _lines(getattr(options, f.name), f"{prefix}{f.name}.")


def _option_lines(f: Field[Any], value: Any) -> Iterator[str]:
    yield ""
    yield from _comment(f"{f.metadata['doc']} {_allowed(f.metadata)}".rstrip())
    yield f"# {f.name} =   (unset)" if value is None else f"{f.name} = {_toml(value)}"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, COMMENT_WIDTH, initial_indent="# ", subsequent_indent="# ")


def _allowed(meta: Mapping[str, Any]) -> str:
    """Range and unit of an option, in brackets; empty where it has neither."""
    low, high, unit, choices = meta.get("low"), meta.get("high"), meta.get("unit", ""), meta.get("choices")
    limits = ""
    if choices is not None:
        limits = " | ".join(map(str, choices))
    elif None not in (low, high):
        limits = f"{low} to {high}"
    elif low is not None or high is not None:
        limits = f"at least {low}" if high is None else f"at most {high}"
    text = f"{limits} {unit}".strip()
    return f"[{text}]" if text else ""


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)
