"""Write files atomically: a file has a temporary name until all of it is written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` to write to; at the end of the block the file is renamed to `path`.

    After an exception, including those that signals raise, the temporary file is removed.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        with suppress(OSError):  # the file was never created, or its folder is gone
            part.unlink(missing_ok=True)
