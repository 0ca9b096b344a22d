"""Points of a reference on a surface: means over areas are those of the plain loop, wherever the areas lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from affine import Affine

from zlocus.evaluation.frame import Areas, Points
from zlocus.evaluation.heights import HeightRaster


def surface_and_points():
    """A surface with an empty border and holes on a turned grid, and areas around it, most of which do not touch it."""
    rng = np.random.default_rng(3)
    z = rng.normal(100, 10, (30, 40))
    z[:6] = z[:, 33:] = np.nan
    z[rng.random(z.shape) < 0.2] = np.nan
    surface = HeightRaster(
        Path("z.tif"), z, Affine.translation(100, 200) * Affine.rotation(20) * Affine.scale(2, -2), None
    )
    centre = np.array(surface.centre)
    xy = centre + rng.uniform(-150, 150, (400, 2))
    per_metre = np.broadcast_to(np.array([[1.1, 0.1], [-0.1, 0.9]]), (400, 2, 2))
    return surface, Points(xy, per_metre, Areas(np.array([[14.0, 2.0], [-1.0, -12.0]]), (5, 6)))


def plain_means(surface, points, look_up, shift):
    means = []
    for xy in points.moved(shift):
        z = look_up(surface, xy + points.areas.offsets(np.array([0])))
        known = z[np.isfinite(z)]
        means.append(known.mean() if 2 * len(known) >= len(z) else np.nan)
    return np.array(means)


@pytest.mark.parametrize("look_up", [HeightRaster.nearest, HeightRaster.bilinear, HeightRaster.between_cells])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (-7.0, 3.5)])
def test_means_over_areas_are_those_of_the_plain_loop(look_up, shift):
    surface, points = surface_and_points()
    expected = plain_means(surface, points, look_up, shift)
    assert 3 <= np.isfinite(expected).sum() < 100
    np.testing.assert_allclose(points.heights(surface, look_up, shift), expected, rtol=1e-12)


def test_only_areas_that_may_touch_a_height_are_looked_up():
    surface, points = surface_and_points()
    looked_up = []

    def counting(raster, xy):
        looked_up.append(len(xy))
        return raster.nearest(xy)

    points.heights(surface, counting)
    n = np.count_nonzero(points.reaching(surface))
    assert n < 0.3 * len(points.xy)
    assert sum(looked_up) == 30 * n
    far = points.reaching(surface, by_m=1000.0)
    assert far.all()
    empty = HeightRaster(Path("e.tif"), np.full((3, 3), np.nan), surface.transform, None)
    assert not points.reaching(empty, 1000.0).any()
