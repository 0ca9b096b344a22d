"""Request of `zlocus ortho`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_bounds, check_choice, check_inputs, check_positive, check_workers

ORTHO_RECORD, MOSAIC, MOSAIC_IMAGES = "ortho.json", "mosaic.tif", "mosaic_images.tif"
ORTHO_FILES = (ORTHO_RECORD, MOSAIC, MOSAIC_IMAGES)
POINTINGS = ("corrected", "delivered")


@dataclass(frozen=True)
class OrthoRequest:
    """Ortho-images to be made. `None` means: not given, to be found.

    surface : folder of a run, or a raster of heights; inputs : images with a camera, or one scene file. resolution :
    side of a pixel, m, by default each image's own; bounds : (xmin, ymin, xmax, ymax) m in the surface's CRS.
    pointing : whether the cameras of images that took no part in the run are corrected against an ortho-image of the
    same surface, or used as delivered; reference : that ortho-image, by default the one of the run. surface_vertical :
    vertical datum of the surface, None takes that of its CRS. mosaic : whether a mosaic is made, None: of two or more
    images with the same bands; level_colours : whether the images of a mosaic are levelled. workers : threads.

    Raises
    ------
    ConfigError, InputError
        A value out of range, values that exclude each other, or inputs that are no images.
    """

    surface: Path
    inputs: tuple[Path, ...]
    out: Path
    resolution: float | None = None
    bounds: tuple[float, float, float, float] | None = None
    pointing: str = "corrected"
    reference: Path | None = None
    surface_vertical: str | None = None
    mosaic: bool | None = None
    level_colours: bool = True
    workers: int | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_inputs(self.inputs, may_be_single=True)
        check_positive("--resolution", self.resolution, "m")
        check_bounds(self.bounds)
        check_choice("pointing", self.pointing, POINTINGS)
        check_workers(self.workers)
        if self.reference is not None and self.pointing == "delivered":
            raise ConfigError(
                f"--pointing delivered corrects no camera, and --reference {self.reference} is for that. Leave one out."
            )
