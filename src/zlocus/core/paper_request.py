"""Request of `zlocus paper`: a table or figure of Ji et al. (2014) to be made anew."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_choice, check_heights, check_inputs, check_positive

# The files of each table and figure.
PAPER_FILES: dict[str, tuple[str, ...]] = {
    "table3": ("table3.csv",),
    "table4": ("table4.csv",),
    **{f"figure{number}": (f"figure{number}.csv", f"figure{number}.png") for number in range(3, 9)},
}
# Values at many points, which figure 7 can add.
POINTS_FILE = "figure7_points.csv"
SPACES = ("image", "ground")
NEIGHBOURS = ("radius", "tin")
# The rendered block of the demo in the folder of the result, and the record that says from what it was rendered.
BLOCK, BLOCK_RECORD = "scene", "block.json"


@dataclass(frozen=True)
class PaperRequest:
    """A table or figure of Ji et al. (2014). `None` means: not given, to be found by the run.

    what : key of `PAPER_FILES`. inputs : images or one scene file; none: the block of the demo, which is rendered.
    space : `image`, where heights follow the rays of the reference image (GC3), or `ground`, where they follow the
    vertical line (MVLL). at : ground point P0 (x, y), m; pixel : row and column of P0 in the reference image; at most
    one of both. neighbours : the feature points around P0 are those within a radius, or the corners of its TIN
    triangle; radius_px : the radius, in pixels of the reference image or cells; by default it reaches the third nearest
    feature point. points : number of points at which figure 7 compares the chosen images with all images. reference,
    crs, heights, resolution, overwrite : as in `DsmRequest`.

    Raises
    ------
    ConfigError
        A value out of range, or two that exclude each other.
    InputError
        One image only, an image given twice, or a scene file among images.
    """

    what: str
    out: Path
    inputs: tuple[Path, ...] = ()
    space: str = "image"
    at: tuple[float, float] | None = None
    pixel: tuple[float, float] | None = None
    neighbours: str = "radius"
    radius_px: float | None = None
    points: int = 0
    reference: str | None = None
    crs: str | None = None
    heights: tuple[float, float] | None = None
    resolution: float | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.what not in PAPER_FILES:
            raise ConfigError(f"{self.what} is not known; choose from {', '.join(PAPER_FILES)}.")
        if self.inputs:
            check_inputs(self.inputs)
        check_choice("space", self.space, SPACES)
        check_choice("neighbours", self.neighbours, NEIGHBOURS)
        check_heights(self.heights)
        check_positive("--resolution", self.resolution, "m")
        check_positive("--radius", self.radius_px, "px")
        if self.at is not None and self.pixel is not None:
            raise ConfigError("The point P0 is given by --at X Y and by --pixel ROW COL. Give one of both, or none.")
        for name, values in (("at", self.at), ("pixel", self.pixel)):
            if values is not None and not all(map(math.isfinite, values)):
                raise ConfigError(f"--{name} {' '.join(f'{v:g}' for v in values)} is no place. Give finite numbers.")
        if self.radius_px is not None and self.neighbours == "tin":
            raise ConfigError("--neighbours tin takes the corners of a triangle, not a radius. Leave --radius out.")
        if self.points < 0:
            raise ConfigError(f"--points {self.points} is no number of points. Give 0 or more.")
        if self.points and self.what != "figure7":
            raise ConfigError(f"--points compares images as figure 7 does, and {self.what} is asked for. Leave it out.")

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that are written."""
        return PAPER_FILES[self.what] + ((POINTS_FILE,) if self.points else ())
