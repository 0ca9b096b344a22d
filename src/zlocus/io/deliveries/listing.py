"""The files of a delivery: those of a folder and all folders in it, or those of an archive."""

from __future__ import annotations

import os
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.requests import EVENTS
from zlocus.io.archives import MAX_MEMBERS, is_archived, members, path_in_archive, stored_file

# Folders in folders; deliveries of vendors have five.
MAX_DEPTH = 16
# Folders that operating systems and other programs leave behind, and what they hold.
HIDDEN = (".", "__MACOSX")


def files_in(path: Path) -> tuple[Path, ...]:
    """The files of a folder, or of an archive, in order of their names. Hidden files are left out.

    A link to a folder is not followed, because it may lead back. A folder with a result of zlocus in it is no part of
    the delivery.

    Raises
    ------
    InputError
        The folder or archive cannot be read, or holds too many files.
    """
    if path.is_dir():
        return _in_folder(path)
    archive = stored_file(path) if is_archived(path) else path
    inside = path_in_archive(archive)
    found = [inside / member.name for member in members(archive) if not _is_hidden(member.name.split("/"))]
    return tuple(each for each in found if path == archive or each.is_relative_to(path))


def linked_folders(folder: Path) -> tuple[Path, ...]:
    """The links to folders in a folder and all folders in it, in order of their names. Hidden ones are left out."""
    found: list[Path] = []
    for at, names, _ in os.walk(folder):
        names[:] = [name for name in names if not _is_hidden([name])]
        found += [link for name in names if (link := Path(at) / name).is_symlink()]
    return tuple(sorted(found))


def _in_folder(folder: Path) -> tuple[Path, ...]:
    def refuse(error: OSError) -> None:
        raise InputError(f"The folder {error.filename} cannot be read: {error.strerror}. Check who may read it.")

    found: list[Path] = []
    for at, names, files in os.walk(folder, onerror=refuse):
        here = Path(at)
        if EVENTS in files and here != folder:
            names.clear()
            continue
        deep = len(here.relative_to(folder).parts)
        names[:] = sorted(name for name in names if not _is_hidden([name]))
        if deep >= MAX_DEPTH and names:
            raise InputError(f"{here} lies {deep} folders below {folder}, deeper than deliveries go. Give it alone.")
        found += [here / name for name in files if not _is_hidden([name])]
        if len(found) > MAX_MEMBERS:
            raise InputError(f"{folder} holds more than {MAX_MEMBERS} files. Give the folder of one delivery.")
    return tuple(sorted(found))


def _is_hidden(names: list[str]) -> bool:
    return any(name.startswith(HIDDEN) for name in names)
