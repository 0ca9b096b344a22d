"""Products of image space: a coloured point cloud, and maps of height, depth and quality of each reference image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.grid import CellWindow
from zlocus.core.scene import ColourSource, ImageSource, Scene, View, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum
from zlocus.matching.fill import filled_from_behind
from zlocus.matching.image_space import ROWS_AT_ONCE
from zlocus.matching.quality import Quality, with_filled
from zlocus.pipeline.image_tiles import MatchedPixels
from zlocus.products.point_cloud import PointCloud, write_map
from zlocus.sensors.image_rays import DepthRays

# Images of more than 8 bits are shown white where only this share of the pixels of some rows is brighter.
WHITE_PERCENT = 99.5
WHITE_ROWS = 16


class PointWriter:
    """Writer of the points of a cloud, tile by tile of the reference images."""

    def __init__(self, cloud: PointCloud, scene: Scene, vertical_datum: VerticalDatum = ELLIPSOIDAL) -> None:
        """cloud : takes the points; scene : as it was opened, its views number the points; vertical_datum : of their
        heights."""
        self._cloud, self._scene, self._datum = cloud, scene, vertical_datum
        self._white = white_level(scene.views)
        self._number = {view.name: k for k, view in enumerate(scene.views, 1)}

    def write(self, matched_pixels: MatchedPixels, window: CellWindow) -> None:
        """Write the points of a window of pixels with their colours, some rows after others."""
        space, cols = matched_pixels.image.image_space, slice(window.col, window.col + window.cols)
        view = space.reference_view
        for first, n_rows in strips(window.rows):
            row = window.row + first
            part = slice(row, row + n_rows), cols
            height = matched_pixels.image.height[part]
            known = np.isfinite(height)
            if not known.any():
                continue
            xyz = space.ground(row, height, window.col)[known]
            xyz[:, 2] -= self._datum.undulation(xyz[:, :2], self._scene.crs)
            colours = read_colours(view.image, row, window.col, n_rows, window.cols)[known]
            rgb = np.rint(np.clip(colours / self._white, 0.0, 1.0) * 65535.0).astype(np.uint16)
            sigma_m = precision_m(matched_pixels, CellWindow(row, window.col, n_rows, window.cols), known)
            self._cloud.write(self._number[view.name], xyz, rgb, sigma_m, matched_pixels.surface.views[part][known])


def precision_m(matched_pixels: MatchedPixels, window: CellWindow, known: NDArray[np.bool_]) -> FloatArray:
    """Standard deviations (n,) in metres of the pixels of a window that have a height.

    They are those of the height, or along the ray for cameras that are matched by depth. known : (r, c) pixels of the
    window with a height.
    """
    rows, cols = np.nonzero(known)
    part = slice(window.row, window.row + window.rows), slice(window.col, window.col + window.cols)
    z, sigma = matched_pixels.image.height[part][known], matched_pixels.surface.sigma[part][known]
    xy = np.column_stack([cols + window.col, rows + window.row]).astype(float)
    return np.asarray(sigma * matched_pixels.image.image_space.rays.metres_per_unit(xy, z.astype(float)))


def strips(n_rows: int) -> Iterator[tuple[int, int]]:
    """First row and number of rows of each strip of an image."""
    edges = [*range(0, n_rows, ROWS_AT_ONCE), n_rows]
    return ((first, end - first) for first, end in pairwise(edges))


def read_colours(image: ImageSource, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
    """The colours of a window of an image, (r, c, 3) float32, in the file's own numbers; grey where it has none.

    Raises
    ------
    InputError
        The file can no longer be read.
    """
    if isinstance(image, ColourSource) and image.has_colours:
        return np.ascontiguousarray(np.moveaxis(image.colours(row, col, rows, cols), 0, -1))
    return np.repeat(image.read(row, col, rows, cols).pixels[..., np.newaxis], 3, axis=-1)


def white_level(views: Sequence[View]) -> float:
    """The grey value that is shown as white: 255 for 8-bit images, else a value that few pixels exceed."""
    if all(view.image.dtype == "uint8" for view in views):
        return 255.0
    numbers = []
    for view in views:
        rows, cols = view.image.shape
        for row in np.unique(np.linspace(0, rows - 1, WHITE_ROWS).astype(int)):
            valid = view.image.read(int(row), 0, 1, cols).valid
            numbers.append(read_colours(view.image, int(row), 0, 1, cols)[valid].max(axis=-1))
    known = np.concatenate(numbers)
    return max(float(np.percentile(known, WHITE_PERCENT)), 1e-6) if len(known) else 1.0


def write_maps(
    out: Path,
    name: str,
    matched_pixels: MatchedPixels,
    fill: str,
    crs: CRS,
    vertical_datum: VerticalDatum = ELLIPSOIDAL,
) -> list[str]:
    """Write NAME_height.tif, NAME_quality.tif and, for frame cameras, NAME_depth.tif; returns the names of the files.

    Without gaps to be filled, some rows are in memory at a time.
    """
    space, height, quality = matched_pixels.image.image_space, matched_pixels.image.height, matched_pixels.quality
    if fill == "interpolate":
        beyond = (quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
        whole = filled_from_behind(height, beyond)
        quality = with_filled(quality, np.isnan(height) & np.isfinite(whole))
        height = whole

    def heights_m() -> Iterator[NDArray[np.float32]]:
        for row, rows in strips(len(height)):
            xyz = space.ground(row, height[row : row + rows])
            known = np.isfinite(xyz).all(axis=-1)
            xyz[known, 2] -= vertical_datum.undulation(xyz[known, :2], crs)
            yield xyz[..., 2].astype(np.float32)

    def depths_m(scale: float) -> Iterator[NDArray[np.float32]]:
        for row, rows in strips(len(height)):
            part = height[row : row + rows]
            with np.errstate(divide="ignore", invalid="ignore"):
                yield np.where(part > 0, np.float32(scale) / part, np.float32(np.nan))

    above = "" if is_local(crs) else f" above {vertical_datum.surface_name}"
    names = [f"{name}_height.tif"]
    write_map(out / names[0], height.shape, heights_m(), f"height{above} of what the pixel shows", "m")
    if isinstance(space.rays, DepthRays):
        names.append(f"{name}_depth.tif")
        write_map(out / names[-1], height.shape, depths_m(space.rays.scale), "depth along the optical axis", "m")
    names.append(f"{name}_quality.tif")
    flags = (quality[row : row + rows] for row, rows in strips(len(quality)))
    write_map(out / names[-1], quality.shape, flags, "quality bit flags")
    return names
