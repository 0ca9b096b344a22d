"""Single options of the command line, such as `selection.order=labels`, in place of those of a configuration file."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from zlocus.core.errors import ConfigError
from zlocus.core.options import RunConfig
from zlocus.io.config import config_from_dict, values_of_file

EXAMPLE = "--set selection.order=labels"


def config_with_settings(path: Path | None, settings: Sequence[str]) -> RunConfig:
    """The configuration in a file, the default one for None, in which single options are replaced.

    settings : texts `NAME=VALUE`; the name contains its groups, separated by dots; the value is one of TOML, or a text
    without quotation marks; an empty value is the default one. Later settings replace earlier ones.

    Raises
    ------
    ConfigError
        A text is no setting, an option is not known, or its value cannot be used.
    """
    return with_settings({} if path is None else values_of_file(path), str(path), settings)


def with_settings(values: dict[str, Any], where: str, settings: Sequence[str]) -> RunConfig:
    """The configuration with some values, in which single options are replaced.

    values : as in a configuration file, and changed; where : their source, for messages; settings, errors : see
    `config_with_settings`.
    """
    config_from_dict(values, where)  # faults of the values are told with their source
    for text in settings:
        name, value = _parsed(text)
        config_from_dict({} if value is None else _put({}, name, value), f"--set {text}")
        _put(values, name, value)
    return config_from_dict(values, f"{where} with --set" if values else "--set")


def _parsed(text: str) -> tuple[list[str], Any]:
    """The name of a setting, split at its dots, and its value; None for an empty one."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ConfigError(f"--set {text} is no setting. Give the name of an option and its value, as in {EXAMPLE}.")
    return [part.strip() for part in name.split(".")], _value(value.strip())


def _value(text: str) -> Any:
    """A value of TOML, the text itself where it is none, None where it is empty."""
    if not text:
        return None
    try:
        found = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return found["value"] if list(found) == ["value"] else text


def _put(values: dict[str, Any], name: Sequence[str], value: Any) -> dict[str, Any]:
    """Put a value into nested groups, or take it out for None, and return all of them."""
    *groups, last = name
    inner = values
    for group in groups:
        inner = inner.setdefault(group, {})
    if value is None:
        inner.pop(last, None)
    else:
        inner[last] = value
    return values
