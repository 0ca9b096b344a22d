"""Files on this machine, in a folder or in an archive: the same questions for both."""

from __future__ import annotations

from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.io.archives import is_archived, member_of, names_in_archive, read_member, stored_file

# Bytes at the begin of a file by which its kind is told.
FIRST_BYTES = 1024


def file_exists(path: Path) -> bool:
    """Whether there is such a file; False for names that no file can have."""
    try:
        return member_of(path) is not None if is_archived(path) else path.is_file()
    except (OSError, ValueError, InputError):
        return False


def byte_length(path: Path) -> int:
    """Size of a file, bytes.

    Raises
    ------
    InputError
        There is no such file.
    """
    if is_archived(path):
        member = member_of(path)
        if member is None:
            raise InputError(f"There is no file {path}. Check the path.")
        return member.n_bytes
    try:
        return path.stat().st_size
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Check the path.") from error


def read_content(path: Path, n_bytes: int | None = None) -> bytes:
    """The first bytes of a file, at most `n_bytes`; None: all, of a member of an archive as many as it is said to have.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    if is_archived(path):
        return read_member(path, byte_length(path) if n_bytes is None else n_bytes)
    try:
        with path.open("rb") as file:
            return file.read(-1 if n_bytes is None else n_bytes)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Check the path.") from error


def first_bytes(path: Path) -> bytes:
    """The first `FIRST_BYTES` bytes of a file; empty where it cannot be read."""
    try:
        return read_content(path, FIRST_BYTES)
    except (InputError, ValueError):
        return b""


def file_beside(path: Path, name: str) -> Path | None:
    """A file in the folder of another one by its name; where there is none, by its name in other capital letters."""
    exact = path.with_name(name)
    if file_exists(exact):
        return exact
    return next((path.with_name(each) for each in names_beside(path) if each.lower() == name.lower()), None)


def names_beside(path: Path) -> list[str]:
    """Names of the files in the folder of a file, sorted; none where the folder cannot be read."""
    if is_archived(path):
        return sorted(names_in_archive(path))
    try:
        return sorted(each.name for each in path.parent.iterdir() if each.is_file())
    except OSError:
        return []


def is_remote(path: Path) -> bool:
    """Whether a path is in a virtual file system of GDAL for servers: `/vsicurl/` and an address, `/vsis3/bucket/key`.

    Paths in local archives are not.
    """
    return str(path).startswith("/vsi") and not is_archived(path)


def file_state(path: Path) -> list[int]:
    """Size (bytes) and modification time (ns) of a file; empty where it is missing or on a server.

    Of a file in an archive it is that of the archive.
    """
    if is_remote(path):
        return []
    try:
        status = stored_file(path).stat()
    except (OSError, InputError):
        return []
    return [status.st_size, status.st_mtime_ns]
