"""Maps of a cloud are read back as ground points: of heights above a geoid, and of depths."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from rendered_scenes import CENTRE, UTM
from zlocus.core.grid import CellWindow
from zlocus.io.vertical import ELLIPSOIDAL
from zlocus.matching.quality import Quality
from zlocus.products.cloud_maps import ImageMap, pixels_per_metre
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.synthetic.cameras import SatelliteCamera

SHAPE, SAME_M = (20, 30), 1e-3
FRAME = FrameModel((462_000.0, 5_247_000.0, 600.0), rotation_from_angles(20.0, 5.0, 30.0), 300.0, (14.5, 9.5))
SATELLITE = SatelliteCamera((*CENTRE, 50.0), (14.5, 9.5), 0.5, 3.0, -20.0)


def image_map(folder, sensor, values, is_depth, datum=ELLIPSOIDAL):
    quality = np.zeros(SHAPE, np.uint16)
    quality[3, 4] = Quality.FILLED
    for name, band in (("map", values.astype(np.float32)), ("quality", quality)):
        profile = {"driver": "GTiff", "dtype": band.dtype, "count": 1, "height": SHAPE[0], "width": SHAPE[1]}
        with rasterio.open(folder / f"{name}.tif", "w", **profile, transform=rasterio.Affine.scale(2.0)) as file:
            file.write(band, 1)
    view = SimpleNamespace(sensor=sensor, image=SimpleNamespace(shape=SHAPE))
    return ImageMap(view, folder / "map.tif", folder / "quality.tif", is_depth, datum, UTM)


@pytest.mark.parametrize("is_depth", [False, True])
def test_points_lie_on_the_rays_of_their_pixels(tmp_path, is_depth):
    sensor = FRAME if is_depth else SATELLITE
    values = np.random.default_rng(2).uniform(80.0, 90.0, SHAPE)
    values[5, 6] = np.nan
    read = image_map(tmp_path, sensor, values, is_depth)
    ray_points = read.read(CellWindow(2, 3, 15, 20), 2)
    assert ray_points.points.shape == (8, 10, 3)
    row, col = np.mgrid[2:17:2, 3:23:2]
    known = np.isfinite(ray_points.points).all(axis=-1)
    points = ray_points.points[known]
    np.testing.assert_allclose(sensor.image_from_ground(points), np.column_stack([col[known], row[known]]), atol=1e-3)
    found = sensor.depth(points) if is_depth else points[:, 2]
    np.testing.assert_allclose(found, values[row[known], col[known]], atol=SAME_M)
    nearer = points + 5.0 * ray_points.towards[known]
    np.testing.assert_allclose(sensor.image_from_ground(nearer), sensor.image_from_ground(points), atol=1e-2)
    assert (read.nearness(nearer) > read.nearness(points)).all()
    # The empty pixel lies between those that are read, the filled one does not.
    whole = read.read(CellWindow(0, 0, *SHAPE)).points
    assert np.argwhere(np.isnan(whole[..., 0])).tolist() == [[3, 4], [5, 6]]


def test_depths_of_a_shifted_frame_camera_tell_which_point_is_nearer(tmp_path):
    read = image_map(tmp_path, ShiftedModel(FRAME, 0.5, -0.3), np.full(SHAPE, 80.0), True)
    points = FRAME.ground_at_depth(np.array([[3.0, 4.0], [20.0, 10.0]]), np.array([80.0, 90.0]))
    np.testing.assert_allclose(read.nearness(points), [-80.0, -90.0], atol=SAME_M)


def test_heights_above_a_geoid_become_ellipsoidal(tmp_path):
    datum = SimpleNamespace(geoid=True, undulation=lambda xy, crs: np.full(len(xy), 48.25))
    read = image_map(tmp_path, SATELLITE, np.full(SHAPE, 10.0), False, datum)
    points = read.read(CellWindow(0, 0, *SHAPE)).points
    assert np.nanmedian(points[..., 2]) == pytest.approx(58.25, abs=SAME_M)


def test_pixels_across_a_ray():
    view = SimpleNamespace(sensor=FRAME)
    points = FRAME.ground_at_depth(np.array([[14.5, 9.5]]), np.array([60.0]))
    assert pixels_per_metre(view, points)[0] == pytest.approx(300.0 / 60.0, rel=1e-3)
