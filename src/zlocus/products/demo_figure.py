"""A picture of a surface beside its truth, with the error: relief shading, coloured by height."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from zlocus.core.options import ProductOptions
from zlocus.io.atomic_write import write_atomically
from zlocus.products.hillshade import hillshade
from zlocus.products.shade_kernel import BRIGHTEST, DARKEST

FloatImage = NDArray[np.float32]
GAP = 12
CAPTION = 34
EMPTY_GREY = 255
# Factors of a colour's brightness in shade and facing the sun.
SHADE_FACTOR, SUN_FACTOR = np.float32(0.35), np.float32(1.1)
ERROR_SCALE_M = 1.0
SUN_DEG = (ProductOptions().sun_azimuth_deg, ProductOptions().sun_altitude_deg)
INK = (40, 40, 40)


def picture_beside_truth(dsm: Path, truth: Path, path: Path, side: int = 480) -> None:
    """Write a PNG of the surface, the truth and the error, `side` pixels high each, on the cells of the truth.

    Both surfaces are shaded from the north-west and share one range of colours (2nd to 98th percentile of the truth);
    the error is red where the surface is too high and blue where it is too low, saturated at 1 m. Cells without height
    are white.
    """
    true, cell_m = read_averaged(truth, None, side)
    height, _ = read_averaged(dsm, truth, side)
    low, high = np.nanpercentile(true, (2.0, 98.0))
    panels = [
        _captioned(relief(height, cell_m, (low, high)), "surface"),
        _captioned(relief(true, cell_m, (low, high)), f"truth, {low:.0f} to {high:.0f} m"),
        _captioned(error_map(height - true), f"error, blue -{ERROR_SCALE_M:g} m to red +{ERROR_SCALE_M:g} m"),
    ]
    gap = np.full((panels[0].shape[0], GAP, 3), 255, np.uint8)
    done, png = cv2.imencode(".png", np.hstack([panels[0], gap, panels[1], gap, panels[2]]))
    write_atomically(path, lambda part: part.write_bytes(png.tobytes() if done else b""))


def relief(
    height: FloatImage, cell_m: float, span: tuple[float, float], sun_deg: tuple[float, float] = SUN_DEG
) -> NDArray[np.uint8]:
    """Heights (r, c) as colours, shaded like hillshade.tif: (r, c, 3) uint8 in OpenCV's order.

    span : heights, m, of the first and the last colour; sun_deg : azimuth and altitude of the sun.
    """
    share = np.clip((height - span[0]) / max(span[1] - span[0], 1e-6), 0.0, 1.0)
    colours = cv2.applyColorMap(np.nan_to_num(255.0 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    light = (hillshade(height, cell_m, *sun_deg).astype(np.float32) - DARKEST) / (BRIGHTEST - DARKEST)
    shaded = colours * (SHADE_FACTOR + (SUN_FACTOR - SHADE_FACTOR) * light)[..., None]
    return _empty_white(np.clip(shaded, 0, 255), np.isfinite(height))


def error_map(error: FloatImage, saturated_m: float = ERROR_SCALE_M) -> NDArray[np.uint8]:
    """Errors (r, c), m, as red (too high), white and blue (too low): (r, c, 3) uint8 in OpenCV's order.

    saturated_m : size of an error, m, from which its colour is saturated.
    """
    share = np.clip(np.nan_to_num(error) / saturated_m, -1.0, 1.0)
    blue, green, red = 1.0 - np.maximum(share, 0.0), 1.0 - np.abs(share), 1.0 + np.minimum(share, 0.0)
    # No error is light grey, so that it differs from cells without a height, which are white.
    return _empty_white(225.0 * np.stack([blue, green, red], axis=-1), np.isfinite(error))


def _empty_white(colours: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(known[..., None], colours, EMPTY_GREY).astype(np.uint8)


def _captioned(panel: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    strip = np.full((CAPTION, panel.shape[1], 3), 255, np.uint8)
    cv2.putText(strip, text, (2, CAPTION - 11), cv2.FONT_HERSHEY_SIMPLEX, 0.55, INK, 1, cv2.LINE_AA)
    return np.vstack([strip, panel])


def read_averaged(path: Path, like: Path | None, side: int) -> tuple[FloatImage, float]:
    """Heights of a raster (r, c), `side` rows, NaN where there is none; and the cell size, m.

    like : raster whose extent is read; None: the raster's own extent.
    """
    with rasterio.open(like or path) as frame:
        shape = side, max(round(side * frame.width / frame.height), 1)
        transform = frame.transform * frame.transform.scale(frame.width / shape[1], frame.height / shape[0])
        crs = frame.crs
    with rasterio.open(path) as file, WarpedVRT(
        file, crs=crs, transform=transform, height=shape[0], width=shape[1], nodata=float("nan"),
        resampling=Resampling.average,
    ) as view:  # fmt: skip
        return view.read(1).astype(np.float32), float(transform.a)
