"""Products of image space: a coloured point cloud, and maps of height, depth and quality of each reference image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.scene import Scene, View, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.colour import read_colours
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum
from zlocus.matching.fill import filled_from_behind
from zlocus.matching.image_space import ROWS_AT_ONCE
from zlocus.matching.quality import Quality
from zlocus.pipeline.image_tiles import MatchedPixels
from zlocus.products.point_cloud import PointCloud, write_map
from zlocus.sensors.image_rays import DepthRays

# Images of more than 8 bits are shown white where only this share of the pixels of some rows is brighter.
WHITE_PERCENT = 99.5
WHITE_ROWS = 16


def write_cloud(
    out: Path, matched: Sequence[MatchedPixels], scene: Scene, vertical_datum: VerticalDatum = ELLIPSOIDAL
) -> int:
    """Write all points with their colours, with heights above the vertical datum; returns the number of points."""
    n_points = sum(int(np.isfinite(m.image.height).sum()) for m in matched)
    white = white_level(scene.views)
    number = {view.name: k for k, view in enumerate(scene.views, 1)}
    with PointCloud(out, n_points, vertical_datum.compound_crs(scene.crs)) as cloud:
        for matched_pixels in matched:
            view, height = matched_pixels.image.image_space.reference_view, matched_pixels.image.height
            for row, rows in strips(len(height)):
                known = np.isfinite(height[row : row + rows])
                if known.any():
                    part = slice(row, row + rows)
                    xyz = matched_pixels.image.image_space.ground(row, height[part])[known]
                    xyz[:, 2] -= vertical_datum.undulation(xyz[:, :2], scene.crs)
                    share = np.clip(read_colours(view.path, row, rows)[known] / white, 0.0, 1.0)
                    rgb = np.rint(share * 65535.0).astype(np.uint16)
                    sigma_m = precision_m(matched_pixels, row, known)
                    cloud.write(number[view.name], xyz, rgb, sigma_m, matched_pixels.surface.views[part][known])
    return n_points


def precision_m(matched_pixels: MatchedPixels, row: int, known: NDArray[np.bool_]) -> FloatArray:
    """Standard deviations (n,) in metres of the pixels of some rows that have a height.

    They are those of the height, or along the ray for cameras that are matched by depth. row : first of the rows; known
    : (r, c) pixels with a height.
    """
    rows, cols = np.nonzero(known)
    part = slice(row, row + len(known))
    z, sigma = matched_pixels.image.height[part][known], matched_pixels.surface.sigma[part][known]
    xy = np.column_stack([cols, rows + row]).astype(float)
    return np.asarray(sigma * matched_pixels.image.image_space.rays.metres_per_unit(xy, z.astype(float)))


def strips(n_rows: int) -> Iterator[tuple[int, int]]:
    """First row and number of rows of each strip of an image."""
    edges = [*range(0, n_rows, ROWS_AT_ONCE), n_rows]
    return ((first, end - first) for first, end in pairwise(edges))


def white_level(views: Sequence[View]) -> float:
    """The grey value that is shown as white: 255 for 8-bit images, else a value that few pixels exceed."""
    if all(view.image.dtype == "uint8" for view in views):
        return 255.0
    numbers = []
    for view in views:
        rows, cols = view.image.shape
        for row in np.unique(np.linspace(0, rows - 1, WHITE_ROWS).astype(int)):
            valid = view.image.read(int(row), 0, 1, cols).valid
            numbers.append(read_colours(view.path, int(row), 1)[valid].max(axis=-1))
    known = np.concatenate(numbers)
    return max(float(np.percentile(known, WHITE_PERCENT)), 1e-6) if len(known) else 1.0


def write_maps(
    out: Path,
    name: str,
    matched_pixels: MatchedPixels,
    fill: str,
    crs: CRS,
    vertical_datum: VerticalDatum = ELLIPSOIDAL,
) -> None:
    """NAME_height.tif, NAME_quality.tif and, for frame cameras, NAME_depth.tif."""
    space, height, quality = matched_pixels.image.image_space, matched_pixels.image.height, matched_pixels.quality
    if fill == "interpolate":
        beyond = (quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
        whole = filled_from_behind(height, beyond)
        quality = np.where(np.isnan(height) & np.isfinite(whole), quality | np.uint16(Quality.FILLED), quality)
        height = whole
    z = np.empty(height.shape, np.float32)
    for row, rows in strips(len(height)):
        xyz = space.ground(row, height[row : row + rows])
        known = np.isfinite(xyz).all(axis=-1)
        xyz[known, 2] -= vertical_datum.undulation(xyz[known, :2], crs)
        z[row : row + rows] = xyz[..., 2]
    above = "" if is_local(crs) else f" above {vertical_datum.surface_name}"
    write_map(out / f"{name}_height.tif", z, f"height{above} of what the pixel shows", "m")
    if isinstance(space.rays, DepthRays):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(height > 0, np.float32(space.rays.scale) / height, np.float32(np.nan))
        write_map(out / f"{name}_depth.tif", depth, "depth along the optical axis", "m")
    write_map(out / f"{name}_quality.tif", quality, "quality bit flags")
