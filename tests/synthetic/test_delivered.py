"""Rendered images as a vendor ships them: the reader of deliveries finds pixels, cameras and acquisitions in them."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
import rasterio

from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.scene_file import open_scene
from zlocus.sensors.rpc import RpcModel
from zlocus.synthetic import delivered
from zlocus.synthetic.__main__ import main
from zlocus.synthetic.delivered import deliver
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.scenes import city_spec

SPEC = city_spec(6, size=64, views=city_spec(6).views[:2])
# Of cameras, whose tags hold fewer digits than the files of a vendor.
SAME_PX = 1e-6


@pytest.fixture(scope="module")
def order(tmp_path_factory):
    """A rendered scene; the delivery that took the place of its images; pixels and RPCs of the images."""
    rendered = render_scene(SPEC, tmp_path_factory.mktemp("ordered") / "order")
    images = {}
    for name, path in rendered.images.items():
        with rasterio.open(path) as file:
            images[name] = (file.read(1), read_rpc(path))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(delivered, "TILE_PX", 60)
        return rendered, deliver(SPEC, rendered), images


def test_the_delivery_has_the_pixels_and_cameras_of_the_images(order):
    rendered, folder, images = order
    assert not any(path.exists() for path in rendered.images.values())
    scene = open_scene([folder])
    assert len(list(folder.rglob("*_R2C1-*.TIF"))) == len(SPEC.views)
    for view, (pixels, rpc) in zip(scene.views, images.values(), strict=True):
        assert view.image.shape == pixels.shape
        np.testing.assert_array_equal(view.image.read(0, 0, *pixels.shape).pixels, pixels)
        ground = np.array([[SPEC.west_m + 10.0, SPEC.north_m - 20.0, 440.0]])
        xy = view.sensor.image_from_ground(ground)
        np.testing.assert_allclose(xy, RpcModel(rpc, scene.crs).image_from_ground(ground), rtol=0, atol=SAME_PX)


def test_the_delivery_tells_when_and_how_the_images_were_taken(order):
    _, folder, _ = order
    first, second = (view.acquisition for view in open_scene([folder]).views)
    assert first.time == datetime.datetime(2014, 8, 5, 10, 30, 12, tzinfo=datetime.UTC)
    assert second.time - first.time == datetime.timedelta(seconds=40)
    assert first.satellite == "WV03"
    sun = SPEC.views[0].sun
    assert (first.sun_direction.azimuth_deg, first.sun_direction.altitude_deg) == (sun.azimuth_deg, sun.elevation_deg)
    # Images that look ahead on the way north are taken from the south.
    assert abs(second.incidence_deg - np.hypot(20.0, 4.0)) < 3.0
    assert abs(second.view_azimuth_deg - 180.0) < 20.0


def test_the_command_makes_a_delivery(tmp_path):
    words = ["--kind", "city", "--size", "32", "--views", "2", "--delivery", "-o", str(tmp_path / "order")]
    assert main(words) == 0
    assert sorted(path.name for path in (tmp_path / "order").iterdir()) == [
        "delivery", "scene.json", "truth_class.tif", "truth_dsm.tif",
    ]  # fmt: skip
    assert len(open_scene([tmp_path / "order" / "delivery"]).views) == 2
