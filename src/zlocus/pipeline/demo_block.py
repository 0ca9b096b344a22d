"""The block of the demo: its specification, and whether a folder holds it already."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from zlocus.core.errors import InputError
from zlocus.io.run_record import read_record, versions_record

if TYPE_CHECKING:
    from zlocus.synthetic.linescan import TrajectoryNoise
    from zlocus.synthetic.scenes import SceneSpec

# Name of the digest in the record beside a rendered block.
DIGEST = "scene_sha256"


def block_digest(spec: SceneSpec, noise: TrajectoryNoise) -> str:
    """Digest of everything that a rendered block follows from: equal digests mean the same images."""
    return hashlib.sha256(repr((spec, noise, versions_record())).encode()).hexdigest()


def is_block_of(record: Path, digest: str) -> bool:
    """Whether a block was rendered completely, and from the same specification. record : JSON file beside it."""
    with suppress(InputError):  # damaged
        return bool(read_record(record).get(DIGEST) == digest)
    return False
