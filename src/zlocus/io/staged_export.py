"""Write the files of an export into a folder with a temporary name; they get their places when all are complete."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from zlocus.core.errors import OutputError
from zlocus.core.export_request import EXPORT_RECORD
from zlocus.io.run_record import write_record


@contextmanager
def staged_export(out: Path) -> Iterator[Path]:
    """Yield a temporary folder inside `out` to write to; at the end of the block its files move to `out`.

    Files that the record of an earlier export in `out` names are removed before. After an exception nothing is left of
    the new files, and the earlier ones are untouched.

    Raises
    ------
    OutputError
        A file cannot be written, or would replace one that is not of an earlier export.
    """
    new = [path for path in (out, *out.parents) if not path.exists()]
    stage = out / f".export.{os.getpid()}.part"
    try:
        stage.mkdir(parents=True)
        yield stage
        _move(stage, out)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{out} cannot be written: {reason}. Check the folder and the space left.") from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        with suppress(OSError):  # a folder that holds something stays
            for path in new:
                path.rmdir()


def write_export_record(stage: Path, record: dict[str, Any]) -> None:
    """Write the record of an export, which names all files that are there already.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    files = sorted(path.relative_to(stage).as_posix() for path in stage.rglob("*") if path.is_file())
    write_record(stage / EXPORT_RECORD, {**record, "files": files})


def earlier_files(out: Path) -> list[Path]:
    """The files of an earlier export in a folder, as its record names them; none where it is missing or damaged."""
    try:
        names = json.loads((out / EXPORT_RECORD).read_text(encoding="utf-8"))["files"]
        paths = [out / str(name) for name in names]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    inside = [path for path in paths if path.resolve().is_relative_to(out.resolve()) and ".." not in path.parts]
    return [*inside, out / EXPORT_RECORD]


def _move(stage: Path, out: Path) -> None:
    earlier = earlier_files(out)
    new = [path for path in stage.rglob("*") if path.is_file()]
    for path in new:
        target = out / path.relative_to(stage)
        if target.exists() and target not in earlier:
            raise OutputError(f"{target} exists and is not of an export. Choose another folder with -o.")
    for path in earlier:
        path.unlink(missing_ok=True)
    folders = {folder for path in earlier for folder in path.relative_to(out).parents} - {Path()}
    for folder in sorted((out / name for name in folders), reverse=True):
        with suppress(OSError):  # it holds something else, or is gone
            folder.rmdir()
    # The record comes last: where it is, all is there.
    for path in sorted(new, key=lambda each: each.name == EXPORT_RECORD):
        target = out / path.relative_to(stage)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
