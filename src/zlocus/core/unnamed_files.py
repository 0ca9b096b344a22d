"""Arrays in unnamed files, which the system removes with the process."""

from __future__ import annotations

import tempfile
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import OutputError

Values = TypeVar("Values", bound=np.generic)


def on_disk(values: NDArray[Values], what: str) -> NDArray[Any]:
    """The same values, read-only, in a file: the system takes them into memory as they are needed.

    values : of any shape and type; what : they are, as the error message names them ("Features of the images").

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    try:
        with tempfile.TemporaryFile() as file:
            values.tofile(file)
            file.flush()
            return np.asarray(np.memmap(file, values.dtype, "r", shape=values.shape))
    except OSError as error:
        raise OutputError(
            f"{what} cannot be written to {tempfile.gettempdir()}: {error.strerror or error}. Make "
            "room there, or set TMPDIR to another folder."
        ) from error
