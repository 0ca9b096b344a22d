"""Requests of the commands that join and compare finished surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_positive, check_workers

MOSAIC_FILES = (
    "run.json", "dsm.tif", "sigma.tif", "quality.tif", "views.tif", "water.tif", "ortho.tif", "source.tif", "seams.tif",
    "seams.png",
)  # fmt: skip
CHANGE_FILES = (
    "change.json", "difference.tif", "sigma.tif", "significance.tif", "class.tif", "volumes.csv", "volumes.gpkg",
    "change.png",
)  # fmt: skip


@dataclass(frozen=True)
class MosaicRequest:
    """Surfaces to be joined. `None` means: not given.

    inputs : folders of runs and rasters of heights, see `zlocus.io.surface_inputs.surface_input`; out : folder of the
    result; like : raster whose grid is taken, None: that of the first input, extended; geoid : raster or name of the
    geoid of heights that are not ellipsoidal; feather_m : distance from the end of a run at which it has its full
    weight, m, None: 32 cells; keep_offsets : whether heights stay where runs have a vertical offset; workers : blocks
    worked on at a time; scheduler : address of a Dask cluster that works on them instead; overwrite : whether another
    result in `out` is replaced.

    Raises
    ------
    ConfigError
        A value out of range, one input only, or one given twice.
    """

    inputs: tuple[str, ...]
    out: Path
    like: Path | None = None
    geoid: Path | None = None
    feather_m: float | None = None
    keep_offsets: bool = False
    workers: int | None = None
    scheduler: str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_workers(self.workers)
        check_positive("--feather", self.feather_m, "m")
        if len(self.inputs) < 2:
            raise ConfigError("One surface alone is no mosaic. Give two or more.")
        resolved = [Path(each).resolve() for each in self.inputs]
        for given, path in zip(self.inputs, resolved, strict=True):
            if resolved.count(path) > 1:
                raise ConfigError(f"{given} is given twice. Name each surface once.")


@dataclass(frozen=True)
class ChangeRequest:
    """Two surfaces whose change is asked for, the later one less the earlier one. `None` means: not given.

    first, second : earlier and later surface, as `MosaicRequest.inputs`; out : folder of the result; area : polygons
    whose volumes are wanted; name : attribute of theirs that names them; stable : polygons of ground that has not
    changed, None: all ground outside of `area`; geoid : as of `MosaicRequest`; level : probability below which a change
    of a cell is significant; keep_offset : whether the offset of stable ground stays; overwrite : whether another
    result in `out` is replaced.

    Raises
    ------
    ConfigError
        A value out of range, or an option that another one needs.
    """

    first: str
    second: str
    out: Path
    area: Path | None = None
    name: str | None = None
    stable: Path | None = None
    geoid: Path | None = None
    level: float = 0.05
    keep_offset: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.level) and 0 < self.level < 1):
            raise ConfigError(f"--level {self.level:g} is no probability. Give a number between 0 and 1, such as 0.05.")
        if self.name is not None and self.area is None:
            raise ConfigError(f"--name {self.name} names polygons, and there are none. Give --area, or leave it out.")
        if Path(self.first).resolve() == Path(self.second).resolve():
            raise ConfigError(f"{self.first} is given twice, and has no change against itself. Give two surfaces.")

    @property
    def inputs(self) -> tuple[str, ...]:
        """Both surfaces."""
        return self.first, self.second
