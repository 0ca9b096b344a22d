"""Checkpoint of a run: its finished tiles on disk, with which an interrupted run resumes.

Tiles of another run are never used: the checkpoint holds everything that the tiles depend on.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import OutputError, StoppedError
from zlocus.core.quoting import counted

Arrays = Mapping[str, NDArray[Any]]
# Names below the folder of a run. Processes that make the tiles of one run together have a list of finished tiles each.
FOLDER, MANIFEST, DONE, LOCK = "tiles", "manifest.json", "done.jsonl", "lock"
LISTS = "done*.jsonl"
# The plan of processes that make the tiles together.
PLAN = "plan.json"
# Arrays that were computed before the first tile: the tie points.
BEFORE = "before.npz"
SCHEMA = 3
# Options whose names differ from those of the fields of a request.
OPTION_NAMES = {"references": "reference"}


@dataclass
class TileCheckpoint:
    """The finished tiles of one run, in a folder below its results.

    The folder holds a manifest of everything that the tiles depend on, the arrays computed before the first tile, lists
    with a line for every finished tile, and a file for each tile. A run has one list; of several processes that make
    its tiles together (`joined`), each writes its own.

    folder : made by `open`; key : everything that the tiles depend on, by name; finished : SHA-256 of each finished
    tile, by the name of the tile; before : SHA-256 of the arrays that an earlier run of the same key computed before
    its first tile, "" where there are none; fresh_start_option : the option by which the run does not resume, "" where
    it does; is_of_this_run : whether an earlier run of the same key has begun here; check : called with the number of
    finished tiles before a tile is kept; it raises where an input has changed, which the key does not show.
    """

    folder: Path
    key: dict[str, Any]
    finished: dict[str, str] = field(default_factory=dict)
    before: str = ""
    fresh_start_option: str = ""
    is_of_this_run: bool = False
    check: Callable[[int], None] = lambda n_kept: None
    _lock: BinaryIO | None = None
    _is_ours: bool = False
    _list: str = DONE

    @classmethod
    def of(
        cls,
        out: Path,
        key: Mapping[str, Any],
        is_resumed: bool,
        overwrite: bool,
        check: Callable[[int], None] = lambda n_kept: None,
    ) -> TileCheckpoint:
        """The checkpoint of a run, with the tiles that an earlier run of the same key finished. Changes no file.

        Raises
        ------
        OutputError
            The folder holds tiles of another run, and may not be overwritten.
        """
        store = cls(out / FOLDER, json.loads(json.dumps(key)), check=check)
        store.fresh_start_option = "--overwrite" if overwrite else "" if is_resumed else "--no-resume"
        if overwrite or not (store.folder / MANIFEST).exists():
            return store
        manifest = _read_object(store.folder / MANIFEST)
        listed = _finished_in(store.folder)
        if manifest.get("schema") != SCHEMA or "key" not in manifest:
            differs = "its manifest is damaged, or of another version of zlocus"
        else:
            differs = difference(manifest["key"], store.key)
        store.is_of_this_run = not differs
        if not is_resumed:
            return store
        if differs and listed:
            raise OutputError(
                f"{store.folder} holds {counted(len(listed), 'finished tile')} of another run: {differs}. Give the "
                "same options as that run, or add --overwrite (in Python: overwrite=True) to start anew."
            )
        if not differs:
            store.finished, store.before = listed, str(manifest.get("before", ""))
        return store

    @staticmethod
    def check_free(out: Path) -> None:
        """Refuse the folder of a run that another process writes to, before any work. Changes no file.

        Raises
        ------
        OutputError
            Another process writes to the folder.
        """
        with suppress(OSError), (out / FOLDER / LOCK).open("r+b") as file:
            if not _locked(file):
                raise OutputError(_taken(out))

    def arrays_before_tiles(self) -> dict[str, NDArray[Any]] | None:
        """The arrays that an earlier run of the same key computed before its first tile; None where they are missing or
        damaged."""
        return _arrays(self.folder / BEFORE, self.before)

    @contextmanager
    def open(self, setup_digest: str, before: Arrays | None = None) -> Iterator[TileCheckpoint]:
        """Make the folder, and lock it against other runs.

        setup_digest : SHA-256 of the run setup; before : arrays computed before the first tile, to be kept.

        Raises
        ------
        OutputError
            Another run writes to the folder, its tiles belong to other cameras or heights, or it cannot be written.
        StoppedError
            See `check`.
        """
        self.check(len(self.finished))
        with _written(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / LOCK).open("a+b")
        try:
            if not _locked(self._lock):
                raise OutputError(_taken(self.folder.parent))
            self._begin(setup_digest, before or {})
            yield self
        except BaseException:
            if self._is_ours:
                self.count_from_disk()
            if not self.finished and self._is_ours:
                self.remove()  # a run that made nothing leaves nothing
            raise
        finally:
            self._lock.close()

    @contextmanager
    def joined(self, name: str) -> Iterator[TileCheckpoint]:
        """Make tiles of the run beside other processes that have joined it; runs that `open` the folder are kept out.

        name : of the list of the tiles that this process finishes, together with a number that no other one has.

        Raises
        ------
        OutputError
            A run has the folder for itself, or the folder cannot be written.
        """
        with _written(self.folder):
            self._lock = (self.folder / LOCK).open("a+b")
        self._list = f"done.{name}.{secrets.token_hex(4)}.jsonl"
        try:
            if not _locked(self._lock, is_shared=True):
                raise OutputError(
                    f"A run that needs {self.folder.parent} for itself writes to it. Give the same command again when "
                    "it has ended."
                )
            yield self
        finally:
            self.count_from_disk()
            self._lock.close()

    def _begin(self, setup_digest: str, before: Arrays) -> None:
        self._is_ours = True
        if self.finished:
            manifest = _read_object(self.folder / MANIFEST)
            # Another run may have written here since the store was looked at.
            self.finished = _finished_in(self.folder) if manifest.get("key") == self.key else {}
            if self.finished and manifest.get("setup") != setup_digest:
                raise OutputError(
                    f"{self.folder} holds {counted(len(self.finished), 'finished tile')} for other cameras and "
                    "heights, as they may be found on another machine. Add --overwrite (in Python: overwrite=True) to "
                    "start anew, or resume on the first machine."
                )
        if not self.finished or self.arrays_before_tiles() is None:
            with _written(self.folder):
                for path in self.folder.iterdir():
                    if not self.finished and path.name != LOCK:
                        path.unlink()
                content, digest = _packed(before)
                write_atomically(self.folder / BEFORE, content)
                manifest = {"schema": SCHEMA, "key": self.key, "setup": setup_digest, "before": digest}
                write_atomically(self.folder / MANIFEST, json.dumps(manifest, indent=1).encode())

    def keep(self, name: str, arrays: Arrays) -> None:
        """Write a finished tile, whole or not at all, and its line in the list; both are on disk when this returns.

        Raises
        ------
        StoppedError
            The tile cannot be written, or see `check`; tiles kept earlier stay.
        """
        self.check(len(self.finished))
        content, digest = _packed(arrays)
        try:
            write_atomically(self._path(name), content)
            with (self.folder / self._list).open("ab") as done:
                done.write(json.dumps({"tile": name, "sha256": digest}).encode() + b"\n")
                done.flush()
                os.fsync(done.fileno())
        except OSError as error:
            if not self.is_there:
                raise StoppedError(
                    f"{self.folder} has gone since the run began, with {counted(len(self.finished), 'finished tile')}. "
                    "Give the same command again to make them anew."
                ) from error
            raise StoppedError(
                f"{self.folder} cannot be written: {error.strerror or error}. {kept_tiles(len(self.finished))}; make "
                "room, and give the same command again."
            ) from error
        self.finished[name] = digest

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of a finished tile; None where its file is missing or damaged."""
        return _arrays(self._path(name), self.finished.get(name, ""))

    def holds(self, name: str) -> bool:
        """Whether a tile is finished and its file is undamaged."""
        return name in self.finished and self.load(name) is not None

    def count_from_disk(self) -> None:
        """Take over the finished tiles that the lists on disk name.

        An interrupt may come between the line of a tile on disk and its entry in `finished`.
        """
        self.finished |= _finished_in(self.folder)

    @property
    def is_there(self) -> bool:
        """Whether the folder still exists after `open`; somebody may have removed it."""
        return (self.folder / MANIFEST).exists()

    @property
    def how_to_resume(self) -> str:
        """How the user resumes the run, as a clause."""
        without = f" without {self.fresh_start_option}" if self.fresh_start_option else ""
        return f"the same command{without} resumes from there"

    def remove(self) -> None:
        """Remove all tiles, because their surface is complete."""
        self.finished.clear()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def has_plan(out: Path) -> bool:
    """Whether a run in a folder is planned in tasks."""
    return (out / FOLDER / PLAN).exists()


def _taken(out: Path) -> str:
    """The sentence about a folder that another process writes to."""
    return f"Another run writes to {out}. Wait for it, or choose another folder."


def kept_tiles(n: int) -> str:
    """How many tiles a run that stops has finished and keeps, as the begin of a sentence."""
    if not n:
        return "No tile was finished yet"
    return f"The {n} finished tiles are kept" if n > 1 else "The one finished tile is kept"


def _packed(arrays: Arrays) -> tuple[memoryview, str]:
    """Content of a file with these arrays, and its SHA-256."""
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    return content.getbuffer(), hashlib.sha256(content.getbuffer()).hexdigest()


def _arrays(path: Path, digest: str) -> dict[str, NDArray[Any]] | None:
    """The arrays of a file; None where it is missing or has another SHA-256."""
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != digest:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError):
        return None


def difference(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> str:
    """The first entry in which two keys differ, as a clause; "" where they are equal."""
    for name in dict.fromkeys([*before, *now]):
        one, other = before.get(name), now.get(name)
        if one == other:
            continue
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            differs = difference(_as_named(one, other) if name == "inputs" else one, other, f"{prefix}{name}.")
            if differs:
                return differs
            continue
        if prefix == "inputs.":
            return f"{name} has changed since" if one and other else f"{name} is {'new' if other else 'missing'}"
        return f"{_named(prefix, name)} was {_shown(one)} there and is {_shown(other)} now"
    return ""


def _as_named(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """The input files of a key with the paths of another one. A file that has another path there, seen from another
    folder, is the same where its name, size and time of change are."""
    free = {(Path(name).name, str(state)): name for name, state in now.items() if name not in before and state}
    return {
        name if name in now else free.pop((Path(name).name, str(state)), name): state for name, state in before.items()
    }


def _named(prefix: str, name: str) -> str:
    """What an entry of a key is called by the user: the option of the command line where there is one."""
    group, _, rest = f"{prefix}{name}".partition(".")
    if group == "request":
        return f"--{OPTION_NAMES.get(rest, rest).replace('_', '-')}"
    if group == "options":
        return f"the option {rest}"
    return f"the version of {rest}" if group == "versions" else f"{prefix}{name}"


def _shown(value: Any) -> str:
    if value is None or value == []:
        return "not given"
    text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """Write a file to a temporary name beside it, to the disk, and rename it."""
    # Processes of other machines may have the same number.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.{os.getpid()}.part")
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


def _finished_in(folder: Path) -> dict[str, str]:
    """SHA-256 of each finished tile in the lists of a folder; damaged lines, or a last line that was cut off, are
    skipped.

    Where two processes have made the same tile with different bytes, as different processors may, the file says which
    of both was the last.
    """
    found: dict[str, set[str]] = {}
    for path in sorted(folder.glob(LISTS)):
        with suppress(OSError):
            for line in path.read_bytes().splitlines():
                with suppress(ValueError, KeyError, TypeError):
                    record = json.loads(line)
                    found.setdefault(str(record["tile"]), set()).add(str(record["sha256"]))
    return {
        name: digests.pop() if len(digests) == 1 else _that_of_file(folder / f"{name}.npz", digests)
        for name, digests in found.items()
    }


def _that_of_file(path: Path, digests: set[str]) -> str:
    """Which of several SHA-256 is that of a file; any where none is, or the file cannot be read."""
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return max(digests)
    return digest if digest in digests else max(digests)


def _locked(file: BinaryIO, is_shared: bool = False) -> bool:
    """Lock a file until it is closed or the process ends; False where another process holds it, True without locks.

    is_shared : whether others may hold a shared lock at the same time.
    """
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
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
