"""Request of `zlocus orient` and `zlocus ties`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_heights, check_inputs, check_vertical_of


@dataclass(frozen=True)
class OrientRequest:
    """Tie points to be found, and with `cameras` the cameras to be corrected. `None` means: not given.

    inputs, crs, heights (above the ellipsoid), overwrite : as in `DsmRequest`. control : table of ground control and
    check points; control_ortho, control_dem : ortho-photo and terrain model that images are compared with, both or
    none; dem : raster of heights that the ties should have. control_vertical, dem_vertical : vertical datums of the
    control points and of control_dem, and of dem, as in `DsmRequest`; None is the ellipsoid for control points, and the
    datum of the CRS for a DEM.

    Raises
    ------
    ConfigError
        A value out of range.
    InputError
        One image only, an image given twice, or a scene file among images.
    """

    inputs: tuple[Path, ...]
    out: Path
    cameras: bool = True
    control: Path | None = None
    control_ortho: Path | None = None
    control_dem: Path | None = None
    control_vertical: str | None = None
    dem: Path | None = None
    dem_vertical: str | None = None
    crs: str | None = None
    heights: tuple[float, float] | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_inputs(self.inputs)
        check_heights(self.heights)
        if (self.control_ortho is None) != (self.control_dem is None):
            given, missing = ("ortho", "dem") if self.control_dem is None else ("dem", "ortho")
            raise ConfigError(
                f"--control-{given} {self.control_ortho or self.control_dem} is given without --control-{missing}. "
                "Images are compared with an ortho-photo on the heights of a terrain model: give both, or neither."
            )
        check_vertical_of("control", self.control or self.control_dem, self.control_vertical)
        check_vertical_of("dem", self.dem, self.dem_vertical)
