"""Fields of options classes: each with a sentence, a unit and an allowed range."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, fields
from typing import Any

from zlocus.core.errors import ConfigError


def option(default: Any, doc: str, *, low: float | None = None, high: float | None = None,
           choices: tuple[Any, ...] | None = None, unit: str = "") -> Any:  # fmt: skip
    """A dataclass field with its sentence, unit and allowed range (inclusive)."""
    meta = {"doc": doc, "low": low, "high": high, "choices": choices, "unit": unit}
    return field(default=default, metadata=meta)


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
            if choices is not None and value not in choices:
                raise ConfigError(f"{where} = {value!r} is not one of {', '.join(map(str, choices))}.")
            if (low is not None and not value >= low) or (high is not None and not value <= high):
                allowed = f"{'-inf' if low is None else low} to {'inf' if high is None else high}"
                raise ConfigError(
                    f"{where} = {value!r} is outside its range {allowed} {meta.get('unit', '')}".rstrip() + "."
                )
