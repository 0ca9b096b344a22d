"""Masks from rasters, which may have fewer pixels than the image, over the same extent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.decoded_images import DECODED
from zlocus.io.masks.band_rule import BandRule
from zlocus.io.masks.class_names import named_values, shows_ground, values_of, words_of
from zlocus.io.masks.mask_entry import MaskEntry
from zlocus.io.masks.planet_masks import is_udm, is_udm2, udm2_rules, udm_rules
from zlocus.io.open_raster import cached_raster, check_complete, open_raster


@dataclass(frozen=True)
class RasterMask:
    """A mask from a raster.

    shape : rows and columns of the image; raster_shape : of the raster; rules : a pixel is masked where one of them
    says so; is_outside : whether all other pixels are masked instead.
    """

    path: Path
    shape: tuple[int, int]
    raster_shape: tuple[int, int]
    rules: tuple[BandRule, ...]
    is_outside: bool = False

    def covers(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_]:
        """See `MaskPart`; of a smaller raster, the pixel counts that contains the centre of the image's pixel."""
        r = self._nearest(np.arange(row, row + rows), 0)
        c = self._nearest(np.arange(col, col + cols), 1)
        window = Window(int(c[0]), int(r[0]), int(c[-1] - c[0]) + 1, int(r[-1] - r[0]) + 1)
        masked = np.zeros((int(window.height), int(window.width)), bool)
        with cached_raster(self.path) as source:
            if source.shape != self.raster_shape:
                raise InputError(f"{self.path} has changed its size since it was opened. Start again.")
            for rule in self.rules:
                masked |= rule.masks(DECODED.window(source, self.path, rule.band, window))
        if self.raster_shape != self.shape:
            masked = masked[np.ix_(r - r[0], c - c[0])]
        return ~masked if self.is_outside else masked

    def _nearest(self, pixels: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
        """Rows (axis 0) or columns (axis 1) of the raster that contain the centres of rows or columns of the image."""
        factor = _whole_factor(self.shape, self.raster_shape)
        if factor is not None:
            return pixels // factor
        n_raster, n_image = self.raster_shape[axis], self.shape[axis]
        return (2 * pixels + 1) * n_raster // (2 * n_image)


def _whole_factor(shape: tuple[int, int], raster_shape: tuple[int, int]) -> int | None:
    """How many pixels of the image a pixel of the raster covers along each side, where that is a whole number and only
    the last ones may reach beyond the image; None where it is not."""
    factor = max(-(-n // m) for n, m in zip(shape, raster_shape, strict=True))
    fits = all(-(-n // factor) == m for n, m in zip(shape, raster_shape, strict=True))
    return factor if fits else None


def open_raster_mask(entry: MaskEntry, path: Path, image: Path, shape: tuple[int, int]) -> RasterMask:
    """Open a mask and check that it fits the image. image, shape : path, rows and columns of the image.

    Raises
    ------
    InputError
        The raster cannot be read or does not cover the image, or has not the band, value or name that is asked for.
    """
    if entry.coordinates is not None or entry.height is not None:
        raise InputError(f"coordinates and height are for polygons, and {path} is a raster. Leave them out.")
    with open_raster(path, "mask") as source:
        check_complete(source, path)
        _check_extent(source, path, image, shape)
        rules = _rules(entry, source, path)
    return RasterMask(path, shape, source.shape, rules, bool(entry.outside))


def _check_extent(source: rasterio.DatasetReader, path: Path, image: Path, shape: tuple[int, int]) -> None:
    """Refuse a raster that cannot cover the same extent as the image."""
    if source.shape == shape:
        return
    size = f"{source.height} x {source.width} px, and {image} {shape[0]} x {shape[1]} px"
    if source.crs is not None:
        raise InputError(
            f"{path} has {size}, and a CRS: it is on the ground, where rasters are not read as masks. Give "
            "one in the pixels of the image, or polygons."
        )
    smaller = all(m <= n for m, n in zip(source.shape, shape, strict=True))
    # The number of image pixels along a side of a mask pixel, which was rounded up or down along both axes.
    low = max(n / (m + 1) for m, n in zip(source.shape, shape, strict=True))
    high = min(n / max(m - 1, 0.5) for m, n in zip(source.shape, shape, strict=True))
    if not smaller or low >= high:
        raise InputError(
            f"{path} has {size}: it does not cover the same extent with as many or fewer pixels. Check that "
            "it belongs to this image."
        )


def _rules(entry: MaskEntry, source: rasterio.DatasetReader, path: Path) -> tuple[BandRule, ...]:
    """The rules of a mask of Planet, or of any other raster: given values or names, the names of its classes, or all
    values other than 0."""
    is_open = entry.kind is None and entry.band is None and entry.names is None
    if entry.kind == "udm2" or (is_open and is_udm2(source)):
        return udm2_rules(entry, source, path)
    if entry.kind == "udm" or (is_open and is_udm(source, path)):
        return udm_rules(entry, path)
    band, names = _band(entry.band, source, path), dict(entry.names or {})
    if entry.values is not None:
        if not names and any(isinstance(value, str) for value in entry.values):
            names = named_values(source, path, band)
        return (BandRule(band, values=values_of(entry.values, names, path)),)
    names = names or named_values(source, path, band)
    hiding = tuple(sorted({value for name, value in names.items() if value != 0 and not shows_ground(name)}))
    if names:
        return (BandRule(band, values=hiding),)
    return (BandRule(band, nodata=source.nodatavals[band - 1]),)


def _band(given: int | str | None, source: rasterio.DatasetReader, path: Path) -> int:
    """The 1-based index of the band that is asked for, by number or description; the first one by default."""
    if given is None:
        return 1
    if isinstance(given, int):
        if not 1 <= given <= source.count:
            raise InputError(f"{path} has {source.count} bands, not a band {given}. Correct `band`.")
        return given
    return band_named(given, source.descriptions, path)


def band_named(name: str, descriptions: Sequence[str | None], path: Path) -> int:
    """The 1-based index of the band whose description is a name.

    Raises
    ------
    InputError
        There is none, or more than one.
    """
    found = [i for i, text in enumerate(descriptions, 1) if text and words_of(text) == words_of(name)]
    if len(found) != 1:
        has = ", ".join(text for text in descriptions if text) or "bands without names"
        raise InputError(f"{path} has {len(found) or 'no'} bands called {quoted(name)}: it has {has}.")
    return found[0]
