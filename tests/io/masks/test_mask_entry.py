"""The mask entry of a scene file, from its text to the pixels of a scene."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import yaml

from mask_files import UTM, box, geojson, write_raster
from rpc_fixtures import satellite_rpc, write_image
from zlocus.core.errors import InputError
from zlocus.core.scene import has_mask
from zlocus.io.images import open_image
from zlocus.io.input_files import files_of
from zlocus.io.scene_file import open_scene, open_usable_views, read_scene_file, write_scene_file
from zlocus.sensors.rpc import RpcModel

RPC = satellite_rpc()
SHAPE = (200, 300)
PIXELS = np.random.default_rng(2).integers(1, 4000, SHAPE).astype(np.uint16)
CLOUDS = np.random.default_rng(3).integers(0, 2, SHAPE).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    for name, column in (("a", 20000), ("b", 20100)):
        write_image(tmp_path / f"{name}.tif", PIXELS, RPC.moved(column=-column, row=-20000))
    write_raster(tmp_path / "clouds.tif", CLOUDS)
    return tmp_path


def scene_file(folder, mask, frame="EPSG:32631"):
    views = [{"name": name, "image": f"{name}.tif", "camera": {"kind": "rpc"}} for name in "ab"]
    views[0]["mask"] = mask
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump({"schema": 1, "frame": {"crs": frame}, "views": views}))
    return path


@pytest.mark.parametrize(
    "mask",
    ["clouds.tif", ["clouds.tif"], {"file": "clouds.tif", "values": [1]}, [{"file": "clouds.tif"}, "clouds.tif"]],
)
def test_all_ways_to_write_a_mask(folder, mask):
    first, second = open_scene([scene_file(folder, mask)]).views
    window = first.image.read(10, 20, 100, 150)
    np.testing.assert_array_equal(window.valid, CLOUDS[10:110, 20:170] == 0)
    np.testing.assert_array_equal(window.pixels, np.where(window.valid, PIXELS[10:110, 20:170], 0))
    assert (has_mask(first.image), has_mask(second.image)) == (True, False)
    assert second.image.read(0, 0, *SHAPE).valid.all()


def test_the_files_of_masks_are_inputs_and_images_are_sent_with_their_masks(folder):
    scene = open_scene([scene_file(folder, "clouds.tif")])
    assert folder / "clouds.tif" in files_of(scene)
    sent = pickle.loads(pickle.dumps(scene.views[0].image))
    np.testing.assert_array_equal(sent.masked(0, 0, *SHAPE), CLOUDS > 0)


def test_scene_files_with_masks_are_written_as_they_were_read(folder):
    entries = [
        {"file": "clouds.tif", "values": ["cloud", 3], "names": {"cloud": 1}, "band": 1},
        {"file": "m.gpkg", "coordinates": "ground", "height": 30.5},
        {"file": "x.gml", "kind": "gml", "outside": True},
    ]
    read = read_scene_file(scene_file(folder, entries))
    write_scene_file(folder / "again.yaml", read)
    assert read_scene_file(folder / "again.yaml") == read
    assert yaml.safe_load((folder / "again.yaml").read_text())["views"][0]["mask"] == entries


def test_no_mask_and_a_mask_of_nothing_give_the_same_pixels(folder):
    write_raster(folder / "clear.tif", np.zeros(SHAPE, np.uint8))
    masked = open_scene([scene_file(folder, "clear.tif")]).views[0].image
    plain = open_image(folder / "a.tif")
    for one, other in zip(
        vars(masked.read(0, 0, *SHAPE)).values(), vars(plain.read(0, 0, *SHAPE)).values(), strict=True
    ):
        assert one.tobytes() == other.tobytes()
    assert masked == plain
    assert replace(masked, mask=None, sources=()) == plain


def test_a_mask_of_everything_is_refused_in_a_sentence(folder):
    write_raster(folder / "all.tif", np.ones(SHAPE, np.uint8))
    path = scene_file(folder, "all.tif")
    message = r"a\.tif has no valid pixel outside its mask \(.*all\.tif\)\. Check the mask"
    with pytest.raises(InputError, match=message):
        open_scene([path])
    usable = open_usable_views([path])
    assert [view.name for view in usable.scene.views] == ["b"]
    (refused,) = usable.refused
    assert refused.name == "a"
    assert "outside its mask" in refused.reason


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (7, r"views\[0\]\.mask\[0\]: Input should be"),
        ([], r"views\[0\]\.mask: .*at least 1 item"),
        ({"path": "x"}, r"views\[0\]\.mask\[0\]: unknown key path; allowed here: file, kind"),
        ({"file": "clouds.tif", "values": []}, r"mask\[0\]\.values: Tuple should have at least 1"),
        ({"file": "clouds.tif", "values": [1.5]}, r"mask\[0\]\.values"),
        ({"file": "clouds.tif", "outside": False}, r"mask\[0\]\.outside: Input should be True"),
        ({"file": "m.gpkg", "coordinates": "corner"}, r"mask\[0\]\.coordinates: Input should be 'pixels'"),
        ({"file": "m.gpkg", "coordinates": "pixels", "height": 3}, "height is for polygons on the ground"),
        ({"file": "m.tif", "names": {1: "cloud", 2: "cloud"}}, "a name is there twice"),
    ],
)
def test_entries_that_are_wrong_are_refused_with_their_key(folder, mask, message):
    with pytest.raises(InputError, match=message):
        read_scene_file(scene_file(folder, mask))


def test_a_mask_that_cannot_be_read_names_its_view(folder):
    with pytest.raises(InputError, match=r"The mask of the view a: There is no mask .*none\.tif"):
        open_scene([scene_file(folder, "none.tif")])


def test_polygons_on_the_ground_are_projected_in_the_frame_of_the_scene(folder):
    """The same mask in any frame, and that of the camera's mean height."""
    middle = np.array([[SHAPE[1] / 2.0, 0.0]])
    (lon,), _ = RpcModel(RPC.moved(-20000, -20000), UTM).geographic_from_image(middle, np.array([RPC.height_off]))
    west_half = geojson(folder / "m.geojson", [box(5.0, 43.0, lon, 43.5)])
    found = [
        open_scene([scene_file(folder, west_half.name, frame)]).views[0].image.masked(0, 0, *SHAPE)
        for frame in ("EPSG:32631", "EPSG:2154")
    ]
    assert 0.3 < found[0].mean() < 0.7
    assert (found[0] != found[1]).mean() < 0.002
