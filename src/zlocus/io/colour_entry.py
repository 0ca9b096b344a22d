"""The `colours` entry of a view in a `scene.yaml`: another image of the same pass that gives its colours."""

from __future__ import annotations

from pathlib import Path

from pydantic import field_validator

from zlocus.core.errors import InputError
from zlocus.io.colour_image import ColourImage
from zlocus.io.deliveries.pairing import MAX_DISTANCE_PX, common_places
from zlocus.io.open_raster import open_raster
from zlocus.io.schema import StrictModel, WholeNumber


class ColourEntry(StrictModel):
    """The multispectral image of a panchromatic one.

    image : its file; bands : numbers of its red, green and blue band, from 1; camera : file of its RPC, None for the
    one in it or beside it. The RPC of the panchromatic image is that which was delivered, not a corrected one.
    """

    image: str
    bands: tuple[WholeNumber, WholeNumber, WholeNumber]
    camera: str | None = None

    @field_validator("bands")
    @classmethod
    def _from_one(cls, bands: tuple[int, int, int]) -> tuple[int, int, int]:
        if min(bands) < 1 or len(set(bands)) < len(bands):
            raise ValueError("bands are three different numbers, from 1")
        return bands

    def opened(self, folder: Path, image: Path) -> ColourImage:
        """The image of the entry. folder : where its paths start; image : that gets the colours.

        Raises
        ------
        InputError
            An image or an RPC is missing or damaged, or they do not show the same ground in the same pass.
        """
        path, camera = folder / self.image, None if self.camera is None else folder / self.camera
        with open_raster(path) as source:
            n_bands = source.count
        if max(self.bands) > n_bands:
            raise InputError(f"{path} has {n_bands} bands, and no band {max(self.bands)}. Check `bands`.")
        places = common_places((image, None), (path, camera))
        if places is None:
            raise InputError(
                f"{path} cannot give the colours of {image}: by their RPCs they show different ground, or heights move "
                f"them against each other by more than {MAX_DISTANCE_PX:g} pixels, as in images of different passes. "
                "Leave `colours` out."
            )
        return ColourImage(path, camera, self.bands, places.polynomials)
