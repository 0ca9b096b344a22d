"""Files that are whole or not there: they have a temporary name until all is written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Temporary name beside a file, under which it is to be written; at the end of the block it gets its own name.

    After an exception, a signal among them, nothing of it stays.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        with suppress(OSError):  # where it could not be made, or its folder has gone
            part.unlink(missing_ok=True)
