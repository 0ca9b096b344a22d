"""Fields of options classes: each with a sentence, a unit and an allowed range."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, fields, replace
from typing import Any, TypeVar

from zlocus.core.errors import ConfigError

Options = TypeVar("Options", bound=Any)


def option(default: Any, doc: str, *, low: float | None = None, high: float | None = None,
           choices: tuple[Any, ...] | None = None, unit: str = "") -> Any:  # fmt: skip
    """A dataclass field with its sentence, unit and allowed range (inclusive). choices : of each element of a tuple."""
    meta = {"doc": doc, "low": low, "high": high, "choices": choices, "unit": unit}
    return field(default=default, metadata=meta)


def option_by_method(ground: Any, depth: Any, doc: str, **limits: Any) -> Any:
    """A field that is unset by default, so that the method decides its value, and a value that the user sets stays.

    ground, depth : its value on the ground grid, and for depths in image space; limits : see `option`.
    """
    decided = f"Unset: decided by the method, {ground:g} on the ground grid, {depth:g} for depths in image space."
    by_method = option(None, f"{doc} {decided}", **limits)
    return field(default=None, metadata={**by_method.metadata, "ground": ground, "depth": depth})


def value_of(options: Any, name: str) -> Any:
    """The value of an option: as set, else as the method decides on the ground grid."""
    value = getattr(options, name)
    if value is not None:
        return value
    return next(f.metadata.get("ground") for f in fields(options) if f.name == name)


def with_depth_values(options: Options) -> Options:
    """The options with the values for depths in image space where they are unset."""
    unset = {
        f.name: f.metadata["depth"]
        for f in fields(options)
        if "depth" in f.metadata and getattr(options, f.name) is None
    }
    return replace(options, **unset)


def group(factory: Callable[[], Any], doc: str) -> Any:
    """A nested stage."""
    return field(default_factory=factory, metadata={"doc": doc})


class Checked:
    """Range checks from the fields' metadata."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value, meta = getattr(self, f.name), f.metadata
            if value is None or "doc" not in meta:
                continue
            low, high, choices = meta.get("low"), meta.get("high"), meta.get("choices")
            where = f"{type(self).__name__}.{f.name}"
            for each in value if isinstance(value, tuple) else (value,):
                if choices is not None and each not in choices:
                    raise ConfigError(f"{where} = {each!r} is not one of {', '.join(map(str, choices))}.")
            if (low is not None and not value >= low) or (high is not None and not value <= high):
                allowed = f"{'-inf' if low is None else low} to {'inf' if high is None else high}"
                raise ConfigError(
                    f"{where} = {value!r} is outside its range {allowed} {meta.get('unit', '')}".rstrip() + "."
                )
