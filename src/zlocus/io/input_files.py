"""The input files of a run: whether they have changed since it began, and their checksums."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zlocus.core.errors import StoppedError
from zlocus.core.scene import Scene
from zlocus.io.archives import stored_file
from zlocus.io.run_record import inputs_record
from zlocus.io.stored_files import file_state


def files_of(scene: Scene) -> list[Path]:
    """All files from which the views of a scene are read; of what lies in an archive, the archive."""
    return [stored_file(path) for view in scene.views for path in view.files]


@dataclass(frozen=True)
class InputFiles:
    """The files on whose content a result depends, and their state when the run began.

    states : size (bytes) and modification time (ns) of each file, by its path; empty for a file that is missing or on a
    server.
    """

    states: Mapping[str, list[int]]

    @classmethod
    def of(
        cls, files: Iterable[Path], scene: Scene | None = None, earlier_inputs: InputFiles | None = None
    ) -> InputFiles:
        """Record the state of some files; for those already read, the state at that time.

        scene : its images carry the state of their files when they were opened; earlier_inputs : an earlier record.
        """
        known: dict[str, list[int]] = {} if earlier_inputs is None else dict(earlier_inputs.states)
        for view in () if scene is None else scene.views:
            if state := getattr(view.image, "state", ()):
                known[str(stored_file(view.path))] = list(state)
        return cls({str(path): known.get(str(path)) or file_state(path) for path in dict.fromkeys(files)})

    def changed(self) -> list[str]:
        """Paths of files whose size or modification time has changed; missing files come last."""
        now = {name: file_state(Path(name)) for name in self.states}
        changed = [name for name, state in self.states.items() if now[name] != state]
        return sorted(changed, key=lambda name: not now[name])

    def check(self, n_finished_tiles: int | None = None, may_miss: bool = False) -> None:
        """Stop the run if an input has changed since it began: earlier and later results would not fit together.

        n_finished_tiles : finished tiles whose checkpoints stay; None where the run keeps none. may_miss : missing
        files are ignored, because another message covers them.

        Raises
        ------
        StoppedError
            A file has changed; the message names it.
        """
        changed = [name for name in self.changed() if not may_miss or Path(name).exists()]
        if not changed:
            return
        first, others = changed[0], len(changed) - 1
        what = "was replaced or written to" if Path(first).exists() else "disappeared"
        more = f", and so did {others} more {'inputs' if others > 1 else 'input'}" if others else ""
        if n_finished_tiles:
            advice = (
                f"{n_finished_tiles} finished tiles are kept: restore the file and give the same command again to "
                "resume, or add --overwrite to start again with the changed file."
            )
        else:
            advice = "Give the same command again when the file is complete."
        raise StoppedError(f"The input {first} {what} while the run read it{more}; no result is written. {advice}")

    def record(self, n_finished_tiles: int | None = None) -> list[dict[str, Any]]:
        """Path and SHA-256 of every file, for run.json. n_finished_tiles : see `check`.

        Raises
        ------
        StoppedError
            A file has changed since the run began, so the checksum would not be that of the content that was read.
        """
        self.check(n_finished_tiles)
        try:
            records = inputs_record(Path(name) for name in self.states)
        except OSError as error:
            self.check(n_finished_tiles)
            raise StoppedError(
                f"The input {error.filename} can no longer be read: {error.strerror or error}. Give the same command "
                "again when it can."
            ) from error
        # Checked again, because reading takes time.
        self.check(n_finished_tiles)
        return records
