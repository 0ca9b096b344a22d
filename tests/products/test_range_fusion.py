"""Maps of exact cameras as one signed distance: planes have their place, and a roof without walls is closed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from zlocus.core.grid import CellWindow
from zlocus.products.cloud_maps import RayPoints
from zlocus.products.range_fusion import BLOCK, RangeMap, VoxelCube, close_below, fused
from zlocus.products.voxel_surface import zero_surface

CELL_M, BAND_M, ROOF_M = 0.5, 1.5, 8.0
SHAPE = (90, 100)
SAME_M = 1e-6


@dataclass(frozen=True)
class SlantedCamera:
    """A satellite over a flat Earth: rays lean to the east by so many metres per metre of height."""

    lean: float
    pixel_m: float = 0.4

    def image_from_ground(self, xyz):
        return np.column_stack([xyz[:, 0] - self.lean * xyz[:, 2], -xyz[:, 1]]) / self.pixel_m

    def ground_from_image(self, xy, z):
        return np.column_stack([xy[:, 0] * self.pixel_m + self.lean * z, -xy[:, 1] * self.pixel_m, z])


@dataclass(frozen=True)
class MadeMap:
    """The map of an image whose heights are known. heights : (r, c) m."""

    sensor: SlantedCamera
    heights: np.ndarray

    @property
    def view(self):
        return self

    def read(self, window, stride):
        part = self.heights[window.row : window.row + window.rows, window.col : window.col + window.cols]
        rows, cols = np.indices(part.shape)
        xy = np.column_stack([cols.ravel() + window.col, rows.ravel() + window.row]).astype(float)
        points = self.sensor.ground_from_image(xy, part.ravel()).reshape(*part.shape, 3)
        towards = np.array([self.sensor.lean, 0.0, 1.0]) / np.hypot(self.sensor.lean, 1.0)
        return RayPoints(points, np.where(np.isfinite(points), towards, np.nan))


def roof_map(lean, with_wall):
    """A roof in the west of x = 20 and the ground in the east of it; pixels of the wall have heights or none."""
    sensor = SlantedCamera(lean)
    x = np.arange(SHAPE[1]) * sensor.pixel_m
    on_roof, on_ground = x + lean * ROOF_M < 20.0, x > 20.0
    wall = np.where(with_wall, (20.0 - x) / lean, np.nan) if lean > 0 else np.full(SHAPE[1], np.nan)
    z = np.where(on_roof, ROOF_M, np.where(on_ground, 0.0, wall))
    return RangeMap.read(MadeMap(sensor, np.broadcast_to(z, SHAPE)), CellWindow(0, 0, *SHAPE), 1)


def cube():
    return VoxelCube(np.array([3, -9, -1]) * BLOCK, (4 * BLOCK, 2 * BLOCK, 4 * BLOCK), CELL_M)


def crossings(values, along, at):
    """Places (m) at which values cross 0 along an axis, on the line through the other nodes `at`."""
    box, line = cube(), np.moveaxis(values, along, 0)[(slice(None), *at)]
    with np.errstate(invalid="ignore"):
        found = np.flatnonzero(np.isfinite(line[:-1] * line[1:]) & ((line[:-1] < 0) != (line[1:] < 0)))
    return [(box.first[along] + k + line[k] / (line[k] - line[k + 1])) * CELL_M for k in found]


@pytest.mark.parametrize("lean", [0.0, 0.6, -0.3])
def test_distances_are_those_to_the_plane(lean):
    """Also where the nearest pixel shows another point of it."""
    sensor = SlantedCamera(lean)
    cols = np.indices(SHAPE)[1]
    # z = 0.2 x: a plane askew.
    z = 0.2 * cols * sensor.pixel_m / (1.0 - 0.2 * lean)
    one = RangeMap.read(MadeMap(sensor, z), CellWindow(0, 0, *SHAPE), 1)
    xyz = np.random.default_rng(1).uniform((10.0, -30.0, 0.0), (30.0, -5.0, 12.0), (500, 3))
    distance, cosine = one.signed_distances(xyz)
    normal = np.array([-0.2, 0.0, 1.0]) / np.hypot(0.2, 1.0)
    np.testing.assert_allclose(distance, xyz @ normal, atol=SAME_M)
    np.testing.assert_allclose(cosine, normal @ [lean, 0.0, 1.0] / np.hypot(lean, 1.0), atol=SAME_M)
    assert np.isnan(one.signed_distances(np.array([[1e4, 0.0, 0.0]]))[0]).all()


def test_a_wall_that_an_image_shows_is_where_it_is():
    values = fused([roof_map(0.7, True), roof_map(0.0, False)], cube(), BAND_M)
    for k in (12, 14, 16):  # heights of 2, 3 and 4 m
        (x,) = crossings(values, 0, (4, k))
        assert x == pytest.approx(20.0, abs=0.1 * CELL_M)
    (z,) = crossings(values, 2, (4, 4))
    assert z == pytest.approx(ROOF_M, abs=SAME_M)


def test_without_a_height_a_wall_is_closed():
    """And only then: no face is made where images see through."""
    box = cube()
    for maps in ([roof_map(0.7, False), roof_map(0.0, False)], [roof_map(0.0, False)]):
        values = fused(maps, box, BAND_M)
        assert not crossings(values, 0, (4, 14))
        close_below(values, maps, box, BAND_M)
        (x,) = crossings(values, 0, (4, 14))
        assert x == pytest.approx(20.0, abs=CELL_M)
        # One surface from roof to ground, without a lid below the roof.
        assert len(crossings(values, 2, (4, 4))) == 1
    eaves = [roof_map(0.7, False), roof_map(0.0, False), roof_map(-0.2, False)]
    values = fused(eaves, box, BAND_M)
    close_below(values, eaves, box, BAND_M)
    surface = zero_surface(values).without_dust()
    assert (surface.vertices[:, 2] + box.first[2]).min() * CELL_M > -CELL_M


def test_what_most_images_see_through_is_free():
    spike = np.zeros(SHAPE)
    spike[40:48, 40:48] = 5.0
    flat = [
        RangeMap.read(MadeMap(SlantedCamera(lean), np.zeros(SHAPE)), CellWindow(0, 0, *SHAPE), 1) for lean in (0.0, 0.2)
    ]
    wrong = RangeMap.read(MadeMap(SlantedCamera(0.1), spike), CellWindow(0, 0, *SHAPE), 1)
    surface = zero_surface(fused([*flat, wrong], cube(), BAND_M))
    assert (surface.vertices[:, 2] + cube().first[2]).max() * CELL_M < CELL_M


def test_a_row_of_pixels_alone_has_an_orientation():
    z = np.full(SHAPE, np.nan)
    z[30] = 3.0
    one = RangeMap.read(MadeMap(SlantedCamera(0.0), z), CellWindow(0, 0, *SHAPE), 1)
    np.testing.assert_allclose(one.normals[30, 5:-5], np.broadcast_to([0.0, 0.0, 1.0], (SHAPE[1] - 10, 3)), atol=SAME_M)
    z[30, 1::2] = np.nan
    one = RangeMap.read(MadeMap(SlantedCamera(0.0), z), CellWindow(0, 0, *SHAPE), 1)
    assert np.isnan(one.normals).all()
