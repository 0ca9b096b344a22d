"""All bands of an image by window, with the pixels that are valid, as an ortho-image of it needs them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.scene import ImageSource
from zlocus.core.sensor_model import FloatArray
from zlocus.io.decoded_images import DECODED
from zlocus.io.images import RasterImage
from zlocus.io.open_raster import cached_raster
from zlocus.sensors.ground_sampling import BandWindow
from zlocus.sensors.line_shifts import LineShifts, StraightenedImage

# Types whose numbers fit into float32 without a loss.
FLOAT32_TYPES = ("uint8", "int8", "uint16", "int16", "float32")
# Longest side of the reduced map of an image's valid pixels.
MAP_PX = 256


@dataclass(frozen=True)
class ImageBands:
    """The bands of an image file, without bands of transparency.

    image : the file; bands : numbers of its bands, from 1; names : what the file calls each of them, "" where it does
    not; meanings : what each of them shows, as the file declares it; line_shifts : see `displaced`, None without.
    """

    image: RasterImage
    bands: tuple[int, ...]
    names: tuple[str, ...]
    meanings: tuple[ColorInterp, ...]
    line_shifts: LineShifts | None = None

    @classmethod
    def of(cls, image: ImageSource) -> ImageBands:
        """The bands of the file of an image, with the displacements of its lines where these are known.

        Raises
        ------
        InputError
            The file can no longer be read, or its bands have different types.
        """
        line_shifts = image.line_shifts if isinstance(image, StraightenedImage) else None
        file = image.displaced_image if isinstance(image, StraightenedImage) else image
        assert isinstance(file, RasterImage), "images of commands are files"
        with cached_raster(file.path) as source:
            kept = [n for n, meaning in zip(source.indexes, source.colorinterp, strict=True)
                    if meaning != ColorInterp.alpha]  # fmt: skip
            types = {source.dtypes[n - 1] for n in kept}
            if len(types) > 1:
                raise InputError(
                    f"{file.path} has bands of different types ({', '.join(sorted(types))}). Write them as one type: "
                    "gdal_translate -ot."
                )
            names = tuple(source.descriptions[n - 1] or "" for n in kept)
            return cls(file, tuple(kept), names, tuple(source.colorinterp[n - 1] for n in kept), line_shifts)

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Type of the pixels."""
        return np.dtype(self.image.dtype)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.image.shape

    def displaced(self, xy: FloatArray) -> FloatArray:
        """Where the file has what its camera model places at xy (r, c, 2) px: lines may lie a little off."""
        if self.line_shifts is None:
            return xy
        shift = self.line_shifts.at(np.nan_to_num(xy[..., 1]).ravel())
        return np.asarray(xy + shift.reshape(xy.shape))

    def read(self, row: int, col: int, rows: int, cols: int) -> BandWindow:
        """All bands of a window, in the numbers of the file.

        Raises
        ------
        InputError
            The file can no longer be read.
        """
        valid = self.image.read(row, col, rows, cols).valid
        window = Window(col, row, cols, rows)
        with cached_raster(self.image.path) as source:
            stored = [DECODED.window(source, self.image.path, band, window) for band in self.bands]
        values = np.stack(stored).astype(np.float32 if self.image.dtype in FLOAT32_TYPES else np.float64)
        if self.dtype.kind == "f":
            is_number = np.isfinite(values).all(axis=0)
            valid, values = valid & is_number, np.where(is_number, values, 0)
        return BandWindow(values, valid)

    def centrality(self) -> NDArray[np.float32]:
        """Distance of each part of the image from the nearest pixel without a value or beyond the border, as a share of
        the greatest, on a reduced map (a, b) of the whole image."""
        rows, cols = self.shape
        scale = min(MAP_PX / max(rows, cols), 1.0)
        size = max(round(rows * scale), 1), max(round(cols * scale), 1)
        with cached_raster(self.image.path) as source:
            valid = source.read_masks(self.bands[0], out_shape=size) > 0
        if self.image.held is not None:
            cells = self.image.held.cells.astype(np.uint8)
            valid &= cv2.resize(cells, size[::-1], interpolation=cv2.INTER_NEAREST) > 0
        distance = cv2.distanceTransform(np.pad(valid.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
        return np.asarray(distance / max(float(distance.max()), 1e-6), np.float32)
