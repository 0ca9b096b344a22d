"""The folder in which a part of a surface is redone, beside that of the surface, and how the result takes its place.

OUT is replaced as a whole, or left as it was: the new rasters are made in `.OUT.redo/surface`, to which all other files
of OUT are linked, and both folders are exchanged in one step at the end.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import OutputError
from zlocus.io.exchanged_folders import exchange_folders, restored_folder
from zlocus.pipeline.execution.checkpoint import FOLDER


@dataclass(frozen=True)
class RedoFolder:
    """The folder of a surface, with its true place, and the folder beside it in which a part of it is redone."""

    out: Path

    @classmethod
    def of(cls, out: Path) -> RedoFolder:
        """The folders of a surface; one that a killed process was about to replace is put back.

        Raises
        ------
        OutputError
            The folder cannot be replaced, because the command runs in it.
        """
        folder = cls(out.resolve())
        with suppress(OSError):
            restored_folder(folder.out, folder.surface)
        if Path.cwd().is_relative_to(folder.out):
            raise OutputError(
                f"{out} is the working folder, which --redo cannot replace. Give the command from another one."
            )
        return folder

    @property
    def work(self) -> Path:
        """The folder of the tiles and of the new surface."""
        return self.out.with_name(f".{self.out.name}.redo")

    @property
    def surface(self) -> Path:
        """The folder that will take the place of the surface."""
        return self.work / "surface"

    def begin_surface(self, remade: set[str]) -> None:
        """Begin the new folder with links to all files of the old one, except those that are made again.

        Raises
        ------
        OutputError
            It cannot be written.
        """
        try:
            shutil.rmtree(self.surface, ignore_errors=True)
            self.surface.mkdir(parents=True)
            shutil.copymode(self.out, self.surface)
            for place, folders, names in os.walk(self.out):
                to = self.surface / Path(place).relative_to(self.out)
                if Path(place) == self.out:
                    folders[:] = [name for name in folders if name != FOLDER]
                    names = [name for name in names if name not in remade]
                for name in [name for name in folders if not (Path(place) / name).is_symlink()]:
                    (to / name).mkdir()
                    shutil.copymode(Path(place) / name, to / name)
                for name in names + [name for name in folders if (Path(place) / name).is_symlink()]:
                    _link(Path(place) / name, to / name)
        except OSError as error:
            raise OutputError(
                f"{self.surface} cannot be written: {error.strerror or error}. {self.out} is as it was."
            ) from error

    def replace(self) -> None:
        """Put the new folder in the place of the old one, and remove that one with everything that was needed.

        Raises
        ------
        OutputError
            It cannot be replaced; it is as it was.
        """
        try:
            exchange_folders(self.out, self.surface)
        except OSError as error:
            raise OutputError(
                f"{self.out} cannot be replaced: {error.strerror or error}. It is as it was. Let it be a folder inside "
                "one that may be written, and not a disk of its own."
            ) from error
        self.remove()

    def remove(self) -> None:
        """Remove everything beside the surface, after one that an exchange left there was put back."""
        with suppress(OSError):
            restored_folder(self.out, self.surface)
        if self.out.exists():
            shutil.rmtree(self.work, ignore_errors=True)


def _link(file: Path, name: Path) -> None:
    """The same file under another name; a copy where the disk has no links."""
    if file.is_symlink():
        os.symlink(os.readlink(file), name)
        return
    try:
        os.link(file, name)
    except OSError:
        shutil.copy2(file, name)
