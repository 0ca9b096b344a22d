"""Rates of this machine: how long runs took, against what is typical, remembered beside the compiled kernels.

The estimate of a part of a run (orientation, matching, writing) is made from typical rates. Each run that ends
remembers by which factor it took longer, so that the next plan can say how long this machine will take. Rates are
remembered for each kind of sensor, and are lost with the kernels when their sources change, because speed may change
too.
"""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import OutputError
from zlocus.core.jit import CACHE
from zlocus.core.progress import duration
from zlocus.core.scene import View
from zlocus.io.atomic_write import write_atomically
from zlocus.pipeline.execution.plan import CELL_S, VIEW_CELL_S

# Environment variable with the file of the rates; where it is empty, nothing is remembered.
VARIABLE, NAME = "ZLOCUS_RATES", "rates.json"
SCHEMA = 1
# Runs whose factors are kept: the factor used is their median, which a run beside other work does not move.
MAX_RUNS = 15
# Parts that take less time say nothing of a rate.
MIN_MEASURED_S = 5.0
# Factors beyond these limits come from a machine that slept, or from a damaged file.
FACTORS = (0.01, 100.0)
# Typical times of the other parts: of the orientation for each pixel of an image, on one core; of writing for each cell
# of a surface, and for each pixel of the maps of a cloud.
ORIENT_PIXEL_S, WRITE_CELL_S, WRITE_PIXEL_S = 6e-6, 3e-6, 1.5e-6


@dataclass(frozen=True)
class Rate:
    """By which factor this machine takes longer than is typical, and the number of runs that say so."""

    factor: float = 1.0
    n_runs: int = 0

    def __str__(self) -> str:
        if not self.n_runs:
            return "typical rate"
        return f"rate measured on {self.n_runs} earlier run{'s' if self.n_runs > 1 else ''} of this machine"

    def said(self, what: str, typical_s: float) -> str:
        """The time of a part of a run with its source, as a clause. what : the part."""
        return f"{what} about {duration(self.factor * typical_s)} ({self})"


TYPICAL = Rate()


def rates_file() -> Path | None:
    """The file of the rates; None where nothing is to be remembered, or no folder lasts."""
    named = os.environ.get(VARIABLE)
    if named is not None:
        return Path(named) if named else None
    return None if CACHE.folder is None or CACHE.temporary is not None else CACHE.folder / NAME


def kind_of(views: Sequence[View]) -> str:
    """The kinds of sensor models of some views, by the names of their classes; corrections of cameras do not count."""
    kinds = set()
    for view in views:
        sensor = view.sensor
        while hasattr(sensor, "base_sensor"):
            sensor = sensor.base_sensor
        kinds.add(type(sensor).__name__)
    return " and ".join(sorted(kinds))


def rate_of(part: str, kind: str) -> Rate:
    """The rate of a part of runs with a kind of sensor; the typical one where no run is remembered."""
    factors = _factors().get(f"{part}, {kind}", [])
    return Rate(statistics.median(factors), len(factors)) if factors else TYPICAL


def remember(part: str, kind: str, typical_s: float, measured_s: float) -> None:
    """Remember how long a part of a run took. typical_s : its estimate at the typical rate.

    Short parts are not remembered. Where the file cannot be written, nothing is: a plan is never worth a run.
    """
    path = rates_file()
    if path is None or not (typical_s > 0 and measured_s >= MIN_MEASURED_S):
        return
    factor = measured_s / typical_s
    if not FACTORS[0] <= factor <= FACTORS[1]:
        return
    found, name = _factors(), f"{part}, {kind}"
    found[name] = [*found.get(name, []), round(factor, 4)][-MAX_RUNS:]
    text = json.dumps({"schema": SCHEMA, "typical_s": _typical(), "factors": found}, indent=1)
    try:
        write_atomically(path, lambda part_path: part_path.write_text(text, encoding="utf-8"))
    except (OutputError, OSError):
        return


def _typical() -> list[float]:
    """The typical rates that factors refer to."""
    return [CELL_S, VIEW_CELL_S, ORIENT_PIXEL_S, WRITE_CELL_S, WRITE_PIXEL_S]


def _factors() -> dict[str, list[float]]:
    """The remembered factors by part and kind; empty where the file is missing, damaged, or of other typical rates."""
    path = rates_file()
    try:
        found = json.loads(path.read_text(encoding="utf-8")) if path is not None else {}
        if found.get("schema") != SCHEMA or found["typical_s"] != _typical():
            return {}
        known = {str(name): [float(v) for v in values] for name, values in found["factors"].items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}
    good = {name: [v for v in values if FACTORS[0] <= v <= FACTORS[1]] for name, values in known.items()}
    return {name: values[-MAX_RUNS:] for name, values in good.items() if not any(map(math.isnan, values))}
