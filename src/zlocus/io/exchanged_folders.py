"""Put one folder in the place of another in one step, so that whoever looks sees either the old one or the new one."""

from __future__ import annotations

import ctypes
import errno
import os
from pathlib import Path

# The working folder, and "exchange both", in the words of Linux (renameat2, since 3.15).
AT_WORKING_FOLDER, EXCHANGE = -100, 2
# What a system says that has no such call, or not on this disk.
NOT_KNOWN = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)


def exchange_folders(one: Path, other: Path) -> None:
    """Exchange two folders on one disk.

    Where the system can, in one step. Elsewhere the first is moved beside the other under the name `other.before`, the
    other takes its place, and a process that is killed between both leaves it to `restored_folder` to undo that.

    Raises
    ------
    OSError
        The folders cannot be moved; both are where they were.
    """
    if _exchanged(one, other):
        return
    before = before_of(other)
    os.rename(one, before)
    try:
        os.rename(other, one)
    except BaseException:
        os.rename(before, one)
        raise
    os.rename(before, other)


def before_of(other: Path) -> Path:
    """Where the first of two folders is kept while the other one takes its place."""
    return other.with_name(f"{other.name}.before")


def restored_folder(one: Path, other: Path) -> bool:
    """Put a folder back that an exchange was about to replace when its process was killed; whether there was one."""
    if one.exists() or not before_of(other).is_dir():
        return False
    os.rename(before_of(other), one)
    return True


def _exchanged(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; False where the system has no call for it."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError, TypeError):
        return False
    if call(AT_WORKING_FOLDER, os.fsencode(one), AT_WORKING_FOLDER, os.fsencode(other), EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in NOT_KNOWN:
        return False
    raise OSError(code, os.strerror(code), str(one))
