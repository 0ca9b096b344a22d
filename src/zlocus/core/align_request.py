"""Request of `zlocus align`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_positive

DEFAULT_MAX_SHIFT_M = 10.0


@dataclass(frozen=True)
class AlignRequest:
    """A surface to be moved onto a reference. `None` means: not given.

    surface : folder of a finished surface, or a raster of heights; references : a raster of heights, a table
    of points, or clouds of points; out :
    folder of the result, another one. tilt : whether a tilt is removed too. height_only : whether it is moved up and
    down only. max_shift_m : how far the shift is sought. keep_grid : whether the result has the cells of the surface,
    whose heights are then interpolated. geoid : raster or name of a geoid that brings both to one vertical datum.

    Raises
    ------
    ConfigError
        A value out of range, or two that exclude each other.
    """

    surface: Path
    references: tuple[Path, ...]
    out: Path
    tilt: bool = False
    height_only: bool = False
    max_shift_m: float = DEFAULT_MAX_SHIFT_M
    keep_grid: bool = False
    geoid: Path | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_positive("--max-shift", self.max_shift_m, "m")
        folder = self.surface if self.surface.is_dir() else self.surface.parent
        if self.out.resolve() == folder.resolve():
            raise ConfigError(f"-o {self.out} holds the surface that is to be moved. Choose another folder.")

    @property
    def dsm(self) -> Path:
        """The raster of heights."""
        return self.surface / "dsm.tif" if self.surface.is_dir() else self.surface

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files that are read: heights and references."""
        return self.dsm, *self.references
