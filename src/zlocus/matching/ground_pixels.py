"""Ground pixels of the images: how small cells may be, and the finest image reduced to the pixels of the others.

A correlation compares only details that both images resolve. A much finer image shows details that a coarser one does
not have; and in cells much finer than the coarser pixels, a window holds less than one of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError
from zlocus.core.footprints import Bounds, ground_sample_distance
from zlocus.core.scene import ColourSource, ImageSource, ImageWindow, Scene, View, masked_pixels
from zlocus.sensors.correction import ReducedModel

# The side of a cell is at least this share of the finest image's ground pixel.
MIN_CELL_SHARE = 0.1
# A scene has mixed ground pixels where those of the second finest image are more than so many times as large as those
# of the finest. Its finest image is reduced. At twice the size results are as good without.
MIN_MIXED_RATIO = 2.2
# In such a scene the side of a cell is at least this share of the second finest image's ground pixel: two images are
# needed.
MIN_MIXED_CELL_SHARE = 0.5


@dataclass(frozen=True)
class ReducedImage:
    """An image whose pixels are the means of `factor` x `factor` pixels of another, valid where most of these are.

    The last rows and columns are dropped where they fill no whole pixel.
    """

    full_image: ImageSource
    factor: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.full_image.shape
        return rows // self.factor, cols // self.factor

    @property
    def dtype(self) -> str:
        """See `ImageSource`."""
        return self.full_image.dtype

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """See `ImageSource`."""
        window = self.full_image.read(*(number * self.factor for number in (row, col, rows, cols)))
        share = self._means(window.valid.astype(np.float32))
        total = self._means(np.where(window.valid, window.pixels, np.float32(0.0)))
        valid = share > 0.5
        return ImageWindow(np.where(valid, total / np.maximum(share, np.float32(1e-6)), np.float32(0.0)), valid)

    def masked(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_] | None:
        """See `MaskedSource`; a pixel is masked where half of the others are."""
        masked = masked_pixels(self.full_image, *(number * self.factor for number in (row, col, rows, cols)))
        return None if masked is None else self._means(masked.astype(np.float32)) >= 0.5

    @property
    def has_colours(self) -> bool:
        """See `ColourSource`."""
        return isinstance(self.full_image, ColourSource) and self.full_image.has_colours

    def colours(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """See `ColourSource`."""
        assert isinstance(self.full_image, ColourSource), "callers ask whether it has colours"
        full = self.full_image.colours(*(number * self.factor for number in (row, col, rows, cols)))
        return np.stack([self._means(band) for band in full])

    def _means(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        rows, cols = (size // self.factor for size in values.shape)
        return np.asarray(values.reshape(rows, self.factor, cols, self.factor).mean(axis=(1, 3)), np.float32)


def median_ground_pixel(scene: Scene, z: float) -> float:
    """Median ground pixel of the views at height z (m), m."""
    return float(np.median(ground_pixels(scene.views, z)))


def ground_pixels(views: Sequence[View], z: float) -> list[float]:
    """Ground pixel of every view at height z (m), m."""
    return [ground_sample_distance(view, z) for view in views]


def cell_side(resolution: float | None, scene: Scene, z: float) -> float:
    """Cell size of a run, m: the requested resolution, or else the default for the images at height z."""
    return resolution or default_cell(scene, z)


def default_cell(scene: Scene, z: float) -> float:
    """Default side of the cells, m, rounded to two digits: the median ground pixel at height z (m).

    Where all images but one are much coarser, it is the ground pixel of the second finest image.
    """
    common = common_pixel(ground_pixels(scene.views, z))
    pixel = median_ground_pixel(scene, z)
    return float(f"{pixel if common is None else max(pixel, common):.2g}")


def common_pixel(pixels: Sequence[float]) -> float | None:
    """Ground pixel (m) of the second finest image where it is much coarser than the finest; else None."""
    finest = sorted(pixel for pixel in pixels if np.isfinite(pixel))[:2]
    return finest[1] if len(finest) == 2 and finest[1] > MIN_MIXED_RATIO * finest[0] else None


def check_resolution(resolution: float, scene: Scene, z: float, given: str) -> None:
    """Refuse cells that are much finer than the images.

    resolution : side of the cells, m; z : m, a height of the ground; given : where the resolution was set, for the
    message.

    Raises
    ------
    ConfigError
        The cells are finer than a tenth of the finest image's ground pixel, or than half of the second finest image's
        in a scene of mixed ground pixels.
    """
    pixels = ground_pixels(scene.views, z)
    finest, common = min(pixels), common_pixel(pixels)
    if resolution < MIN_CELL_SHARE * finest:
        raise ConfigError(
            f"{given} {resolution:g} m is finer than a tenth of the finest image's pixel ({finest:.3g} m on the "
            f"ground). Ask for {finest:.2g} m or a few times that."
        )
    if common is not None and resolution < MIN_MIXED_CELL_SHARE * common:
        name = scene.views[int(np.argmin(pixels))].name
        raise ConfigError(
            f"{given} {resolution:g} m is too fine: two images are compared in every cell, and only {name} has pixels "
            f"of {finest:.2g} m on the ground, the next has {common:.2g} m. Ask for "
            f"{rounded_up(MIN_MIXED_CELL_SHARE * common):g} m or more, or add another fine image."
        )


def check_cells_in_overlap(cell_m: float, window_cells: int, shared: Bounds, pixel_m: float, given: str) -> None:
    """Refuse cells so large that the smallest window of them does not fit into the ground that two images share.

    cell_m : side of the cells, m; window_cells : cells along a side of the smallest window that images are compared in;
    shared : bounds of the shared ground, m; pixel_m : the images' ground pixel, m; given : where the resolution was
    set, for the message.

    Raises
    ------
    ConfigError
        No window fits.
    """
    width_m, height_m = shared[2] - shared[0], shared[3] - shared[1]
    largest = min(width_m, height_m) / window_cells
    if cell_m > largest:
        raise ConfigError(
            f"{given} {cell_m:g} m is too coarse for these images: a height takes windows of {window_cells} x "
            f"{window_cells} cells, which are {window_cells * cell_m:g} m wide, and two images share only "
            f"{width_m:.3g} x {height_m:.3g} m of ground. Ask for less than {largest:.2g} m; the images' pixels are "
            f"{pixel_m:.2g} m on the ground."
        )


def rounded_up(size: float) -> float:
    """The next larger number of two digits."""
    unit = 10.0 ** (math.floor(math.log10(size)) - 1)
    return float(f"{math.ceil(size / unit - 1e-9) * unit:.6g}")


def with_common_pixel(views: Sequence[View], z: float) -> tuple[View, ...]:
    """The views; where the second finest image has much larger ground pixels, the finest is reduced to about these.

    z : m, a height of the ground.
    """
    pixels = ground_pixels(views, z)
    common = common_pixel(pixels)
    if common is None:
        return tuple(views)
    return tuple(
        reduced(view, max(round(common / pixel), 1)) if pixel < common else view
        for view, pixel in zip(views, pixels, strict=True)
    )


def reduced(view: View, factor: int) -> View:
    """A view whose image has `factor` times larger pixels."""
    if factor == 1:
        return view
    return replace(view, image=ReducedImage(view.image, factor), sensor=ReducedModel(view.sensor, factor))
