"""Images read by window: one grey channel as float32 and a mask of valid pixels."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.windows import Window

from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.core.scene import HeldPixels, ImageWindow
from zlocus.io.open_raster import (
    UNCOMPRESSED_DRIVERS,
    cached_raster,
    check_complete,
    file_state,
    is_remote,
    open_raster,
)
from zlocus.io.usable_pixels import MAX_GREY_VALUE, BorderPlateau, border_plateau, count_too_large_values, drop_pixels

# Source: ITU-R BT.601, luma of red, green, blue.
LUMINANCE = {ColorInterp.red: 0.299, ColorInterp.green: 0.587, ColorInterp.blue: 0.114}
# What is read in search of something to match: pixels of a window, and of all windows before an image is refused.
CHECK_WINDOW_PX, MAX_CHECKED_PX = 1 << 20, 1 << 30
# Four million a side; to look for tie points in more takes months.
MAX_IMAGE_PX = 1 << 44
# Larger images, in pixels, are not read as a whole for what they should not hold: absurd values are left out all the
# same, but not counted, and borders of one value are matched as they are.
MAX_COUNTED_PX = 2_000_000_000


@dataclass(frozen=True)
class RasterImage:
    """An image file as an `ImageSource`.

    The grey channel is the luminance (Rec. 601) where the file declares red, green and blue bands, otherwise the first
    band. Not valid are: the declared nodata value, pixels off in an internal or side-car mask or fully transparent in
    an alpha band, NaN, infinities and other numbers that cannot be grey values, a `plateau` at the border, and what a
    sparse file never held. Beside that, an integer image that declares no nodata value is valid everywhere: 0 is a
    legal grey value.

    The object is a plain value that threads and processes can share: open files are kept by thread, see `cached_raster`.

    bands : 1-based indices of the bands that are read, with `weights`; plateau : pixels of one value at the border,
    which are not valid; see `with_plateau`. held : see `SparseSource`. state : of the file when it was opened, see
    `file_state`; sources : other files that its pixels and their mask are read from.
    """

    path: Path
    shape: tuple[int, int]
    dtype: str
    n_bands: int
    nodata: float | None
    bands: tuple[int, ...]
    weights: tuple[float, ...]
    plateau: BorderPlateau | None = None
    held: HeldPixels | None = field(default=None, compare=False, repr=False)
    state: tuple[int, ...] = field(default=(), compare=False, repr=False)
    sources: tuple[Path, ...] = field(default=(), compare=False, repr=False)

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """The window of rows x cols pixels that starts at (row, col); it lies inside the image.

        Raises
        ------
        InputError
            When the file can no longer be read, or has another size than when it was opened.
        """
        inside = 0 <= row <= row + rows <= self.shape[0] and 0 <= col <= col + cols <= self.shape[1]
        assert inside, f"window {row, col, rows, cols} leaves {self.path.name} of {self.shape}"
        with cached_raster(self.path) as source:
            if source.shape != self.shape:
                raise InputError(f"{self.path} has changed its size since it was opened. Start again.")
            window = self._read(source, Window(col, row, cols, rows))
        missing = None if self.held is None else self.held.missing(row, col, rows, cols)
        if missing is not None:
            window = drop_pixels(window, missing)
        return window if self.plateau is None else drop_pixels(window, self.plateau.covers(row, col, rows, cols))

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
        with cached_raster(self.path) as source:
            values = source.read(list(self.bands), window=Window(col, row, cols, rows), out_dtype=np.float32)
        return np.nan_to_num(np.asarray(values, np.float32), copy=False, posinf=0.0, neginf=0.0)

    def _read(self, source: rasterio.DatasetReader, window: Window) -> ImageWindow:
        pixels = np.zeros((int(window.height), int(window.width)), np.float32)
        valid = np.ones(pixels.shape, bool)
        for band, weight in zip(self.bands, self.weights, strict=True):
            stored = source.read(band, window=window)
            values = stored.astype(np.float32)
            if may_hold_too_large_values(stored.dtype):
                is_grey = np.abs(values) <= MAX_GREY_VALUE  # neither are NaN and infinities
                valid &= is_grey
                values[~is_grey] = 0.0
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
    state = file_state(path)
    with open_raster(path) as source:
        if source.count == 0:
            raise InputError(f"{path} holds no image band (it may be a container). Give one of the images in it.")
        if "complex" in source.dtypes[0]:
            raise InputError(f"{path} holds complex numbers. Convert it to intensity first.")
        if source.colorinterp[0] == ColorInterp.palette:
            raise InputError(f"{path} holds colour numbers of a palette. Expand it: gdal_translate -expand gray.")
        if source.height * source.width > MAX_IMAGE_PX:
            raise InputError(
                f"{path} is {source.height} x {source.width} px, more than can be matched. Cut out the part that is "
                "wanted: gdal_translate -srcwin."
            )
        bands, weights = _grey_bands(source)
        image = RasterImage(path, source.shape, source.dtypes[0], source.count, source.nodata, bands, weights)
        held = check_complete(source, path)
        if held is not None and not held.cells.any():
            raise InputError(
                f"{path} holds no pixels: it is a sparse file of {image.shape[0]} x {image.shape[1]} px, and none of "
                "its blocks was ever written. Copy it again from its source, or leave it out."
            )
        image._read(source, _last_block(source, bands[0]))
        return replace(image, held=held, state=tuple(state), sources=_sources(source, path))


def _sources(source: rasterio.DatasetReader, path: Path) -> tuple[Path, ...]:
    """Files beside an image that its pixels are read from: those that a virtual raster lists, the header of pixels as
    they are, and a mask. Overviews and statistics are not read, and readers of cameras name their own files."""
    others = [Path(name) for name in source.files if Path(name) != path]
    if source.driver == "VRT" or source.driver in UNCOMPRESSED_DRIVERS:
        return tuple(other for other in others if not other.name.endswith((".ovr", ".aux.xml")))
    return tuple(other for other in others if other.suffix == ".msk")


def _last_block(source: rasterio.DatasetReader, band: int) -> Window:
    """The window of the last block of a band, without a list of all."""
    rows, cols = source.block_shapes[band - 1]
    row, col = (source.height - 1) // rows * rows, (source.width - 1) // cols * cols
    return Window(col, row, source.width - col, source.height - row)


def check_content(image: RasterImage) -> None:
    """Refuse an image with nothing to match: all nodata, or one value everywhere.

    Read by windows until two different valid values are met, so that an ordinary image costs one window. Windows are
    spread over what the file holds; beyond `MAX_CHECKED_PX` no more are read, so that an image of any size is refused
    within seconds.

    Raises
    ------
    InputError
        When no two valid pixels differ.
    """
    first: float | None = None
    windows = _Windows.of(image)
    for row, col, rows, cols in windows:
        window = image.read(row, col, rows, cols)
        values = window.pixels[window.valid]
        if not values.size:
            continue
        first = float(values[0]) if first is None else first
        if (values != first).any():
            return
    some = f"{windows.n_read} windows spread over its {image.shape[0]} x {image.shape[1]} px"
    advice = "leave it out" if windows.is_whole else "cut out the part that shows something: gdal_translate -srcwin"
    if first is None:
        where = "" if windows.is_whole else f" in any of {some}"
        raise InputError(
            f"{image.path} has no valid pixel{where} (nodata = {image.nodata}). Check its nodata value, or {advice}."
        )
    where = "everywhere" if windows.is_whole else f"in all of {some}"
    raise InputError(f"{image.path} has the value {first:g} {where}: nothing to match. {advice.capitalize()}.")


@dataclass(frozen=True)
class _Windows:
    """Windows of what the file of an image holds, in an order in which those that follow each other lie far apart.

    regions : (n, 4) first row, first column, and the first row and column beyond, px; they are cut into windows of
    `size`, rows and columns.
    """

    regions: NDArray[np.int64]
    size: tuple[int, int]

    @classmethod
    def of(cls, image: RasterImage) -> _Windows:
        """About as wide as the blocks of the file, which are decoded whole."""
        with cached_raster(image.path) as source:
            block_cols = source.block_shapes[image.bands[0] - 1][1]
        regions = np.array([[0, 0, *image.shape]]) if image.held is None else image.held.regions
        rows, cols = (int(side.max()) for side in (regions[:, 2:] - regions[:, :2]).T)
        width = min(max(block_cols, math.isqrt(CHECK_WINDOW_PX)), CHECK_WINDOW_PX, cols)
        return cls(regions, (min(max(CHECK_WINDOW_PX // width, 1), rows), width))

    def __iter__(self) -> Iterator[tuple[int, int, int, int]]:
        """First row, first column, rows and columns."""
        # Steps of the golden section of their number, which meet each once where they have no divisor in common.
        n = self._n
        step = max(round(n * (math.sqrt(5.0) - 1.0) / 2.0), 1)
        while math.gcd(step, n) > 1:
            step += 1
        for k in range(self.n_read):
            part, region = divmod(k * step % n, len(self.regions))
            top, left, bottom, right = self.regions[region].tolist()
            row, col = top + part // self._across * self.size[0], left + part % self._across * self.size[1]
            if row < bottom and col < right:
                yield row, col, min(self.size[0], bottom - row), min(self.size[1], right - col)

    @property
    def n_read(self) -> int:
        """How many of them are read."""
        return min(self._n, max(MAX_CHECKED_PX // math.prod(self.size), 1))

    @property
    def is_whole(self) -> bool:
        """Whether all of them are."""
        return self.n_read == self._n

    @property
    def _across(self) -> int:
        return -(-int((self.regions[:, 3] - self.regions[:, 1]).max()) // self.size[1])

    @property
    def _n(self) -> int:
        down = -(-int((self.regions[:, 2] - self.regions[:, 0]).max()) // self.size[0])
        return down * self._across * len(self.regions)


def may_hold_too_large_values(dtype: np.dtype[np.generic]) -> bool:
    """Whether pixels of a type can hold numbers that are larger than any grey value."""
    return dtype.kind == "f" or dtype.itemsize > 4


def check_grey_values(image: RasterImage) -> None:
    """Warn of values that are too large for grey values, which are left out; refuse an image that has little else.

    Raises
    ------
    InputError
        Where more than half of the values are too large.
    """
    if not may_hold_too_large_values(np.dtype(image.dtype)) or is_remote(image.path):
        return
    if image.shape[0] * image.shape[1] > MAX_COUNTED_PX:
        return
    with cached_raster(image.path) as source:

        def rows_of_first_band(row: int, count: int) -> NDArray[np.floating]:
            return np.asarray(source.read(image.bands[0], window=Window(0, row, image.shape[1], count)), np.float64)

        found = count_too_large_values(image.shape, rows_of_first_band)
    if not found.n_pixels or (image.nodata is not None and found.largest == abs(image.nodata)):
        return
    if 2 * found.n_pixels > found.n_known:
        raise InputError(
            f"{image.path} holds values up to {found.largest:.3g}, which cannot be grey values. Scale them to numbers "
            f"below {MAX_GREY_VALUE:.3g}, or declare them as nodata."
        )
    warnings.warn(
        f"{image.path}: {found.n_pixels} of its pixels hold values up to {found.largest:.3g}, which cannot be grey "
        "values: they are left out.",
        ZlocusWarning,
        stacklevel=2,
    )


def with_plateau(image: RasterImage) -> RasterImage:
    """The image without the pixels of one value at its border, if it has such, and a warning that says so.

    Raises
    ------
    InputError
        Where the image cannot be read.
    """
    if image.shape[0] * image.shape[1] > MAX_COUNTED_PX:
        return image
    found = border_plateau(image)
    if found is None:
        return image
    share = 100.0 * found.n_pixels / (image.shape[0] * image.shape[1])
    warnings.warn(
        f"{image.path}: {share:.1f} % of its pixels are a border of the constant value {found.value:g} that no tag "
        "declares: it is taken for nodata. Declare it with gdal_edit.py -a_nodata to be rid of this note.",
        ZlocusWarning,
        stacklevel=2,
    )
    return replace(image, plateau=found)


def _grey_bands(source: rasterio.DatasetReader) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Band indices and their weights: red, green, blue where all three are declared, else the first band."""
    index = {meaning: band for band, meaning in zip(source.indexes, source.colorinterp, strict=True)}
    if all(colour in index for colour in LUMINANCE):
        return tuple(index[colour] for colour in LUMINANCE), tuple(LUMINANCE.values())
    return (1,), (1.0,)
