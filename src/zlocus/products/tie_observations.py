"""observations.npz: image positions of the tie points, from which a run's corrected cameras can be computed again."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np

from zlocus.io.atomic_write import write_atomically
from zlocus.orientation.tie_refinement import RefinedTies

OBSERVATIONS = "observations.npz"


def write_observations(folder: Path, refined_ties: RefinedTies) -> None:
    """Write the observations of a run into its folder.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    content = io.BytesIO()
    np.savez_compressed(content, **refined_ties.arrays())  # type: ignore[arg-type]
    write_atomically(folder / OBSERVATIONS, lambda part: part.write_bytes(content.getbuffer()))


def read_observations(folder: Path, n_views: int) -> RefinedTies | None:
    """Observations that `write_observations` wrote, of a scene with `n_views` views; None where missing or damaged."""
    try:
        with np.load(folder / OBSERVATIONS, allow_pickle=False) as file:
            return RefinedTies.of(dict(file), n_views)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
