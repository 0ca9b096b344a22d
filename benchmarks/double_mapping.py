"""Double mapping of an ortho-image: cells that show an object which occludes them in the source image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from scipy.ndimage import map_coordinates

from zlocus.core.scene import Scene

# Grey values: a cell of the ortho-image differs from its source image by rounding only. If a second image is as
# similar, the source is unknown.
SAME_GREY, SIMILAR_GREY = 1.5, 2.0
# Metres: step along a ray, tolerance of the truth above the ray, highest building, rim of the truth that is left out.
STEP_M, ABOVE_M, HIGHEST_M, RIM_M = 0.25, 0.3, 60.0, 10.0
RIGHT_M = 1.0
KINDS = {"ground": (0, 1), "building": (2,), "tree": (3,)}


def double_mapped(folder: Path, truth: Path, classes: Path, scene: Scene) -> dict[str, tuple[float, float]]:
    """Share of the cells of each class that are occluded in the image they were taken from.

    The first number counts all cells, the second those with a right height.

    folder : result of `zlocus dsm` with `products.ortho_levels = "own"`, because the source of a cell is recognised by
    its grey value; truth, classes : rasters of the rendered scene; scene : its images.
    """
    with rasterio.open(truth) as file:
        z_true, to_truth = file.read(1).astype(float), ~file.transform
    with rasterio.open(classes) as file:
        kind_true = file.read(1)
    with rasterio.open(folder / "ortho.tif") as file:
        grey, shown, transform = file.read(1).astype(float), file.read_masks(1) > 0, file.transform
    with rasterio.open(folder / "dsm.tif") as file:
        z_found = file.read(1).astype(float)
    row, col = np.indices(grey.shape)
    x, y = transform * (col + 0.5, row + 0.5)
    u, v = to_truth * (x, y)
    rim = RIM_M * to_truth.a
    inside = shown & (u > rim) & (v > rim) & (u < z_true.shape[1] - rim) & (v < z_true.shape[0] - rim)
    x, y, grey, z_found = x[inside], y[inside], grey[inside], z_found[inside]
    at = v[inside].astype(int), u[inside].astype(int)
    z, kind, right = z_true[at], kind_true[at], np.abs(z_found - z_true[at]) < RIGHT_M
    free = np.array([_sees(view.sensor, np.column_stack([x, y, z]), z_true, to_truth) for view in scene.views])
    away = np.array([np.abs(_grey(view, np.column_stack([x, y, z_found])) - grey) for view in scene.views])
    source, nearest = away.argmin(axis=0), away.min(axis=0)
    known = (nearest <= SAME_GREY) & ((away <= nearest + SIMILAR_GREY).sum(axis=0) == 1) & free.any(axis=0)
    hidden = ~free[source, np.arange(len(x))]
    return {
        name: (float(hidden[of].mean()), float(hidden[of & right].mean()))
        for name, kinds in KINDS.items()
        if (of := known & np.isin(kind, kinds)).any()
    }


def _sees(sensor, xyz: np.ndarray, z_true: np.ndarray, to_truth) -> np.ndarray:
    """Whether a sensor sees the points (n, 3) without occlusion by the true surface, (n,) bool."""
    up = sensor.ground_from_image(sensor.image_from_ground(xyz), xyz[:, 2] + 10.0)
    by_metre, free = (up[:, :2] - xyz[:, :2]) / 10.0, np.ones(len(xyz), bool)
    rows, cols = z_true.shape
    for height in np.arange(2 * STEP_M, HIGHEST_M, STEP_M):
        u, v = to_truth * tuple((xyz[:, :2] + by_metre * height).T)
        r, c = v.astype(int).clip(0, rows - 1), u.astype(int).clip(0, cols - 1)
        free &= z_true[r, c] <= xyz[:, 2] + height + ABOVE_M
    return free


def _grey(view, xyz: np.ndarray) -> np.ndarray:
    """Bilinear grey values (n,) of an image at ground points (n, 3)."""
    xy = view.sensor.image_from_ground(xyz)
    pixels = view.image.read(0, 0, *view.image.shape).pixels
    return map_coordinates(pixels, [xy[:, 1], xy[:, 0]], order=1, mode="nearest")
