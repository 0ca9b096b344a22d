"""An image as a vendor delivers it: pixels, camera, masks, and what is known of the exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from zlocus.core.scene import NOT_KNOWN, Acquisition


class Spectrum(Enum):
    """Which light an image shows, as far as that matters for what is done with it."""

    PANCHROMATIC = "panchromatic"
    MULTISPECTRAL = "multispectral"
    OTHER = "other"


@dataclass(frozen=True)
class DeliveredImage:
    """An image of a delivery.

    product : name of the product, unique in the delivery; pixels : the file of pixels, or the index of its tiles;
    camera : file of its camera, None where the camera is in the file of pixels; colour_bands : numbers of its red,
    green and blue band, from 1, None where it is not known to have them; shape : rows and columns that the vendor's
    files say, None where they do not; masks : files of masks that belong to it; missing_masks : files of masks that
    should be there and are not; claimed : all files that belong to it, so that they are not taken for other images.
    """

    product: str
    pixels: Path
    camera: Path | None
    acquisition: Acquisition = NOT_KNOWN
    spectrum: Spectrum = Spectrum.OTHER
    colour_bands: tuple[int, int, int] | None = None
    shape: tuple[int, int] | None = None
    masks: tuple[Path, ...] = ()
    missing_masks: tuple[Path, ...] = ()
    claimed: frozenset[Path] = field(default=frozenset(), compare=False, repr=False)


@dataclass(frozen=True)
class SetAside:
    """A file that a delivery holds and that is not matched. reason : why, as the end of a sentence that begins with the
    name of the file."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Found:
    """What a reader finds in a delivery. images : to be matched, or to give colours; set_aside : what it knows and
    leaves out; table : of dates, which completes what the vendors' files say, None without one."""

    images: tuple[DeliveredImage, ...] = ()
    set_aside: tuple[SetAside, ...] = ()
    table: Path | None = None

    @property
    def claimed(self) -> set[Path]:
        """The files that no other reader shall look at."""
        of_images = {path for image in self.images for path in (image.pixels, *image.masks, *image.claimed)}
        return of_images | {each.path for each in self.set_aside}


# A reader of the products of one vendor: it gets the files of a delivery, and returns what it knows among them.
Reader = Callable[[Sequence[Path]], Found]
