"""Perspective cameras of views in a local frame for other programs, and the images that go with them."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from zlocus.core.errors import GeometryError, InputError
from zlocus.core.scene import ImageSource, View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.io.image_bands import ImageBands
from zlocus.io.images import RasterImage
from zlocus.io.open_raster import open_raster
from zlocus.products.ortho_images import stored
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.ground_sampling import sampled
from zlocus.sensors.line_shifts import StraightenedImage
from zlocus.sensors.local_frame import LocalFrame
from zlocus.sensors.perspective_fit import (
    GRID_HEIGHTS,
    GRID_POINTS,
    FitError,
    PixelPart,
    correspondences,
    fit_perspective,
    without_skew,
)

FOLDER = "images"
# Side of the blocks in which images are resampled, px.
BLOCK_PX = 512
# Places along each side of the area, and heights, whose positions in an image bound the part that is cut out.
AREA_POINTS, AREA_HEIGHTS = 9, 3
# Pixels around that part, so that windows at its edge can be compared.
MARGIN_PX = 4
# Formats of images that other programs read as they are, and their numbers of bands.
PLAIN_FORMATS, PLAIN_BANDS = ("JPEG", "PNG", "GTiff"), (1, 3)
# Images of more than 8 bits are shown black and white at these percentages of the pixels of some rows.
BLACK_PERCENT, WHITE_PERCENT, SAMPLED_ROWS = 0.5, 99.5, 32


@dataclass(frozen=True)
class ExportArea:
    """Ground to be exported. bounds : (xmin, ymin, xmax, ymax) m; heights : lowest and highest, ellipsoidal, m."""

    bounds: tuple[float, float, float, float]
    heights: tuple[float, float]

    @property
    def points(self) -> FloatArray:
        """A grid of ground points (n, 3) m all over the area."""
        west, south, east, north = self.bounds
        axes = (
            np.linspace(west, east, AREA_POINTS), np.linspace(south, north, AREA_POINTS),
            np.linspace(*self.heights, AREA_HEIGHTS),
        )  # fmt: skip
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class ExportedView:
    """A view as other programs see it.

    view : with its corrected sensor; source_sensor : perspective camera of its whole image in the local frame; sensor :
    of the image that is written; shape : rows and columns of that; fit_error : None where the camera is exact; file :
    name of the image; is_copy : whether it is the image's own file, byte by byte.
    """

    view: View
    source_sensor: FrameModel
    sensor: FrameModel
    shape: tuple[int, int]
    fit_error: FitError | None
    file: str
    is_copy: bool

    def written_from_source(self, xy: FloatArray) -> FloatArray:
        """Positions (n, 2) px in the image that is written, of those in the view's image."""
        if self.sensor == self.source_sensor:
            return xy
        return self.sensor.image_from_ray(self.source_sensor.ray_from_image(xy))

    def source_from_written(self, xy: FloatArray) -> FloatArray:
        """Positions (n, 2) px in the view's image, of those in the image that is written."""
        if self.sensor == self.source_sensor:
            return xy
        return self.source_sensor.image_from_ray(self.sensor.ray_from_image(xy))

    def as_dict(self) -> dict[str, Any]:
        """What was done, for the record."""
        camera = {"camera": "exact"} if self.fit_error is None else {"camera": "fitted", **self.fit_error.as_dict()}
        pixels = "copied" if self.is_copy else "resampled"
        size = {"columns": self.shape[1], "rows": self.shape[0]}
        record = {"file": f"{FOLDER}/{self.file}", "source": str(self.view.path), "pixels": pixels, **size, **camera}
        if self.fit_error is not None:
            record["skew_removed_px"] = round(self.source_sensor.skew / self.source_sensor.aspect, 6)
            corner = self.source_from_written(np.zeros((1, 2)))[0]
            record["first_pixel_in_source"] = [round(float(value), 3) for value in corner]
        return record


def exported_view(
    view: View, frame: LocalFrame, area: ExportArea | None, file: str, can_be_said: Callable[[FrameModel], bool]
) -> ExportedView | None:
    """A view as other programs see it; None where it shows nothing of the area.

    area : needed by cameras that are no frame cameras in the frame's axes; file : name of the image without its ending;
    can_be_said : whether the format has words for the lens and the skew of a camera.

    Raises
    ------
    GeometryError
        No perspective camera can be fitted, or no area is known for it.
    """
    exact = frame_camera(view.sensor, frame)
    if exact is None or exact.rolling_shutter is not None:
        if area is None:
            raise GeometryError(
                f"No area is known over which {view.name} could be fitted. Give --bounds and --heights."
            )
        if exact is None:
            return _fitted_view(view, frame, area, file)
    rows, cols = view.image.shape
    plain, fit_error = exact, None
    if exact.rolling_shutter is not None:
        assert area is not None, "it was checked above"
        plain = replace(exact, rolling_shutter=None)
        part = PixelPart(0, 0, cols, rows)
        xy, local = correspondences(view.sensor, frame, part, area.heights, GRID_POINTS, GRID_HEIGHTS)
        fit_error = FitError.of(plain.image_from_ground(local) - xy)
    if not can_be_said(plain):
        ideal = replace(plain, skew=0.0)
        ideal = ideal if can_be_said(ideal) else replace(ideal, distortion=None)
        return ExportedView(view, plain, ideal, (rows, cols), fit_error, f"{file}.png", False)
    is_copy = is_plain(view.image)
    name = f"{file}{view.path.suffix.lower()}" if is_copy else f"{file}.png"
    return ExportedView(view, plain, plain, (rows, cols), fit_error, name, is_copy)


def frame_camera(sensor: SensorModel, frame: LocalFrame) -> FrameModel | None:
    """The frame camera of a sensor in local axes, exactly; None where it is none, or of other axes."""
    column = row = 0.0
    while isinstance(sensor, ShiftedModel):
        column, row, sensor = column + sensor.column, row + sensor.row, sensor.base_sensor
    if not isinstance(sensor, FrameModel):
        return None
    local = frame.camera(sensor)
    return None if local is None else local.moved(column, row)


def _fitted_view(view: View, frame: LocalFrame, area: ExportArea, file: str) -> ExportedView | None:
    part = part_of_area(view, area)
    if part is None:
        return None
    try:
        fit = fit_perspective(view.sensor, frame, part, area.heights)
    except GeometryError as error:
        raise GeometryError(f"{view.name}: {error}") from error
    sensor, shape = without_skew(fit.sensor, part)
    return ExportedView(view, fit.sensor, sensor, shape, fit.fit_error, f"{file}.png", False)


def part_of_area(view: View, area: ExportArea) -> PixelPart | None:
    """The part of an image that may show the area; None where it shows none of it."""
    xy = view.sensor.image_from_ground(area.points)
    xy = xy[np.isfinite(xy).all(axis=1)]
    if not len(xy):
        return None
    limits = np.array(view.image.shape[::-1])
    low = np.clip(np.floor(xy.min(axis=0)) - MARGIN_PX, 0, limits).astype(int)
    high = np.clip(np.ceil(xy.max(axis=0)) + 1 + MARGIN_PX, 0, limits).astype(int)
    if (high - low < 2 * MARGIN_PX).any():
        return None
    return PixelPart(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def is_plain(image: ImageSource) -> bool:
    """Whether other programs read the file of an image as it is: 8 bits, grey or in colours, in a common format."""
    if not isinstance(image, RasterImage) or image.dtype != "uint8" or image.colour_image is not None:
        return False
    if not image.path.is_file():  # in an archive or on a server
        return False
    with open_raster(image.path) as source:
        return source.driver in PLAIN_FORMATS and source.count in PLAIN_BANDS and len(image.bands) == source.count


def write_image(folder: Path, exported: ExportedView) -> None:
    """Write the image of a view, in blocks where it is resampled.

    Raises
    ------
    InputError
        The image can no longer be read.
    """
    path, source = folder / exported.file, exported.view.path
    if exported.is_copy:
        shutil.copyfile(source, path)
        return
    bands = shown_bands(exported.view.image)
    low, high = grey_limits(bands)
    rows, cols = exported.shape
    part = path.with_name(f".{path.name}.{os.getpid()}.part.tif")
    profile = {"driver": "GTiff", "width": cols, "height": rows, "count": len(bands.bands), "dtype": "uint8",
               "tiled": True, "blockxsize": BLOCK_PX, "blockysize": BLOCK_PX, "BIGTIFF": "IF_SAFER"}  # fmt: skip
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(part, "w", **profile) as target:
                for window in _windows(rows, cols):
                    values = _resampled(exported, bands, window)
                    scaled = (values - low) * (255.0 / (high - low))
                    target.write(stored(scaled, np.dtype(np.uint8)), window=window)
            with rasterio.Env(GDAL_PAM_ENABLED=False):
                rasterio.shutil.copy(part, path, driver="PNG")
    finally:
        part.unlink(missing_ok=True)


def _windows(rows: int, cols: int) -> Iterator[Window]:
    for row in range(0, rows, BLOCK_PX):
        for col in range(0, cols, BLOCK_PX):
            yield Window(col, row, min(BLOCK_PX, cols - col), min(BLOCK_PX, rows - row))


def _resampled(exported: ExportedView, bands: ImageBands, window: Window) -> NDArray[np.floating]:
    """Values (b, r, c) of a window of the image that is written; 0 beyond the view's image."""
    row, col = np.indices((window.height, window.width))
    xy = np.stack([col + window.col_off, row + window.row_off], axis=-1).astype(float)
    places = bands.displaced(exported.source_from_written(xy.reshape(-1, 2)).reshape(xy.shape))
    found = sampled(bands.read, bands.shape, places)
    if found is None:
        return np.zeros((len(bands.bands), window.height, window.width))
    return np.where(found.valid, found.values, 0.0)


def shown_bands(image: ImageSource) -> ImageBands:
    """The bands of an image that a picture shows: red, green and blue where it has them, else its grey band."""
    bands = ImageBands.of(image)
    wanted = bands.image.bands
    index = [bands.bands.index(number) for number in wanted]
    return replace(
        bands, bands=tuple(wanted), names=tuple(bands.names[i] for i in index),
        meanings=tuple(bands.meanings[i] for i in index),
    )  # fmt: skip


def grey_limits(bands: ImageBands) -> tuple[float, float]:
    """The values that are shown black and white: 0 and 255 of 8 bits, else such that few pixels lie beyond them."""
    if bands.dtype == np.uint8:
        return 0.0, 255.0
    rows, cols = bands.shape
    numbers = []
    for row in np.unique(np.linspace(0, rows - 1, SAMPLED_ROWS).astype(int)):
        window = bands.read(int(row), 0, 1, cols)
        numbers.append(window.values[:, window.valid].ravel())
    known = np.concatenate(numbers)
    if not len(known):
        raise InputError(f"{bands.image.path} has no valid pixel. Leave it out.")
    low, high = np.percentile(known, (BLACK_PERCENT, WHITE_PERCENT))
    return float(low), float(max(high, low + 1e-6))


def colours_of_points(views: Sequence[View], view: NDArray[np.int64], xy: FloatArray) -> NDArray[np.uint8]:
    """Colours (n, 3) that views show at image positions. view : (n,) number of the view; xy : (n, 2) px."""
    colours = np.full((len(xy), 3), 128, np.uint8)
    for number in np.unique(view):
        mine = np.flatnonzero(view == number)
        image = views[number].image
        bands = shown_bands(image.displaced_image if isinstance(image, StraightenedImage) else image)
        low, high = grey_limits(bands)
        at = np.clip(np.rint(xy[mine]).astype(int), 0, np.array(bands.shape[::-1]) - 1)
        for k in np.lexsort((at[:, 0], at[:, 1])):
            values = bands.read(int(at[k, 1]), int(at[k, 0]), 1, 1).values[:, 0, 0]
            colours[mine[k]] = stored((values - low) * (255.0 / (high - low)), np.dtype(np.uint8))
    return colours
