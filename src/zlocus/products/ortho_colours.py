"""Which images give the ortho-image its colours, as a record of run.json and as a sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from zlocus.core.quoting import first_names
from zlocus.core.scene import ImageSource, View
from zlocus.io.images import RasterImage
from zlocus.sensors.line_shifts import StraightenedImage

# A sentence names at most this many images.
MAX_NAMED = 6


def colour_records(views: Sequence[View]) -> dict[str, str | None]:
    """The file of the image that gives each view its colours, by the name of the view; None for a grey view. Empty
    where no view has colours of another image."""
    images = {view.name: _raster_image(view.image) for view in views}
    if all(image is None or image.colour_image is None for image in images.values()):
        return {}
    return {
        name: None
        if image is None or not image.has_colours
        else str(image.path if image.colour_image is None else image.colour_image.path)
        for name, image in images.items()
    }


def colour_sentence(records: Mapping[str, str | None]) -> str:
    """What gives the ortho-image its colours, or why it is grey; empty where nothing is to be said. records : see
    `colour_records`."""
    if not records:
        return ""
    grey = [name for name, path in records.items() if path is None]
    if grey:
        return (
            f"The ortho-image is grey, because it takes colours of every image, and {first_names(grey, MAX_NAMED)} "
            f"{'has' if len(grey) == 1 else 'have'} none: no multispectral image of the same pass and ground was found."
        )
    names = [str(path).rpartition("/")[2] for path in records.values()]
    return f"The ortho-image has the colours of {first_names(names, MAX_NAMED)}."


def _raster_image(image: ImageSource) -> RasterImage | None:
    """The image of a file; None for another source."""
    image = image.displaced_image if isinstance(image, StraightenedImage) else image
    return image if isinstance(image, RasterImage) else None
