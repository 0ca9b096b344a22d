"""Write files atomically: a file has a temporary name until all of it is written."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from zlocus.core.errors import OutputError


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


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file under a temporary name, then rename it. write : writes to the path that it is given.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    try:
        with atomic_file(path) as part:
            write(part)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{path} cannot be written: {reason}. Check the folder and the space left.") from error


def remove_earlier(folder: Path, names: Iterable[str]) -> None:
    """Remove files of an earlier run from a folder, as far as they are there.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    for name in names:
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"{folder / name} is of an earlier run and cannot be removed: {error.strerror}. Remove it, or choose "
                "another folder with -o."
            ) from error
