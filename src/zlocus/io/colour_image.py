"""Colours of an image from another one of the same pass, whose pixels are larger."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from zlocus.core.sensor_model import FloatArray
from zlocus.io.open_raster import cached_raster

# Pixels around a window that bilinear interpolation needs.
MARGIN_PX = 2


@dataclass(frozen=True)
class PlacePolynomials:
    """Where pixels of one image lie in another: quadratic polynomials of column and row.

    coefficients : (6, 2) as tuples, of 1, x, y, x², xy, y², with x and y from 0 to 1 over the image; shape : its rows
    and columns.
    """

    coefficients: tuple[tuple[float, float], ...]
    shape: tuple[int, int]

    @classmethod
    def fitted(cls, xy: FloatArray, places: FloatArray, shape: tuple[int, int]) -> PlacePolynomials:
        """The polynomials that fit best. xy : (n, 2) column and row; places : (n, 2) in the other image."""
        found = np.linalg.lstsq(_terms(xy, shape), places, rcond=None)[0]
        return cls(tuple((float(x), float(y)) for x, y in found), shape)

    def at(self, xy: FloatArray) -> FloatArray:
        """Columns and rows (n, 2) in the other image. xy : (n, 2) px."""
        return np.asarray(_terms(xy, self.shape) @ np.array(self.coefficients))


def _terms(xy: FloatArray, shape: tuple[int, int]) -> FloatArray:
    x, y = xy[:, 0] / shape[1], xy[:, 1] / shape[0]
    return np.column_stack([np.ones(len(xy)), x, y, x * x, x * y, y * y])


@dataclass(frozen=True)
class ColourImage:
    """The image that gives the colours of another one.

    path : of its file; camera : file of its camera, None where that is in the file; bands : numbers of its red, green
    and blue band, from 1; polynomials : where the pixels of the other image lie in it.
    """

    path: Path
    camera: Path | None
    bands: tuple[int, int, int]
    polynomials: PlacePolynomials

    @property
    def files(self) -> tuple[Path, ...]:
        """The files from which it is read."""
        return (self.path,) if self.camera is None else (self.path, self.camera)

    def colours(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """Red, green and blue (3, r, c) float32 of a window of the other image, in the numbers of the file.

        They are interpolated between the centres of the larger pixels. Beyond the border of this image the pixel at its
        border counts.

        Raises
        ------
        InputError
            The file can no longer be read.
        """
        across, down = np.meshgrid(np.arange(col, col + cols, dtype=float), np.arange(row, row + rows, dtype=float))
        xy = self.polynomials.at(np.column_stack([across.ravel(), down.ravel()])).reshape(rows, cols, 2)
        with cached_raster(self.path) as source:
            (left, top), (right, bottom) = (
                np.clip(np.floor(at).astype(int) + shift, 0, np.array(source.shape)[::-1] - 1)
                for at, shift in ((xy.min(axis=(0, 1)), -MARGIN_PX), (xy.max(axis=(0, 1)), MARGIN_PX + 1))
            )
            window = Window(left, top, right - left + 1, bottom - top + 1)
            bands = source.read(list(self.bands), window=window, out_dtype=np.float32)
        at_x, at_y = (np.ascontiguousarray(xy[..., k] - at, np.float32) for k, at in ((0, left), (1, top)))
        return np.stack(
            [cv2.remap(band, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for band in bands]
        )
