"""Finished tiles on disk: a run that was stopped goes on where it was, and never with tiles of another run."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import OutputError, StoppedError

Arrays = Mapping[str, NDArray[Any]]
# Below the folder of a run.
FOLDER, MANIFEST, DONE, LOCK = "tiles", "manifest.json", "done.jsonl", "lock"
# What was found before the first tile.
BEFORE = "before.npz"
SCHEMA = 2


@dataclass
class TileStore:
    """Tiles of one run below its folder: a manifest of what they depend on, what was found before the first of them, a
    line for every finished tile, and a file of each.

    folder : holds them, made by `open`; key : all that the tiles depend on, by name; finished : SHA-256 of each tile
    that is there, by its name; before : SHA-256 of what an earlier run of the same found before its first tile, "" of
    nothing; starts_anew_by : the option by which the run takes on no tiles, "" where it does; is_of_this_run : whether
    an earlier run of the same has begun here; check : ends the run, told how many tiles are kept, where a tile may be
    made of what the key does not say.
    """

    folder: Path
    key: dict[str, Any]
    finished: dict[str, str] = field(default_factory=dict)
    before: str = ""
    starts_anew_by: str = ""
    is_of_this_run: bool = False
    check: Callable[[int], None] = lambda n_kept: None
    _lock: BinaryIO | None = None
    _is_ours: bool = False

    @classmethod
    def of(
        cls,
        out: Path,
        key: Mapping[str, Any],
        is_resumed: bool,
        overwrite: bool,
        check: Callable[[int], None] = lambda n_kept: None,
    ) -> TileStore:
        """The store of a run, with what an earlier one left of the same; looks only.

        Raises
        ------
        OutputError
            It holds tiles of another run, and may not be overwritten.
        """
        store = cls(out / FOLDER, json.loads(json.dumps(key)), check=check)
        store.starts_anew_by = "--overwrite" if overwrite else "" if is_resumed else "--no-resume"
        if overwrite or not (store.folder / MANIFEST).exists():
            return store
        found = _read_object(store.folder / MANIFEST)
        listed = _finished_in(store.folder / DONE)
        if found.get("schema") != SCHEMA or "key" not in found:
            differs = "its manifest is damaged, or of another version of zlocus"
        else:
            differs = difference(found["key"], store.key)
        store.is_of_this_run = not differs
        if not is_resumed:
            return store
        if differs and listed:
            raise OutputError(
                f"{store.folder} holds {len(listed)} finished tiles of another run: {differs}. Give what that run was "
                "given, or add --overwrite to start anew."
            )
        if not differs:
            store.finished, store.before = listed, str(found.get("before", ""))
        return store

    def found_before(self) -> dict[str, NDArray[Any]] | None:
        """What an earlier run of the same found before its first tile; None where it is missing, or not what was
        written."""
        return _arrays(self.folder / BEFORE, self.before)

    @contextmanager
    def open(self, settled: str, before: Arrays | None = None) -> Iterator[TileStore]:
        """The store, begun, and locked against other runs.

        settled : digest of what was found before the first tile; before : the part of it that is to be kept.

        Raises
        ------
        OutputError
            Another run writes there, the cameras or heights came out otherwise than for the tiles that are there, or it
            cannot be written.
        StoppedError
            See `check`.
        """
        self.check(len(self.finished))
        with _written(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / LOCK).open("wb")
        try:
            if not _locked(self._lock):
                raise OutputError(f"Another run writes to {self.folder.parent}. Wait for it, or choose another folder.")
            self._begin(settled, before or {})
            yield self
        except BaseException:
            if not self.finished and self._is_ours:
                self.remove()  # a run that made nothing leaves nothing
            raise
        finally:
            self._lock.close()

    def _begin(self, settled: str, before: Arrays) -> None:
        self._is_ours = True
        if self.finished:
            found = _read_object(self.folder / MANIFEST)
            # Another run may have written here since the store was looked at.
            self.finished = _finished_in(self.folder / DONE) if found.get("key") == self.key else {}
            if self.finished and found.get("settled") != settled:
                raise OutputError(
                    f"{self.folder} holds {len(self.finished)} finished tiles for which cameras and heights came out "
                    "otherwise, as they may on another machine. Add --overwrite to start anew, or go on where it began."
                )
        if not self.finished or self.found_before() is None:
            with _written(self.folder):
                for path in self.folder.iterdir():
                    if not self.finished and path.name != LOCK:
                        path.unlink()
                content, digest = _packed(before)
                write_atomically(self.folder / BEFORE, content)
                manifest = {"schema": SCHEMA, "key": self.key, "settled": settled, "before": digest}
                write_atomically(self.folder / MANIFEST, json.dumps(manifest, indent=1).encode())

    def keep(self, name: str, arrays: Arrays) -> None:
        """Write a tile, whole or not at all, and its line; both are on the disk when this returns.

        Raises
        ------
        StoppedError
            It cannot be written, or see `check`: what was kept before stays.
        """
        self.check(len(self.finished))
        content, digest = _packed(arrays)
        try:
            write_atomically(self._path(name), content)
            with (self.folder / DONE).open("ab") as done:
                done.write(json.dumps({"tile": name, "sha256": digest}).encode() + b"\n")
                done.flush()
                os.fsync(done.fileno())
        except OSError as error:
            if not self.is_there:
                raise StoppedError(
                    f"{self.folder} has gone since the run began, with {len(self.finished)} finished tiles in it. Give "
                    "the same command again to make them anew."
                ) from error
            raise StoppedError(
                f"{self.folder} cannot be written: {error.strerror or error}. {len(self.finished)} finished tiles are "
                "kept; make room, and give the same command again to go on."
            ) from error
        self.finished[name] = digest

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of a finished tile; None where its file is missing, or not what was written."""
        return _arrays(self._path(name), self.finished.get(name, ""))

    def holds(self, name: str) -> bool:
        """Whether a finished tile is there, with the bytes that were written."""
        return name in self.finished and self.load(name) is not None

    @property
    def is_there(self) -> bool:
        """Whether the folder still is where `open` made it; somebody may have removed it."""
        return (self.folder / MANIFEST).exists()

    @property
    def how_to_go_on(self) -> str:
        """What a user is to do with the tiles of a run that was stopped, as a clause."""
        without = f" without {self.starts_anew_by}" if self.starts_anew_by else ""
        return f"the same command{without} goes on from there"

    def remove(self) -> None:
        """Remove all tiles: their surface is complete."""
        self.finished.clear()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def _packed(arrays: Arrays) -> tuple[memoryview, str]:
    """The bytes of a file of arrays, and their SHA-256."""
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    return content.getbuffer(), hashlib.sha256(content.getbuffer()).hexdigest()


def _arrays(path: Path, digest: str) -> dict[str, NDArray[Any]] | None:
    """The arrays of a file; None where it is missing, or its SHA-256 is another."""
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != digest:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError):
        return None


def difference(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> str:
    """The first thing in which two keys differ, as a clause; "" where they are the same."""
    for name in dict.fromkeys([*before, *now]):
        one, other = before.get(name), now.get(name)
        if one == other:
            continue
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            return difference(one, other, f"{prefix}{name}.")
        if prefix == "inputs.":
            return f"{name} has changed since" if one and other else f"{name} is {'new' if other else 'missing'}"
        return f"{prefix}{name} was {_shown(one)} there and is {_shown(other)} now"
    return ""


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """Write a file to a temporary name beside it, to the disk, and rename it."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _read_object(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _finished_in(path: Path) -> dict[str, str]:
    """Tiles by their lines; a last line that was cut off, or one that is damaged, counts for nothing."""
    found: dict[str, str] = {}
    try:
        lines = path.read_bytes().splitlines()
    except OSError:
        return found
    for line in lines:
        with suppress(ValueError, KeyError, TypeError):
            record = json.loads(line)
            found[str(record["tile"])] = str(record["sha256"])
    return found


def _locked(file: BinaryIO) -> bool:
    """Whether a file could be locked; it is until it is closed, or its process ends. Without locks, yes."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # some network disks have none
        return True
    return True


@contextmanager
def _written(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written: {error.strerror or error}. Choose another folder with -o."
        ) from error
