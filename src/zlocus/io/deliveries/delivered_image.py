"""An image as a vendor delivers it: pixels, camera, masks, and what is known of the exposure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from zlocus.core.errors import InputError
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
    should be there and are not; claimed : all files that belong to it, so that they are not taken for other images;
    missing_camera : which file of its camera is missing, as a sentence, empty where none is.
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
    missing_camera: str = ""


@dataclass(frozen=True)
class SetAside:
    """A file that a delivery holds and that is not matched.

    reason : why, as the end of a sentence that begins with the name of the file, empty where nobody asks; is_doubtful :
    whether it may be an image that was meant to be matched.
    """

    path: Path
    reason: str
    is_doubtful: bool = False


@dataclass(frozen=True)
class RefusedProduct:
    """A product of a delivery that cannot be used. path : of the file that names it; reason : why, as a sentence;
    claimed : files that no other reader shall look at."""

    path: Path
    reason: str
    claimed: frozenset[Path] = field(default=frozenset(), compare=False, repr=False)


@dataclass(frozen=True)
class Found:
    """What a reader finds in a delivery.

    images : to be matched, or to give colours; set_aside : what it knows and leaves out; refused : what cannot be used;
    table : of dates, which completes what the vendors' files say, None without one.
    """

    images: tuple[DeliveredImage, ...] = ()
    set_aside: tuple[SetAside, ...] = ()
    refused: tuple[RefusedProduct, ...] = ()
    table: Path | None = None

    @property
    def claimed(self) -> set[Path]:
        """The files that no other reader shall look at."""
        of_images = {path for image in self.images for path in (image.pixels, *image.masks, *image.claimed)}
        of_refused = {path for each in self.refused for path in (each.path, *each.claimed)}
        return of_images | of_refused | {each.path for each in self.set_aside}

    def with_more(self, other: Found) -> Found:
        """What two readers find."""
        return Found(
            self.images + other.images,
            self.set_aside + other.set_aside,
            self.refused + other.refused,
            self.table or other.table,
        )


# A reader of the products of one vendor: it gets the files of a delivery, and returns what it knows among them.
Reader = Callable[[Sequence[Path]], Found]


def found_in_products(
    products: Iterable[Path], read: Callable[[Path], Found], files_of: Callable[[Path], Iterable[Path]]
) -> Found:
    """What is found in some products. One that cannot be used is listed, and the others are read.

    products : a path for each; files_of : the files that belong to a product that cannot be used.
    """
    found = Found()
    for path in products:
        try:
            found = found.with_more(read(path))
        except InputError as error:
            refused = RefusedProduct(path, str(error), frozenset(files_of(path)))
            found = found.with_more(Found(refused=(refused,)))
    return found
