"""Levels of the images of a mosaic: a gain and an offset of each band, so that images agree where they overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray

# Cells whose scaled values differ by more than so many robust standard deviations show other things in both images.
MAX_SIGMAS, MAD_TO_SIGMA, ROUNDS = 2.5, 1.4826, 5
# Overlaps of fewer cells tell nothing; from so many cells on, all count the same.
MIN_CELLS, FULL_CELLS = 30, 2000
# Weight of leaving an image as it is, beside overlaps of weight 1.
PRIOR_WEIGHT = 1e-3
# A gain beyond these limits is a mistake.
GAIN_LIMITS = 0.1, 10.0


@dataclass(frozen=True, eq=False)
class Overlap:
    """Values of two images on the cells that both show.

    first, second : numbers of the images; weight : of the overlap; mean, spread : (b, 2) mean and standard deviation of
    each band, of the first and of the second image.
    """

    first: int
    second: int
    weight: float
    mean: FloatArray
    spread: FloatArray


@dataclass(frozen=True, eq=False)
class ColourLevels:
    """What images are multiplied by, and what is added then: gain, offset : (i, b)."""

    gain: FloatArray
    offset: FloatArray

    @classmethod
    def none(cls, n_images: int, n_bands: int) -> ColourLevels:
        """Images as they are."""
        return cls(np.ones((n_images, n_bands)), np.zeros((n_images, n_bands)))

    def levelled(self, values: NDArray[np.floating], image: int) -> NDArray[np.floating]:
        """Values (b, r, c) of an image, levelled."""
        gain, offset = (each[image].astype(values.dtype)[:, None, None] for each in (self.gain, self.offset))
        return np.asarray(values * gain + offset)


def overlap_of(first: int, second: int, values: NDArray[np.floating]) -> Overlap | None:
    """The overlap of two images; None where it is too small. values : (2, b, n) of the cells that both show."""
    n_bands = values.shape[1]
    if values.shape[2] < MIN_CELLS:
        return None
    mean, spread, weights = np.zeros((n_bands, 2)), np.zeros((n_bands, 2)), []
    for band in range(n_bands):
        pair = values[:, band].astype(float)
        kept = np.ones(pair.shape[1], bool)
        for _ in range(ROUNDS):
            middle, size = pair[:, kept].mean(axis=1), np.maximum(pair[:, kept].std(axis=1), 1e-9)
            scaled = (pair - middle[:, None]) / size[:, None]
            differs = scaled[0] - scaled[1]
            centre = float(np.median(differs[kept]))
            sigma = MAD_TO_SIGMA * float(np.median(np.abs(differs[kept] - centre)))
            kept = np.abs(differs - centre) <= max(MAX_SIGMAS * sigma, 1e-9)
            if kept.sum() < MIN_CELLS:
                return None
        mean[band], spread[band] = pair[:, kept].mean(axis=1), np.maximum(pair[:, kept].std(axis=1), 1e-9)
        weights.append(min(int(kept.sum()), FULL_CELLS) / FULL_CELLS)
    return Overlap(first, second, float(min(weights)), mean, spread)


def colour_levels(n_images: int, n_bands: int, overlaps: list[Overlap]) -> ColourLevels:
    """The levels that make images agree in their overlaps, and change their common brightness and contrast least."""
    levels = ColourLevels.none(n_images, n_bands)
    if not overlaps:
        return levels
    for band in range(n_bands):
        contrast = float(np.median([each.spread[band] for each in overlaps]))
        rows = [(each.first, each.second, each.weight, np.log(each.spread[band, 1] / each.spread[band, 0]))
                for each in overlaps]  # fmt: skip
        gain = np.clip(np.exp(_solved(n_images, rows, np.zeros(n_images))), *GAIN_LIMITS)
        usual = _usual_values(n_images, overlaps, band)
        rows = [
            (each.first, each.second, each.weight,
             (gain[each.second] * each.mean[band, 1] - gain[each.first] * each.mean[band, 0]) / contrast)
            for each in overlaps
        ]  # fmt: skip
        levels.gain[:, band] = gain
        levels.offset[:, band] = _solved(n_images, rows, usual * (1.0 - gain) / contrast) * contrast
    return levels


def _usual_values(n_images: int, overlaps: list[Overlap], band: int) -> FloatArray:
    """Mean value (i,) of a band of each image in its overlaps; 0 for an image without any."""
    total, weight = np.zeros(n_images), np.zeros(n_images)
    for each in overlaps:
        for side, image in enumerate((each.first, each.second)):
            total[image] += each.weight * each.mean[band, side]
            weight[image] += each.weight
    return np.asarray(total / np.maximum(weight, 1e-12))


def _solved(n_images: int, rows: list[tuple[int, int, float, float]], prior: FloatArray) -> FloatArray:
    """Unknowns (i,) with given differences: rows of first, second, weight and value of x[first] - x[second].

    prior : (i,), what they are where nothing else says so.
    """
    normal, pull = np.eye(n_images) * PRIOR_WEIGHT, PRIOR_WEIGHT * prior
    for first, second, weight, value in rows:
        normal[[first, second], [first, second]] += weight
        normal[first, second] -= weight
        normal[second, first] -= weight
        pull[first] += weight * value
        pull[second] -= weight * value
    return np.asarray(np.linalg.solve(normal, pull))
