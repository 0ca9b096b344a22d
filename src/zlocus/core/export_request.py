"""Request of `zlocus export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_bounds, check_heights, check_positive

EXPORT_RECORD = "export.json"
DEFAULT_MAX_ERROR_PX = 1.0
# Formats, and the options that say something to each of them.
EXPORT_FORMATS: dict[str, tuple[str, ...]] = {
    "colmap": ("crs", "bounds", "heights", "max_error", "points"),
    "nerf": ("crs", "bounds", "heights", "max_error", "points"),
    "asp": ("heights", "max_error"),
    "rpc": ("heights", "max_error"),
    "mesh": ("bounds", "resolution", "jump"),
}


@dataclass(frozen=True)
class ExportRequest:
    """Something to be written for another program. `None` means: not given, to be found.

    kind : one of `EXPORT_FORMATS`; inputs : images with a camera, one scene file, or the folder of a run; for a mesh a
    surface first, or a cloud. bounds : (xmin, ymin, xmax, ymax) m in the CRS of the scene or of the surface; heights :
    (zmin, zmax) m, ellipsoidal; max_error : px, largest error at which a camera that is not exact is written; points :
    whether tie points are written. resolution : side of a mesh's cells, m; jump : difference of neighbouring heights of
    a surface from which on a wall stands between them, m.

    Raises
    ------
    ConfigError
        A format that is not known, an option that says nothing to it, or a value out of range.
    """

    kind: str
    inputs: tuple[Path, ...]
    out: Path
    crs: str | None = None
    bounds: tuple[float, float, float, float] | None = None
    heights: tuple[float, float] | None = None
    max_error: float | None = None
    points: bool | None = None
    resolution: float | None = None
    jump: float | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.kind not in EXPORT_FORMATS:
            raise ConfigError(f"{self.kind} is no format of an export. Choose from {', '.join(EXPORT_FORMATS)}.")
        options = {name for names in EXPORT_FORMATS.values() for name in names}
        for name in sorted(options - set(EXPORT_FORMATS[self.kind])):
            if getattr(self, name) is not None:
                option = name.replace("_", "-")
                raise ConfigError(f"--{option} says nothing to an export of the format {self.kind}. Leave it out.")
        if not self.inputs:
            raise ConfigError("Nothing is given to be exported. Give images, a scene.yaml, or the folder of a run.")
        check_bounds(self.bounds)
        check_heights(self.heights)
        check_positive("--max-error", self.max_error, "px")
        check_positive("--resolution", self.resolution, "m")
        check_positive("--jump", self.jump, "m")

    @property
    def max_error_px(self) -> float:
        """The largest error that is accepted, px."""
        return DEFAULT_MAX_ERROR_PX if self.max_error is None else self.max_error
