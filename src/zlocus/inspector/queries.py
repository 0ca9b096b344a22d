"""Checks of the parameters of requests: numbers in range, known names, and nothing else."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import Field, fields
from typing import Any, get_type_hints

from zlocus.core.errors import ConfigError
from zlocus.core.options import CostOptions, SelectionOptions
from zlocus.inspector.cell import WhatIf
from zlocus.inspector.folder import Patch

Pairs = Iterable[tuple[str, str]]
# Limits on the pixels of a picture and along its side, on the layers of a picture, and on the levels of the map.
MAX_PIXELS, MAX_SIDE_PX, MAX_LAYERS, MAX_LEVELS = 10_000_000, 4096, 8, 24
# Options that make an answer large have lower limits than in a run.
MAX_VALUES = {"reach_steps": 200, "max_candidates": 48, "nearest": 500, "max_images": 48, "min_images": 48}
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
# Patches may lie at most this far from the grid.
MAX_DISTANCE_CELLS = 1e7
# Coordinates are smaller than this in every frame.
MAX_COORDINATE_M = 1e9
PATCH = ("row", "col", "rows", "cols", "height", "width")
MAX_NUMBER_LENGTH = 40
SELECTION = {f.name: f for f in fields(SelectionOptions)}
KINDS = get_type_hints(SelectionOptions)
WINDOWS: tuple[int, ...] = next(f for f in fields(CostOptions) if f.name == "large_window").metadata["choices"]


class BadQuery(ConfigError):
    """A request with parameters that cannot be used."""


def once(pairs: Pairs, allowed: Iterable[str], repeated: str = "") -> tuple[dict[str, str], list[str]]:
    """Values by name, each given at most once, and the values of the one name that may be repeated.

    Raises
    ------
    BadQuery
        A name is not allowed, or is given twice.
    """
    values: dict[str, str] = {}
    many: list[str] = []
    known = set(allowed)
    for name, value in pairs:
        if name == repeated:
            many.append(value)
        elif name not in known:
            raise BadQuery(f"{name[:40]!r} is not a parameter of this request.")
        elif name in values:
            raise BadQuery(f"{name} is given twice.")
        else:
            values[name] = value
    return values, many


def number(values: Mapping[str, str], name: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number in a range.

    Raises
    ------
    BadQuery
        It is missing, not a finite number, or out of range.
    """
    text = values.get(name, "")
    value = float(text) if len(text) <= MAX_NUMBER_LENGTH and NUMBER.fullmatch(text) else math.nan
    if not (math.isfinite(value) and low <= value <= high):
        raise BadQuery(f"{name} must be a number{_between(low, high)}.")
    return value


def whole(values: Mapping[str, str], name: str, low: int, high: int) -> int:
    """A whole number in a range.

    Raises
    ------
    BadQuery
        It is missing, not whole, or out of range.
    """
    value = number(values, name, low, high)
    if value != int(value):
        raise BadQuery(f"{name} must be a whole number.")
    return int(value)


def patch(values: Mapping[str, str]) -> Patch:
    """The patch of a request: its part of the grid and the size of its picture."""
    far = MAX_DISTANCE_CELLS
    row, col = (number(values, name, -far, far) for name in PATCH[:2])
    rows, cols = (number(values, name, 1e-3, far) for name in PATCH[2:4])
    height, width = (whole(values, name, 1, MAX_SIDE_PX) for name in PATCH[4:])
    if height * width > MAX_PIXELS:
        raise BadQuery(f"A picture has at most {MAX_PIXELS} pixels.")
    return Patch(row, col, rows, cols, height, width)


def layer_and_opacity(text: str) -> tuple[str, float]:
    """Name and opacity of a layer, from NAME or NAME:OPACITY."""
    name, _, opacity = text.partition(":")
    return name, number({"opacity": opacity or "1"}, "opacity", 0.0, 1.0)


def what_if(values: Mapping[str, str], left_out: Iterable[str]) -> WhatIf:
    """Changed settings of a request: `reference`, `window`, and options of the selection by their names.

    Raises
    ------
    BadQuery
        A value has the wrong type, or is out of range.
    """
    window = whole(values, "window", min(WINDOWS), max(WINDOWS)) if "window" in values else None
    if window is not None and window not in WINDOWS:
        raise BadQuery(f"window must be one of {', '.join(map(str, WINDOWS))}.")
    chosen = {name: _option(values, SELECTION[name]) for name in values if name in SELECTION}
    return WhatIf(frozenset(left_out), values.get("reference"), window, chosen)


def _option(values: Mapping[str, str], option: Field[Any]) -> Any:
    low, high = option.metadata["low"], MAX_VALUES.get(option.name, option.metadata["high"])
    if KINDS[option.name] is str:
        return values[option.name]
    if KINDS[option.name] is int:
        return whole(values, option.name, low, high)
    return number(values, option.name, low, high)


def _between(low: float, high: float) -> str:
    return f" from {low:g} to {high:g}" if math.isfinite(low) and math.isfinite(high) else ""
