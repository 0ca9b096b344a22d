"""Images read by window: one grey channel as float32 and a mask of valid pixels."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.windows import Window

from zlocus.errors import InputError
from zlocus.io.opening import check_complete, kept_raster, open_raster
from zlocus.scene import ImageWindow

# Source: ITU-R BT.601, luma of red, green, blue.
LUMINANCE = {ColorInterp.red: 0.299, ColorInterp.green: 0.587, ColorInterp.blue: 0.114}
CHECK_SIZE = 1024


@dataclass(frozen=True)
class RasterImage:
    """An image file as an `ImageSource`.

    The grey channel is the luminance (Rec. 601) where the file declares red, green and blue bands, otherwise the first
    band. Not valid are: the declared nodata value, pixels off in an internal or side-car mask or fully transparent in
    an alpha band, NaN and infinities. An integer image that declares no nodata value is valid everywhere: 0 is a
    legal grey value and is never taken for nodata.

    The object is a plain value that threads and processes can share: open files are kept by thread, see `kept_raster`.

    bands : 1-based indices of the bands that are read, with `weights`.
    """

    path: Path
    shape: tuple[int, int]
    dtype: str
    n_bands: int
    nodata: float | None
    bands: tuple[int, ...]
    weights: tuple[float, ...]

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """The window of rows x cols pixels that starts at (row, col); it lies inside the image.

        Raises
        ------
        InputError
            When the file can no longer be read, or has another size than when it was opened.
        """
        inside = 0 <= row <= row + rows <= self.shape[0] and 0 <= col <= col + cols <= self.shape[1]
        assert inside, f"window {row, col, rows, cols} leaves {self.path.name} of {self.shape}"
        with kept_raster(self.path) as source:
            if source.shape != self.shape:
                raise InputError(f"{self.path} has changed its size since it was opened. Start again.")
            return self._read(source, Window(col, row, cols, rows))

    @property
    def has_colours(self) -> bool:
        """Whether the file declares red, green and blue."""
        return len(self.bands) == len(LUMINANCE)

    def colours(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """Red, green and blue (3, r, c) of a window, in the file's own numbers.

        Raises
        ------
        InputError
            When the file can no longer be read.
        """
        assert self.has_colours, f"{self.path.name} is grey"
        with kept_raster(self.path) as source:
            values = source.read(list(self.bands), window=Window(col, row, cols, rows), out_dtype=np.float32)
        return np.nan_to_num(np.asarray(values, np.float32), copy=False, posinf=0.0, neginf=0.0)

    def _read(self, source: rasterio.DatasetReader, window: Window) -> ImageWindow:
        pixels = np.zeros((int(window.height), int(window.width)), np.float32)
        valid = np.ones(pixels.shape, bool)
        for band, weight in zip(self.bands, self.weights, strict=True):
            stored = source.read(band, window=window)
            values = stored.astype(np.float32)
            if stored.dtype.kind == "f":
                finite = np.isfinite(values)
                valid &= finite
                values[~finite] = 0.0
            pixels += values if weight == 1.0 else np.float32(weight) * values
        plain = len(self.bands) == 1 and stored.dtype.kind in "iu"
        if plain and source.mask_flag_enums[self.bands[0] - 1] == [MaskFlags.nodata]:
            valid = stored != source.nodata  # as GDAL masks it, without reading the band again
        else:
            valid &= self._mask(source, window)
        if not valid.all():
            pixels[~valid] = 0.0
        return ImageWindow(pixels, valid)

    def _mask(self, source: rasterio.DatasetReader, window: Window) -> NDArray[np.bool_]:
        """(r, c) bool. A colour pixel is nodata when all its bands are."""
        mask = np.zeros((int(window.height), int(window.width)), bool)
        for band in self.bands:
            if source.mask_flag_enums[band - 1] == [MaskFlags.all_valid]:
                return np.ones(mask.shape, bool)
            mask |= source.read_masks(band, window=window) > 0
        return mask


def open_image(path: Path) -> RasterImage:
    """The image of a file, found complete: every block lies inside the file and the last one decodes.

    Raises
    ------
    InputError
        For no such file, a folder, no image, a truncated file, complex or palette pixels.
    """
    path = Path(path)
    with open_raster(path) as source:
        if source.count == 0:
            raise InputError(f"{path} holds no image band (it may be a container). Give one of the images in it.")
        if "complex" in source.dtypes[0]:
            raise InputError(f"{path} holds complex numbers. Convert it to intensity first.")
        if source.colorinterp[0] == ColorInterp.palette:
            raise InputError(f"{path} holds colour numbers of a palette. Expand it: gdal_translate -expand gray.")
        bands, weights = _grey_bands(source)
        image = RasterImage(path, source.shape, source.dtypes[0], source.count, source.nodata, bands, weights)
        check_complete(source, path)
        image._read(source, _last_block(source, bands[0]))
        return image


def _last_block(source: rasterio.DatasetReader, band: int) -> Window:
    """The window of the last block of a band, without a list of all."""
    rows, cols = source.block_shapes[band - 1]
    row, col = (source.height - 1) // rows * rows, (source.width - 1) // cols * cols
    return Window(col, row, source.width - col, source.height - row)


def check_content(image: RasterImage) -> None:
    """Refuse an image with nothing to match: all nodata, or one value everywhere.

    Read by windows until two different valid values are met, so that an ordinary image costs one window.

    Raises
    ------
    InputError
        When no two valid pixels differ.
    """
    rows, cols = image.shape
    first: float | None = None
    for row, col in product(range(0, rows, CHECK_SIZE), range(0, cols, CHECK_SIZE)):
        window = image.read(row, col, min(CHECK_SIZE, rows - row), min(CHECK_SIZE, cols - col))
        values = window.pixels[window.valid]
        if not values.size:
            continue
        first = float(values[0]) if first is None else first
        if (values != first).any():
            return
    if first is None:
        raise InputError(
            f"{image.path} has no valid pixel (nodata = {image.nodata}). Check its nodata value, or leave it out."
        )
    raise InputError(f"{image.path} has the value {first:g} everywhere: nothing to match. Leave it out.")


def _grey_bands(source: rasterio.DatasetReader) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Band indices and their weights: red, green, blue where all three are declared, else the first band."""
    index = {meaning: band for band, meaning in zip(source.indexes, source.colorinterp, strict=True)}
    if all(colour in index for colour in LUMINANCE):
        return tuple(index[colour] for colour in LUMINANCE), tuple(LUMINANCE.values())
    return (1,), (1.0,)
