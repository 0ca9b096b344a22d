"""Truth rasters of a rendered scene: heights and classes of its area, or of all ground that two images show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin

from zlocus.core.mask_box import box_of
from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.scenes import Exposure, SceneSpec
from zlocus.synthetic.terrain import WATER, SyntheticGround

# A camera is evaluated at nodes at this spacing, and interpolated in between. The error is below 0.1 px, so it matters
# only for cells at the border of an image.
NODE_CELLS, NODE_HEIGHT_M = 32, 10.0


def write_truth(
    spec: SceneSpec, ground: SyntheticGround, exposures: Sequence[Exposure], folder: Path, suffix: str = ""
) -> None:
    """Write `truth_dsm.tif` and `truth_class.tif`, and with a painted trouble `trouble.tif`, at the step of the height
    field. suffix : at the end of the names.

    They cover the area of the scene, or with `spec.whole_truth` all ground that two or more of the exposures show; then
    heights are NaN where fewer do. Occlusion is ignored: an image shows every point that lies inside it. In realistic
    scenes heights of water are NaN too: images show nothing of it that stays.
    """
    known: NDArray[np.bool_] | None = None
    if spec.whole_truth:
        known = n_images_showing(ground, exposures) >= 2
        cells = box_of(known)
    else:
        n_cells = round(spec.size * spec.gsd_m / spec.step_m)
        cells = ground.cells(spec.west_m, spec.north_m, (n_cells, n_cells))
    heights, classes = ground.heights[cells], ground.classes[cells]
    if known is not None:
        heights = np.where(known[cells], heights, np.float32(np.nan))
    if spec.kind == "real":
        heights = np.where(classes == WATER, np.float32(np.nan), heights)
    has_gaps = known is not None or spec.kind == "real"
    west, north = ground.x0 + cells[1].start * ground.step, ground.y0 - cells[0].start * ground.step
    profile = {
        "driver": "GTiff", "height": heights.shape[0], "width": heights.shape[1], "count": 1, "compress": "deflate",
        "crs": f"EPSG:{spec.epsg}", "transform": from_origin(west, north, spec.step_m, spec.step_m),
    }  # fmt: skip
    layers: tuple[tuple[str, NDArray[np.generic], str, float | None], ...] = (
        (f"truth_dsm{suffix}.tif", heights, "height above the ellipsoid", np.nan if has_gaps else None),
        (f"truth_class{suffix}.tif", classes, "class", None),
    )
    if ground.marked is not None:
        layers += (("trouble.tif", ground.marked[cells].astype(np.uint8), "cells of the painted trouble", None),)
    for name, values, description, nodata in layers:
        with rasterio.open(folder / name, "w", dtype=values.dtype, nodata=nodata, **profile) as file:
            file.write(np.ascontiguousarray(values), 1)
            file.set_band_description(1, description)


def n_images_showing(ground: SyntheticGround, exposures: Sequence[Exposure]) -> NDArray[np.uint8]:
    """Number of images inside whose borders each cell of the ground lies, (r, c) uint8, occluded or not."""
    count = np.zeros(ground.heights.shape, np.uint8)
    for exposure in exposures:
        xy = image_positions(ground, exposure)
        last = np.array([exposure.shape[1] - 1, exposure.shape[0] - 1])
        count += ((xy >= 0) & (xy <= last)).all(axis=-1)
    return count


def image_positions(ground: SyntheticGround, exposure: Exposure) -> FloatArray:
    """Image positions (r, c, 2) px, column and row, of the cells of the ground; interpolated between nodes."""
    rows, cols = ground.heights.shape
    low, high = ground.height_range
    levels = np.linspace(low, high, max(int(np.ceil((high - low) / NODE_HEIGHT_M)), 1) + 1)
    # cv2.resize puts the centre of node k at (k + 0.5) NODE_CELLS - 0.5 cells.
    n_nodes = [-(-n // NODE_CELLS) + 2 for n in (rows, cols)]
    at_row, at_col = ((np.arange(n) - 0.5) * NODE_CELLS - 0.5 for n in n_nodes)
    x = ground.x0 + (at_col + 0.5) * ground.step
    y = ground.y0 - (at_row + 0.5) * ground.step
    column, row = np.meshgrid(x, y)
    below, place = np.empty((rows, cols, 2)), np.full((rows, cols, 2), np.nan)
    for k, level in enumerate(levels):
        nodes = np.column_stack([column.ravel(), row.ravel(), np.full(column.size, level)])
        xy = exposure.sensor.image_from_ground(nodes).reshape(*column.shape, 2)
        size = n_nodes[1] * NODE_CELLS, n_nodes[0] * NODE_CELLS
        here = cv2.resize(xy, size, interpolation=cv2.INTER_LINEAR)[NODE_CELLS : NODE_CELLS + rows]
        here = here[:, NODE_CELLS : NODE_CELLS + cols]
        if k:
            share = (ground.heights - levels[k - 1]) / (level - levels[k - 1])
            between = (share >= 0) & (share <= 1)
            part = share[between, None]
            place[between] = below[between] * (1 - part) + here[between] * part
        below = here
    return place
