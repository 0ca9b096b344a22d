"""Read images by window: one grey channel as float32, and a mask of valid pixels."""

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
from zlocus.core.scene import NOT_KNOWN, Acquisition, HeldPixels, ImageWindow
from zlocus.io.archives import is_archived
from zlocus.io.colour_image import ColourImage
from zlocus.io.decoded_images import DECODED, whole_bytes
from zlocus.io.image_acquisition import acquisition_of
from zlocus.io.masks.image_mask import ImageMask
from zlocus.io.open_raster import UNCOMPRESSED_DRIVERS, cached_raster, check_complete, open_raster
from zlocus.io.stored_files import file_state, is_remote
from zlocus.io.tiled_products import is_tile_index, named_tiles
from zlocus.io.usable_pixels import MAX_GREY_VALUE, BorderPlateau, border_plateau, count_too_large_values, drop_pixels

# Source: ITU-R BT.601, luma of red, green, blue.
LUMINANCE = {ColorInterp.red: 0.299, ColorInterp.green: 0.587, ColorInterp.blue: 0.114}
# Pixels of a window that is searched for texture, and of all windows that are searched before an image is refused.
CHECK_WINDOW_PX, MAX_CHECKED_PX = 1 << 20, 1 << 30
# Four million pixels a side. Searching a larger image for tie points would take months.
MAX_IMAGE_PX = 1 << 44
# Larger images are not read as a whole for their checks: too large values are still invalid, but nobody is warned of
# them, and plateaus at the border are not searched for.
MAX_COUNTED_PX = 2_000_000_000


@dataclass(frozen=True)
class RasterImage:
    """An image file as an `ImageSource`.

    The grey channel is the luminance (Rec. 601) where the file declares red, green and blue bands, otherwise the first
    band. Invalid are: the declared nodata value, pixels that an internal or side-car mask excludes or an alpha band
    makes fully transparent, NaN, infinities and numbers too large for grey values, a `plateau` at the border, and
    pixels that a sparse file does not store. All other pixels are valid. In particular 0 is a valid grey value unless
    it is declared as nodata.

    The object is a plain value that threads and processes can share: open files are kept by thread, see
    `cached_raster`.

    bands : 1-based indices of the bands that are read; weights : their weights in the grey value; plateau : pixels of
    one value at the border, which are invalid, see `with_plateau`; held : the parts that a sparse file stores, see
    `SparseSource`; state : size and time of the file when it was opened, see `file_state`; sources : other files from
    which pixels or mask are read; decoded_bytes : see `DecodedSource`; acquisition : what the file says of the
    exposure; colour_image : another image that gives its colours, None for its own; mask : pixels that show no ground,
    None without a mask.
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
    decoded_bytes: int = field(default=0, compare=False, repr=False)
    acquisition: Acquisition = field(default=NOT_KNOWN, compare=False, repr=False)
    colour_image: ColourImage | None = None
    mask: ImageMask | None = field(default=None, compare=False, repr=False)

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """Read the window of rows x cols pixels that starts at (row, col) and lies inside the image.

        Raises
        ------
        InputError
            The file can no longer be read, or its size has changed.
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
        masked = self.masked(row, col, rows, cols)
        if masked is not None:
            window = drop_pixels(window, masked)
        return window if self.plateau is None else drop_pixels(window, self.plateau.covers(row, col, rows, cols))

    def masked(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_] | None:
        """The pixels (r, c) of a window that the mask covers; None without a mask.

        Raises
        ------
        InputError
            A file of the mask can no longer be read, or has changed its size.
        """
        return None if self.mask is None else self.mask.covers(row, col, rows, cols)

    @property
    def has_colours(self) -> bool:
        """Whether the file declares red, green and blue bands, or another image gives them."""
        return self.colour_image is not None or len(self.bands) == len(LUMINANCE)

    def colours(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """Red, green and blue (3, r, c) float32 of a window, in the file's own numbers.

        Raises
        ------
        InputError
            The file can no longer be read.
        """
        assert self.has_colours, f"{self.path.name} is grey"
        if self.colour_image is not None:
            return self.colour_image.colours(row, col, rows, cols)
        with cached_raster(self.path) as source:
            window = Window(col, row, cols, rows)
            stored = [DECODED.window(source, self.path, band, window) for band in self.bands]
        values = np.stack(stored, dtype=np.float32)
        if np.issubdtype(stored[0].dtype, np.floating):
            np.nan_to_num(values, copy=False, posinf=0.0, neginf=0.0)
        return values

    def _read(self, source: rasterio.DatasetReader, window: Window) -> ImageWindow:
        pixels, valid = None, np.ones((int(window.height), int(window.width)), bool)
        for band, weight in zip(self.bands, self.weights, strict=True):
            stored = DECODED.window(source, self.path, band, window)
            values = np.multiply(stored, np.float32(weight), dtype=np.float32, casting="unsafe")
            if may_hold_too_large_values(stored.dtype):
                with np.errstate(invalid="ignore"):
                    is_grey = np.abs(values) <= weight * MAX_GREY_VALUE  # False for NaN and infinities too
                valid &= is_grey
                values[~is_grey] = 0.0
            pixels = values if pixels is None else np.add(pixels, values, out=pixels)
        assert pixels is not None, "there is a band"
        plain = len(self.bands) == 1 and stored.dtype.kind in "iu"
        if plain and source.mask_flag_enums[self.bands[0] - 1] == [MaskFlags.nodata]:
            valid = stored != source.nodata  # GDAL's mask, without reading the band again
        else:
            valid &= self._mask(source, window)
        if not valid.all():
            pixels[~valid] = 0.0
        return ImageWindow(pixels, valid)

    def _mask(self, source: rasterio.DatasetReader, window: Window) -> NDArray[np.bool_]:
        """The mask of the file, (r, c) bool. A colour pixel is invalid where all its bands are."""
        mask = np.zeros((int(window.height), int(window.width)), bool)
        for band in self.bands:
            if source.mask_flag_enums[band - 1] == [MaskFlags.all_valid]:
                return np.ones(mask.shape, bool)
            mask |= source.read_masks(band, window=window) > 0
        return mask


def open_image(path: Path) -> RasterImage:
    """Open an image and check that it is complete: every block lies inside the file, and the last one can be decoded.

    Raises
    ------
    InputError
        There is no such file, it is a folder or no image, it is truncated, or its pixels are complex or of a palette.
    """
    image = open_header(path)
    check_last_block(image)
    return image


def open_header(path: Path, colour_image: ColourImage | None = None) -> RasterImage:
    """Open an image without reading any of its pixels: every block lies inside the file.

    colour_image : another image that gives its colours.

    Raises
    ------
    InputError
        See `open_image`.
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
        sources = _sources(source, path) + (() if colour_image is None else colour_image.files)
        image = replace(image, held=held, state=tuple(state), sources=sources, colour_image=colour_image)
        image = replace(image, decoded_bytes=whole_bytes(source, path))
        return replace(image, acquisition=acquisition_of(source))


def check_last_block(image: RasterImage) -> None:
    """Check that the last block of an image can be decoded.

    Raises
    ------
    InputError
        It cannot.
    """
    with open_raster(image.path) as source:
        image._read(source, _last_block(source, image.bands[0]))


def _sources(source: rasterio.DatasetReader, path: Path) -> tuple[Path, ...]:
    """The other files from which pixels are read: those of a virtual raster, the header of raw pixels, and a mask.

    Overviews and statistics are not read, and the readers of cameras name their own files.
    """
    if is_tile_index(path):
        return tuple(named_tiles(path))
    if is_archived(path):
        return ()
    others = [Path(name) for name in source.files if Path(name) != path]
    if source.driver == "VRT" or source.driver in UNCOMPRESSED_DRIVERS:
        return tuple(other for other in others if not other.name.endswith((".ovr", ".aux.xml")))
    return tuple(other for other in others if other.suffix == ".msk")


def _last_block(source: rasterio.DatasetReader, band: int) -> Window:
    """The window of the last block of a band, computed without listing all blocks."""
    rows, cols = source.block_shapes[band - 1]
    row, col = (source.height - 1) // rows * rows, (source.width - 1) // cols * cols
    return Window(col, row, source.width - col, source.height - row)


def check_content(image: RasterImage) -> None:
    """Check that an image has something to match: two valid pixels with different values.

    Windows are read until such pixels are found, so an ordinary image costs one window. The windows are spread over the
    stored parts of the image. After `MAX_CHECKED_PX` pixels the image is refused, so that this takes seconds at most.

    Raises
    ------
    InputError
        All pixels read are invalid, or have the same value.
    """
    first: float | None = None
    windows = _CheckWindows.of(image)
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
    if first is None and image.mask is not None:
        where = "" if windows.is_whole else f" in any of {some}"
        masks = ", ".join(str(part.path) for part in image.mask.parts)
        raise InputError(
            f"{image.path} has no valid pixel outside its mask ({masks}){where}. Check the mask, or leave the image "
            "out."
        )
    if first is None:
        where = "" if windows.is_whole else f" in any of {some}"
        raise InputError(
            f"{image.path} has no valid pixel{where} (nodata = {image.nodata}). Check its nodata value, or {advice}."
        )
    where = "everywhere" if windows.is_whole else f"in all of {some}"
    raise InputError(f"{image.path} has the value {first:g} {where}: nothing to match. {advice.capitalize()}.")


@dataclass(frozen=True)
class _CheckWindows:
    """Windows of the stored parts of an image, in an order in which successive windows lie far apart.

    regions : (n, 4) px, first row, first column, and the first row and column beyond each stored part; size : rows and
    columns of a window.
    """

    regions: NDArray[np.int64]
    size: tuple[int, int]

    @classmethod
    def of(cls, image: RasterImage) -> _CheckWindows:
        """Windows about as wide as the blocks of the file, because blocks are decoded as a whole."""
        with cached_raster(image.path) as source:
            block_cols = source.block_shapes[image.bands[0] - 1][1]
        regions = np.array([[0, 0, *image.shape]]) if image.held is None else image.held.regions
        rows, cols = (int(side.max()) for side in (regions[:, 2:] - regions[:, :2]).T)
        width = min(max(block_cols, math.isqrt(CHECK_WINDOW_PX)), CHECK_WINDOW_PX, cols)
        return cls(regions, (min(max(CHECK_WINDOW_PX // width, 1), rows), width))

    def __iter__(self) -> Iterator[tuple[int, int, int, int]]:
        """Yield first row, first column, rows and columns of each window."""
        # The step is the golden section of the number of windows. It visits each window once, because both numbers
        # have no common divisor.
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
        """Number of windows that are read."""
        return min(self._n, max(MAX_CHECKED_PX // math.prod(self.size), 1))

    @property
    def is_whole(self) -> bool:
        """Whether all windows are read."""
        return self.n_read == self._n

    @property
    def _across(self) -> int:
        return -(-int((self.regions[:, 3] - self.regions[:, 1]).max()) // self.size[1])

    @property
    def _n(self) -> int:
        down = -(-int((self.regions[:, 2] - self.regions[:, 0]).max()) // self.size[0])
        return down * self._across * len(self.regions)


def may_hold_too_large_values(dtype: np.dtype[np.generic]) -> bool:
    """Whether pixels of a type can hold numbers beyond `MAX_GREY_VALUE`."""
    return dtype.kind == "f" or dtype.itemsize > 4


def check_grey_values(image: RasterImage) -> None:
    """Warn of values that are too large for grey values, which are treated as invalid.

    Raises
    ------
    InputError
        More than half of the values are too large.
    """
    if not may_hold_too_large_values(np.dtype(image.dtype)) or is_remote(image.path):
        return
    if image.shape[0] * image.shape[1] > MAX_COUNTED_PX:
        return
    with cached_raster(image.path) as source:

        def rows_of_first_band(row: int, count: int) -> NDArray[np.floating]:
            return np.asarray(source.read(image.bands[0], window=Window(0, row, image.shape[1], count)), np.float64)

        too_large = count_too_large_values(image.shape, rows_of_first_band)
    if not too_large.n_pixels or (image.nodata is not None and too_large.largest == abs(image.nodata)):
        return
    if 2 * too_large.n_pixels > too_large.n_known:
        raise InputError(
            f"{image.path} holds values up to {too_large.largest:.3g}, which cannot be grey values. Scale them to "
            f"numbers below {MAX_GREY_VALUE:.3g}, or declare them as nodata."
        )
    warnings.warn(
        f"{image.path}: {too_large.n_pixels} of its pixels hold values up to {too_large.largest:.3g}, which cannot be "
        "grey values: they are left out.",
        ZlocusWarning,
        stacklevel=2,
    )


def with_plateau(image: RasterImage) -> RasterImage:
    """The image with a plateau at its border made invalid, and a warning; the image itself where it has no plateau.

    Raises
    ------
    InputError
        The image cannot be read.
    """
    if image.shape[0] * image.shape[1] > MAX_COUNTED_PX:
        return image
    plateau = border_plateau(replace(image, mask=None))
    if plateau is None:
        return image
    share = 100.0 * plateau.n_pixels / (image.shape[0] * image.shape[1])
    warnings.warn(
        f"{image.path}: {share:.1f} % of its pixels are a border of the constant value {plateau.value:g} that no tag "
        "declares: it is taken for nodata. Declare it with gdal_edit.py -a_nodata to be rid of this note.",
        ZlocusWarning,
        stacklevel=2,
    )
    return replace(image, plateau=plateau)


def _grey_bands(source: rasterio.DatasetReader) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Band indices and their weights: red, green, blue where all three are declared, else the first band."""
    index = {meaning: band for band, meaning in zip(source.indexes, source.colorinterp, strict=True)}
    if all(colour in index for colour in LUMINANCE):
        return tuple(index[colour] for colour in LUMINANCE), tuple(LUMINANCE.values())
    return (1,), (1.0,)
