from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS, Transformer

from mask_files import UTM, box, geojson, mask_of, whole
from rpc_fixtures import satellite_rpc
from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.io.crs import local_frame
from zlocus.io.masks.ground_polygons import GroundView
from zlocus.sensors.rpc import RpcModel

SHAPE = (60, 90)
RPC = satellite_rpc().moved(column=-20000, row=-20000)
TO_DEGREES = Transformer.from_crs(UTM, CRS.from_epsg(4326), always_xy=True)


def on_ground(ring, z):
    """A ring of pixels in longitude and latitude, at a height."""
    xy = np.array(ring)
    ground = RpcModel(RPC, UTM).ground_from_image(xy, np.full(len(xy), z))
    return np.column_stack(TO_DEGREES.transform(ground[:, 0], ground[:, 1])).tolist()


@pytest.mark.parametrize("height", [None, 600.0])
def test_polygons_are_seen_at_the_mean_height_or_the_one_that_is_given(tmp_path, height):
    z = RPC.height_off if height is None else height
    path = geojson(tmp_path / "m.geojson", [on_ground(box(9.5, 4.5, 19.5, 24.5), z)])
    entry = {"file": str(path)} | ({} if height is None else {"height": height})
    expected = np.zeros(SHAPE, bool)
    expected[5:25, 10:20] = True
    np.testing.assert_array_equal(whole(mask_of(SHAPE, entry, rpc=RPC, mean_height=RPC.height_off)), expected)
    with pytest.warns(ZlocusWarning, match="because its polygons lie beside the image"):
        other = whole(mask_of(SHAPE, entry | {"height": z + 100.0}, rpc=RPC, mean_height=RPC.height_off))
    assert (other != expected).any()


def test_a_country_and_a_polygon_that_crosses_itself(tmp_path):
    """What lies beyond the image is cut off before it is projected."""
    whole_country = [(5.0, 43.0), (6.0, 43.0), (6.0, 43.6), (5.0, 43.6), (5.0, 43.0)]
    path = geojson(tmp_path / "m.geojson", [whole_country])
    assert whole(mask_of(SHAPE, {"file": str(path)}, rpc=RPC, mean_height=450.0)).all()
    bow = on_ground([(9.5, 4.5), (19.5, 24.5), (19.5, 4.5), (9.5, 24.5), (9.5, 4.5)], 450.0)
    found = whole(mask_of(SHAPE, {"file": str(geojson(tmp_path / "b.geojson", [bow]))}, rpc=RPC, mean_height=450.0))
    assert found[12:17, 10].all()
    assert found[12:17, 19].all()
    assert not found[:8, 14:16].any()


def test_elsewhere_nothing_is_masked_and_an_empty_file_is_a_clear_day(tmp_path):
    away = geojson(tmp_path / "m.geojson", [box(20.0, 50.0, 20.1, 50.1)])
    with pytest.warns(
        ZlocusWarning, match=r"m\.geojson covers no pixel of image\.tif, because its polygons lie beside"
    ):
        mask = mask_of(SHAPE, {"file": str(away)}, rpc=RPC, mean_height=450.0)
    assert not whole(mask).any()
    with pytest.warns(ZlocusWarning, match=r"m\.geojson covers every pixel of image\.tif"):
        mask_of(SHAPE, {"file": str(away), "outside": True}, rpc=RPC, mean_height=450.0)
    assert not whole(mask_of(SHAPE, {"file": str(geojson(tmp_path / "e.geojson"))}, rpc=RPC, mean_height=450.0)).any()


def test_a_camera_without_a_height_and_a_local_frame_are_refused(tmp_path):
    path = geojson(tmp_path / "m.geojson", [box(5.4, 43.2, 5.6, 43.3)])
    with pytest.raises(InputError, match=r"this camera does not say at which height\. Give `height`"):
        mask_of(SHAPE, {"file": str(path)}, rpc=RPC)
    local = GroundView(RpcModel(RPC, UTM), local_frame(), SHAPE, 450.0)
    with pytest.raises(InputError, match=r"and frame is local\. Give them with coordinates: pixels"):
        local.pixels_of(np.array([], object), UTM, None, path)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"values": [1]}, "values are for rasters and masks of vendors"),
        ({"band": 1}, "band and names are for rasters"),
    ],
)
def test_options_of_rasters_are_refused(tmp_path, entry, message):
    path = geojson(tmp_path / "m.geojson", [box(0, 0, 5, 5)])
    with pytest.raises(InputError, match=f"The mask of the view a: {message}"):
        mask_of(SHAPE, {"file": str(path)} | entry, rpc=RPC)


def test_lines_are_no_mask(tmp_path):
    path = geojson(tmp_path / "m.geojson", [box(0, 0, 5, 5)])
    path.write_text(path.read_text().replace('"Polygon"', '"MultiLineString"'))
    with pytest.raises(InputError, match="features, not polygons"):
        mask_of(SHAPE, {"file": str(path)}, rpc=RPC)


def test_polygons_in_metres_without_a_crs_are_refused(tmp_path):
    path = geojson(tmp_path / "utm.geojson", [box(461984.5, 5246991.0, 462014.5, 5247011.0)])
    with pytest.raises(InputError, match=r"The mask of the view a: .*utm\.geojson has .*no longitudes and latitudes"):
        mask_of(SHAPE, {"file": str(path)}, rpc=RPC, mean_height=450.0)
