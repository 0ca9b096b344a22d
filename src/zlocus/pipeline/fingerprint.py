"""Fingerprint of everything the tiles depend on. Equal fingerprints mean identical tiles."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import zlocus
from zlocus.core.jit import kernels_digest
from zlocus.core.options import RunConfig
from zlocus.core.requests import CloudRequest, DsmRequest
from zlocus.io.config import config_as_dict
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import versions_record
from zlocus.matching.match_scene import MatchScene
from zlocus.orientation.orientation import Orientation

COMMANDS = {DsmRequest: "zlocus dsm", CloudRequest: "zlocus cloud"}
# Fields of a request that change no tile.
WITHOUT_EFFECT = (
    "out",
    "workers",
    "memory_gb",
    "scheduler",
    "partial",
    "overwrite",
    "resume",
    "products",
    "copc",
    "report",
    "inputs",
)


def key_of(request: DsmRequest | CloudRequest, config: RunConfig, inputs: InputFiles) -> dict[str, Any]:
    """Command, options, versions, kernels and inputs (their size and time of change when the run began), by name.

    The content of images is not read for it, because that would take as long as matching; `run.json` holds checksums.
    """
    asked = {f.name: getattr(request, f.name) for f in fields(request) if f.name not in WITHOUT_EFFECT}
    return {
        "command": COMMANDS[type(request)],
        "versions": versions_record(),
        "kernels": kernels_of_package(),
        "request": {name: str(value) if isinstance(value, Path) else value for name, value in asked.items()},
        "options": config_as_dict(config),
        "inputs": dict(inputs.states),
    }


def kernels_of_package() -> str:
    """Digest of the sources of all compiled kernels."""
    return kernels_digest(Path(zlocus.__file__).parent)


def digest_of(match_scene: MatchScene, orientation: Orientation) -> str:
    """SHA-256 of the run setup: corrections of cameras, lattices, grey values and tie points."""
    lattice = [*match_scene.anchor, match_scene.cell_size, match_scene.height_origin, match_scene.height_step]
    setup = {
        "orientation": orientation.as_dict(),
        "names": [view.name for view in match_scene.views],
        "lattice": [*lattice, match_scene.n_steps, match_scene.levels, match_scene.expected_range],
        "overlap": vars(match_scene.overlap_window),
        "grey": [[scale.mean, scale.contrast, str(scale.trend)] for scale in match_scene.grey_scales],
    }
    digest = hashlib.sha256(json.dumps(setup, sort_keys=True).encode())
    lines = match_scene.break_lines
    of_lines = () if lines is None else (lines.jumps, lines.held)
    for array in (match_scene.ties, match_scene.dem_limits, match_scene.trusted_ties, *of_lines):
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def digest_of_images(match_scenes: Sequence[MatchScene], orientation: Orientation) -> str:
    """SHA-256 of the run setup of several reference images, see `digest_of`."""
    digests = [digest_of(match_scene, orientation) for match_scene in match_scenes]
    return hashlib.sha256("".join(digests).encode()).hexdigest()
