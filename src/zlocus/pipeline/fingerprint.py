"""What the tiles of a run depend on: two runs with the same of it have the same tiles."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.options import RunConfig
from zlocus.core.requests import DsmRequest
from zlocus.io.config import config_as_dict
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import versions_record
from zlocus.matching.match_scene import MatchScene
from zlocus.orientation.orientation import Orientation

# What changes no tile.
APART = ("out", "workers", "memory_gb", "scheduler", "partial", "overwrite", "resume", "products", "report", "inputs")


def key_of(request: DsmRequest, config: RunConfig, inputs: InputFiles) -> dict[str, Any]:
    """Options, versions and inputs (size and time of change when the run began), by name.

    The content of images is not read for it, which would take as long as matching; `run.json` has its checksum.
    """
    asked = {f.name: getattr(request, f.name) for f in fields(request) if f.name not in APART}
    return {
        "versions": versions_record(),
        "request": {name: str(value) if isinstance(value, Path) else value for name, value in asked.items()},
        "options": config_as_dict(config),
        "inputs": dict(inputs.states),
    }


def digest_of(settled: MatchScene, orientation: Orientation) -> str:
    """SHA-256 of all that was found before the first tile: corrections, lattice, grey values, tie points."""
    found = {
        "orientation": orientation.as_dict(), "names": [view.name for view in settled.views],
        "lattice": [*settled.anchor, settled.cell_m, settled.origin_m, settled.step_m, settled.n_steps, settled.levels],
        "seen": vars(settled.seen), "grey": [[scale.mean, scale.contrast, str(scale.trend)] for scale in settled.grey],
    }  # fmt: skip
    digest = hashlib.sha256(json.dumps(found, sort_keys=True).encode())
    for array in (settled.ties, settled.prior):
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
