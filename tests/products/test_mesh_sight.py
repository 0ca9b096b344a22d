"""Sight of points on a surface, against a wall that stands before them."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine

from rendered_scenes import CENTRE
from zlocus.products.mesh_sight import SurfaceWindow, is_seen
from zlocus.synthetic.cameras import SatelliteCamera

CELL_M = 0.5


def camera(across):
    """A satellite in the east for positive angles, the flight going north."""
    return SatelliteCamera((*CENTRE, 0.0), (100.0, 100.0), 0.5, 0.0, -across)


def window(z):
    transform = Affine(CELL_M, 0.0, CENTRE[0] - 20.0, 0.0, -CELL_M, CENTRE[1] + 10.0)
    return SurfaceWindow(z, 3, 5, transform * Affine.translation(5, 3))


@pytest.mark.parametrize("angle", [20.0, 35.0, -35.0])
def test_ground_behind_a_wall_is_occluded_as_far_as_its_shadow(angle):
    z = np.zeros((40, 80))
    z[:, 40:44] = 12.0
    cols = np.arange(0, 70)
    points = np.stack([cols + 0.5, np.full(70, 15.5), np.zeros(70)], axis=-1)[:, None]
    seen = is_seen(camera(angle), points, None, window(z))
    # In columns of the window, of which the tile begins at the fifth.
    col = cols + 5
    reach = np.tan(np.deg2rad(abs(angle))) * 12.0 / CELL_M
    behind = (col < 40) & (col > 40 - reach + 1.5) if angle > 0 else (col > 43) & (col < 43 + reach - 1.5)
    clear = (col < 40 - reach - 1.5) | (col > 44) if angle > 0 else (col > 44 + reach + 1.5) | (col < 39)
    on_wall = (col >= 39) & (col <= 44)
    assert not seen[behind & ~on_wall].any()
    assert seen[clear & ~on_wall].all()
    assert behind.sum() > 4


def test_walls_are_seen_from_outside_only():
    z = np.zeros((40, 80))
    z[:, 40:44] = 12.0
    east = np.array([[[39.0, 15.5, 3.0], [39.0, 15.5, 9.0]]])
    west = east - [4.0, 0.0, 0.0]
    for angle, sees_east in ((30.0, True), (-30.0, False)):
        assert is_seen(camera(angle), east, np.array([[1.0, 0.0]]), window(z)).tolist() == [sees_east]
        assert is_seen(camera(angle), west, np.array([[-1.0, 0.0]]), window(z)).tolist() == [not sees_east]
    # From straight above, no wall is seen well enough.
    assert not is_seen(camera(2.0), east, np.array([[1.0, 0.0]]), window(z)).any()
    z[:, 50:54] = 30.0
    assert not is_seen(camera(30.0), east, np.array([[1.0, 0.0]]), window(z)).any()


def test_nothing_is_seen_where_a_sensor_maps_nothing():
    class Blind(SatelliteCamera):
        def image_from_ground(self, xyz):
            return np.full((len(xyz), 2), np.nan)

    blind = Blind((*CENTRE, 0.0), (100.0, 100.0), 0.5, 0.0, 0.0)
    assert not is_seen(blind, np.array([[[5.0, 5.0, 0.0]]]), None, window(np.zeros((40, 80)))).any()
    assert is_seen(blind, np.zeros((0, 1, 3)), None, window(np.zeros((4, 8)))).shape == (0,)
