"""Affine cameras over a textured hill: every image point, height and shift is known exactly."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS
from scipy.ndimage import gaussian_filter, map_coordinates

from zlocus.core.scene import ImageWindow, Scene, View
from zlocus.orientation.triangulate import Observations, project_points
from zlocus.sensors.correction import ShiftedModel

GSD_M = 0.5
TEXTURE_PX = 700
BASE_HEIGHT_M = 100.0


@dataclass(frozen=True)
class AffineSensor:
    """Parallel rays: `east` and `north` metres of ground position per metre of height, rotated in the image."""

    east: float
    north: float
    centre: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0
    bounds: tuple[float, float] | None = (0.0, 300.0)

    def _turn(self):
        angle = np.deg2rad(self.turn_deg)
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def image_from_ground(self, xyz):
        flat = xyz[:, :2] - (xyz[:, 2:] - BASE_HEIGHT_M) * np.array([self.east, self.north])
        return (flat * np.array([1.0, -1.0]) / GSD_M) @ self._turn() + np.array(self.centre)

    def ground_from_image(self, xy, z):
        flat = (xy - np.array(self.centre)) @ self._turn().T * np.array([1.0, -1.0]) * GSD_M
        z = np.broadcast_to(z, (len(xy),))
        return np.column_stack([flat + (z[:, None] - BASE_HEIGHT_M) * np.array([self.east, self.north]), z])

    def height_bounds(self):
        return self.bounds


@dataclass(frozen=True)
class ArrayImage:
    """Pixels in memory."""

    pixels: np.ndarray
    valid: np.ndarray

    @property
    def shape(self):
        return self.pixels.shape

    def read(self, row, col, rows, cols):
        assert 0 <= row <= row + rows <= self.shape[0]
        assert 0 <= col <= col + cols <= self.shape[1]
        window = slice(row, row + rows), slice(col, col + cols)
        return ImageWindow(np.where(self.valid[window], self.pixels[window], np.float32(0)), self.valid[window])


def image_of(pixels, valid=None):
    """An image source from an array."""
    return ArrayImage(pixels.astype(np.float32), np.ones(pixels.shape, bool) if valid is None else valid)


def hill(x, y):
    """Height of the ground: a hill of 20 m."""
    return BASE_HEIGHT_M + 20.0 * np.exp(-(x**2 + y**2) / (2 * 40.0**2))


def texture():
    """Smooth noise of several sizes, (TEXTURE_PX, TEXTURE_PX), one value per GSD_M."""
    rng = np.random.default_rng(11)
    layers = [gaussian_filter(rng.normal(size=(TEXTURE_PX, TEXTURE_PX)), s, mode="wrap") * s for s in (1.2, 3.0, 8.0)]
    return np.sum(layers, axis=0)


def rendered(sensor, size, coefficients):
    """What the sensor sees of the hill, (size, size)."""
    xy = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2).astype(float)
    z = np.full(len(xy), BASE_HEIGHT_M)
    for _ in range(25):
        xyz = sensor.ground_from_image(xy, z)
        z = hill(xyz[:, 0], xyz[:, 1])
    at = xyz[:, [1, 0]].T / GSD_M + TEXTURE_PX / 2
    seen = map_coordinates(coefficients, at, order=3, mode="grid-wrap")
    return (2000.0 + 300.0 * seen).reshape(size, size)


def hill_scene(errors, looks=((0.0, 0.0), (0.25, 0.05), (-0.2, 0.15)), size=280, turn_deg=(0.0, 7.0, -5.0)):
    """Views of the hill whose models project `errors` (column, row) px too far."""
    coefficients, views = texture(), []
    for i, error in enumerate(errors):
        exact = AffineSensor(*looks[i], (size / 2, size / 2), turn_deg[i])
        name = f"view{i}"
        image = image_of(rendered(exact, size, coefficients))
        views.append(View(name, Path(f"{name}.tif"), image, ShiftedModel(exact, *error)))
    return Scene(tuple(views), CRS.from_epsg(32631))


def observe(sensors, xyz, noise_px=0.0, seed=0):
    """Every sensor's view of every point, as observations."""
    view = np.repeat(np.arange(len(sensors)), len(xyz))
    point = np.tile(np.arange(len(xyz)), len(sensors))
    seen = Observations(view, point, np.zeros((len(view), 2)))
    xy = project_points(sensors, seen, xyz)
    return Observations(view, point, xy + np.random.default_rng(seed).normal(0.0, 1.0, xy.shape) * noise_px)


def random_ground(n, seed=0):
    """Ground points over 200 m by 200 m, heights over 60 m."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-100, 100, (n, 2)), BASE_HEIGHT_M + rng.uniform(0, 60, n)])


def translation_effect(sensors):
    """Image effect (2 i, 3) px per m of a common translation of the ground."""
    columns = []
    at = np.array([[0.0, 0.0, BASE_HEIGHT_M]])
    for axis in np.eye(3):
        columns.append(np.concatenate([(s.image_from_ground(at + axis) - s.image_from_ground(at))[0] for s in sensors]))
    return np.column_stack(columns)


def without_translation(shift, sensors):
    """What remains of shifts (i, 2) px after a least-squares fit of one ground translation."""
    effect = translation_effect(sensors)
    flat = np.asarray(shift).ravel()
    return (flat - effect @ np.linalg.lstsq(effect, flat, rcond=None)[0]).reshape(-1, 2)
