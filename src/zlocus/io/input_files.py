"""The files that a run reads: what they were when it began, whether they still are, and their checksums."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zlocus.core.errors import StoppedError
from zlocus.core.scene import Scene
from zlocus.io.open_raster import file_state
from zlocus.io.run_record import inputs_record


def files_of(scene: Scene) -> list[Path]:
    """Every file that the views of a scene are read from."""
    return [path for view in scene.views for path in view.files]


@dataclass(frozen=True)
class InputFiles:
    """Files whose content a result depends on.

    states : size (bytes) and time of change (ns) of each file, by its path, when the run began; empty of a file on a
    server, and of one that is not there.
    """

    states: Mapping[str, list[int]]

    @classmethod
    def of(cls, files: Iterable[Path], scene: Scene | None = None, before: InputFiles | None = None) -> InputFiles:
        """The files as they are now; of what was read already, as they were then.

        scene : whose images know what their files were when they were opened; before : what was looked at earlier.
        """
        known: dict[str, list[int]] = {} if before is None else dict(before.states)
        for view in () if scene is None else scene.views:
            if state := getattr(view.image, "state", ()):
                known[str(view.path)] = list(state)
        return cls({str(path): known.get(str(path)) or file_state(path) for path in dict.fromkeys(files)})

    def changed(self) -> list[str]:
        """Files whose size or time of change is another now, those that are missing last."""
        now = {name: file_state(Path(name)) for name in self.states}
        changed = [name for name, state in self.states.items() if now[name] != state]
        return sorted(changed, key=lambda name: not now[name])

    def check(self, n_kept: int | None = None, may_miss: bool = False) -> None:
        """End a run whose inputs are no longer what they were when it began: what it made of them, and what it is going
        to make, would not belong together.

        n_kept : finished tiles, made before, which are kept; None where the run keeps none. may_miss : whether files
        may have disappeared, because something else says what that did.

        Raises
        ------
        StoppedError
            Naming a file that changed.
        """
        changed = [name for name in self.changed() if not may_miss or Path(name).exists()]
        if not changed:
            return
        first, others = changed[0], len(changed) - 1
        what = "was replaced or written to" if Path(first).exists() else "disappeared"
        more = f", and so did {others} more {'inputs' if others > 1 else 'input'}" if others else ""
        if n_kept:
            advice = (
                f"{n_kept} finished tiles of before are kept: put back what was there and give the same command again "
                "to go on, or add --overwrite to start anew with what is there now."
            )
        else:
            advice = "Give the same command again when the file is complete."
        raise StoppedError(f"The input {first} {what} while the run read it{more}; no result is written. {advice}")

    def record(self, n_kept: int | None = None) -> list[dict[str, Any]]:
        """Path and SHA-256 of every file, for run.json, of the content that the run has read. n_kept : see `check`.

        Raises
        ------
        StoppedError
            Where a file is no longer what it was when the run began.
        """
        self.check(n_kept)
        try:
            found = inputs_record(Path(name) for name in self.states)
        except OSError as error:
            self.check(n_kept)
            raise StoppedError(
                f"The input {error.filename} can no longer be read: {error.strerror or error}. Give the same command "
                "again when it can."
            ) from error
        # Once more, for reading takes time.
        self.check(n_kept)
        return found
