"""What the page may ask, checked: numbers in range, names that are known, nothing else."""

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
# Pixels of a picture, and along one side of it; layers over each other; levels of a map.
MOST_PX, MOST_SIDE_PX, MOST_LAYERS, MOST_LEVELS = 10_000_000, 4096, 8, 24
# Options that make an answer large are held below what a run may take.
MOST = {"reach_steps": 200, "max_candidates": 48, "nearest": 500, "max_images": 48, "min_images": 48}
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
# Cells from the grid at which something may still be asked for.
FARTHEST_CELLS = 1e7
# No coordinate is larger, in any frame.
FARTHEST_M = 1e9
PATCH = ("row", "col", "rows", "cols", "height", "width")
LONGEST_NUMBER = 40
SELECTION = {f.name: f for f in fields(SelectionOptions)}
KINDS = get_type_hints(SelectionOptions)
WINDOWS: tuple[int, ...] = next(f for f in fields(CostOptions) if f.name == "large_window").metadata["choices"]


class BadQuery(ConfigError):
    """Something was asked that cannot be answered."""


def once(pairs: Pairs, allowed: Iterable[str], repeated: str = "") -> tuple[dict[str, str], list[str]]:
    """Values by name, each at most once, and those of the one name that may be repeated.

    Raises
    ------
    BadQuery
        A name that is not allowed, or that is given twice.
    """
    values: dict[str, str] = {}
    many: list[str] = []
    known = set(allowed)
    for name, value in pairs:
        if name == repeated:
            many.append(value)
        elif name not in known:
            raise BadQuery(f"{name[:40]!r} is nothing that can be asked here.")
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
        It is missing, no number, not finite, or out of range.
    """
    text = values.get(name, "")
    value = float(text) if len(text) <= LONGEST_NUMBER and NUMBER.fullmatch(text) else math.nan
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
    """A part of the grid and the size of its picture: row, col, rows, cols, height, width."""
    far = FARTHEST_CELLS
    row, col = (number(values, name, -far, far) for name in PATCH[:2])
    rows, cols = (number(values, name, 1e-3, far) for name in PATCH[2:4])
    height, width = (whole(values, name, 1, MOST_SIDE_PX) for name in PATCH[4:])
    if height * width > MOST_PX:
        raise BadQuery(f"A picture has {MOST_PX} pixels at most.")
    return Patch(row, col, rows, cols, height, width)


def layer_and_opacity(text: str) -> tuple[str, float]:
    """A layer's name and its opacity, of NAME or NAME:OPACITY."""
    name, _, opacity = text.partition(":")
    return name, number({"opacity": opacity or "1"}, "opacity", 0.0, 1.0)


def what_if(values: Mapping[str, str], left_out: Iterable[str]) -> WhatIf:
    """What is to be changed: `reference`, `window`, and options of the selection by their names.

    Raises
    ------
    BadQuery
        A value that is not of the option's kind, or out of its range.
    """
    window = whole(values, "window", min(WINDOWS), max(WINDOWS)) if "window" in values else None
    if window is not None and window not in WINDOWS:
        raise BadQuery(f"window must be one of {', '.join(map(str, WINDOWS))}.")
    chosen = {name: _option(values, SELECTION[name]) for name in values if name in SELECTION}
    return WhatIf(frozenset(left_out), values.get("reference"), window, chosen)


def _option(values: Mapping[str, str], option: Field[Any]) -> Any:
    low, high = option.metadata["low"], MOST.get(option.name, option.metadata["high"])
    if KINDS[option.name] is str:
        return values[option.name]
    if KINDS[option.name] is int:
        return whole(values, option.name, low, high)
    return number(values, option.name, low, high)


def _between(low: float, high: float) -> str:
    return f" from {low:g} to {high:g}" if math.isfinite(low) and math.isfinite(high) else ""
