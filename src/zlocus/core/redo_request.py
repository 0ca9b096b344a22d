"""Request of `zlocus dsm --redo`: a part of a finished surface that is made again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_positive
from zlocus.core.requests import DsmRequest


@dataclass(frozen=True)
class RedoRequest:
    """A part of a finished surface to be made again. `None` means: not given.

    dsm_request : inputs, folder of the finished run, and the options that are to differ from those of the run; area :
    polygons of the part; margin_m : width of the ramp inside their borders on which old and new heights are blended;
    break_lines : lines with heights that the surface has there, and without heights across which it may jump; level :
    the height of all cells inside, m in the vertical datum of the surface, or the attribute of the polygons that holds
    it; nothing is matched then. config : file of options that replaces those of the run; settings : single options.

    Raises
    ------
    ConfigError
        A value out of range, or two that exclude each other.
    """

    dsm_request: DsmRequest
    area: Path
    margin_m: float | None = None
    break_lines: Path | None = None
    level: str | None = None
    config: Path | None = None
    settings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.margin_m is not None and self.margin_m != 0:
            check_positive("--redo-margin", self.margin_m, "m")
        if self.level is not None and self.break_lines is not None:
            raise ConfigError(
                f"--level {self.level} fixes all heights, and --break-lines {self.break_lines} has no effect then. "
                "Leave one out."
            )
        if self.dsm_request.overwrite:
            raise ConfigError(
                "--redo changes a part of a finished run, and --overwrite makes all of it anew. Leave one out."
            )
        if self.level_m is not None and not math.isfinite(self.level_m):
            raise ConfigError(f"--level {self.level} is no height. Give metres, or an attribute of the polygons.")

    @property
    def level_m(self) -> float | None:
        """The level, m, where it is a number."""
        try:
            return None if self.level is None else float(self.level)
        except ValueError:
            return None

    @property
    def level_field(self) -> str | None:
        """The attribute of the polygons that holds their levels, where the level is no number."""
        return self.level if self.level_m is None else None
