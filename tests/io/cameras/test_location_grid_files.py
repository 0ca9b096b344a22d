"""Location grids read from files: conventions, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from pyproj import CRS

from location_grids import grid_of, written
from rpc_fixtures import satellite_rpc, write_image
from zlocus.core.errors import InputError
from zlocus.io.cameras.location_grid import LocationGridCamera
from zlocus.io.scene_file import open_scene
from zlocus.sensors.rpc import RpcModel

UTM31 = CRS.from_epsg(32631)
FIRST_NODE, STEP, SHAPE = (18000.0, 17000.0), (500.0, 400.0), (6, 7)
HEIGHTS = (-100.0, 200.0, 600.0, 1000.0)
FIRST_PIXEL = (19010, 17520)
SAME_PX = 1e-4
# The RPC of Ventoux follows the physical model to this, over both crops and 0 to 2000 m.
RPC_PX = 0.003
VENTOUX = {
    "img_01.tif": ("GRID_PHR1B_P_201308051042194_SEN_690908101-001.tif", [5000, 5000]),
    "img_02.tif": ("GRID_PHR1B_P_201308051042523_SEN_690908101-002.tif", [4915, 5162]),
}


@pytest.fixture(scope="module")
def location_grid():
    return grid_of(RpcModel(satellite_rpc(), UTM31), UTM31, HEIGHTS, FIRST_NODE, STEP, SHAPE)


@pytest.fixture
def image(tmp_path):
    return write_image(tmp_path / "a.tif", np.random.default_rng(1).integers(1, 1000, (60, 80), np.uint16))


def opened(camera: LocationGridCamera, image: Path):
    """The sensor model of an image."""
    return camera.read(image.parent, image).sensor(UTM31)


@pytest.mark.parametrize("prefix", ["", "LG_"])
@pytest.mark.parametrize("with_status", [False, True])
def test_pixels_count_from_the_centre_of_the_first_one_of_the_crop(location_grid, image, prefix, with_status):
    """Files say 0.5 for the centre of the first pixel of the whole image."""
    status = np.zeros((4, *SHAPE)) if with_status else None
    file = written(image.with_name("grid.tif"), location_grid, prefix, status)
    camera = LocationGridCamera(file=file.name, first_pixel=FIRST_PIXEL)
    source = camera.read(image.parent, image)
    assert source.files == (file,)
    xyz = source.sensor(UTM31).ground_from_image(np.array([[0.0, 0.0], [70.0, 50.0]]), np.array([0.0, 300.0]))
    there = RpcModel(satellite_rpc(), UTM31).image_from_ground(xyz)
    np.testing.assert_allclose(there, np.add(FIRST_PIXEL, [[0.0, 0.0], [70.0, 50.0]]), rtol=0, atol=SAME_PX)
    lon, lat = source.centre((60, 80))
    assert (lon, lat) == pytest.approx(location_grid.xy[1, 1, 2], abs=0.01)


def test_what_the_scene_file_says_goes_before_the_file(location_grid, image):
    file = written(image.with_name("grid.tif"), location_grid, leave_out=[f"ALTITUDE_B{band}" for band in range(8)])
    plain = {"file": file.name, "first_pixel": FIRST_PIXEL, "heights": HEIGHTS, "crs": "EPSG:4326"}
    same = opened(LocationGridCamera(**plain), image)
    moved = opened(LocationGridCamera(**plain, first_node=(18001.0, 17000.0), step=STEP, shift=(0.0, 0.5)), image)
    xyz = same.ground_from_image(np.array([[10.0, 20.0]]), np.array([100.0]))
    np.testing.assert_allclose(moved.image_from_ground(xyz), [[11.0, 20.5]], rtol=0, atol=SAME_PX)


def test_across_the_date_line(location_grid, image):
    lon, lat = np.moveaxis(location_grid.xy, -1, 0)
    there = np.stack([(lon - lon.mean() + 360.0) % 360.0 - 180.0, lat], axis=-1)
    moved = type(location_grid)(location_grid.heights, there, FIRST_NODE, STEP, location_grid.crs)
    assert np.ptp(there[..., 0]) > 350
    source = LocationGridCamera(file=written(image.with_name("grid.tif"), moved).name, first_pixel=FIRST_PIXEL).read(
        image.parent, image
    )
    assert abs(abs(source.centre((60, 80))[0]) - 180.0) < 0.1
    sensor = source.sensor(CRS.from_epsg(32660))
    xyz = sensor.ground_from_image(np.array([[10.0, 20.0]]), np.array([100.0]))
    np.testing.assert_allclose(sensor.image_from_ground(xyz), [[10.0, 20.0]], rtol=0, atol=SAME_PX)


def folded(xy):
    xy = xy.copy()
    xy[1, 3, [2, 3]] = xy[1, 3, [3, 2]]
    return xy


def lost(xy):
    xy = xy.copy()
    xy[2, 5, 6] = np.nan
    return xy


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (folded, "not in order beside row 2, column 2 at 200 m"),
        (lost, "has 1 node without a place on the ground, the first in row 5, column 6 at 600 m"),
        (lambda xy: xy[..., ::-1] + [0.0, 90.0], r"Latitudes in .* reach 95\.\d+ degrees"),
    ],
)
def test_wrong_nodes_are_refused(location_grid, image, change, told):
    wrong = type(location_grid)(location_grid.heights, change(location_grid.xy), FIRST_NODE, STEP, location_grid.crs)
    camera = LocationGridCamera(file=written(image.with_name("grid.tif"), wrong).name, first_pixel=FIRST_PIXEL)
    with pytest.raises(InputError, match=told):
        opened(camera, image)


@pytest.mark.parametrize(
    ("tags", "entry", "told"),
    [
        ({"leave_out": ["ALTITUDE_B4"]}, {}, "at which height its band 5 of 8 is: the tag ALTITUDE_B4 is missing"),
        ({"leave_out": ["REF"]}, {}, "in which CRS its coordinates are: the tag REF is missing"),
        ({"REF": "+proj=latlon +R=1737400.0 +no_defs"}, {}, "cannot be converted to places on the Earth"),
        ({"prefix": "LG_", "ALTITUDE_B1": "200"}, {}, "several bands of the same coordinate at 200 m"),
        ({"ALTITUDE_B1": "300"}, {}, "lacks one of the two coordinates at -100 m"),
        ({"ALTITUDE_B1": "high"}, {}, "A height in .* is not a number of metres"),
        ({}, {"heights": (0.0, 50.0, 100.0)}, "8 bands, which are not two .* for each of the 3 heights"),
        ({}, {"heights": (5.0, 5.0, 5.0, 5.0)}, "several bands of the same coordinate at 5 m"),
        ({}, {"first_pixel": (20930, 17520)}, r"holds columns -2930 to 70 and rows .* of .*a\.tif, which has 80"),
        ({"status": np.ones((4, *SHAPE))}, {}, "has 168 nodes without a place on the ground"),
        ({"prefix": "LG_", "FIELD_B3": "height"}, {}, "Band 4 of .* is called 'height'"),
    ],
)  # fmt: skip
def test_wrong_files_are_refused(location_grid, image, tags, entry, told):
    file = written(image.with_name("grid.tif"), location_grid, **tags)
    with pytest.raises(InputError, match=told):
        opened(LocationGridCamera(**({"file": file.name, "first_pixel": FIRST_PIXEL} | entry)), image)


def test_other_files_are_refused(location_grid, image):
    with pytest.raises(InputError, match=r"There is no location grid .*none\.tif"):
        opened(LocationGridCamera(file="none.tif"), image)
    with pytest.raises(InputError, match="at which height its band 1 of 1 is"):
        opened(LocationGridCamera(file=image.name), image)
    file = write_image(image.with_name("b.tif"), np.ones((4, 5, 6), np.float32))
    with pytest.raises(InputError, match=r"no transform\. Give `first_node` and `step`"):
        opened(LocationGridCamera(file=file.name, heights=(0.0, 9.0), crs="EPSG:4326"), image)


@pytest.mark.parametrize(
    ("entry", "told"),
    [({"step": [1.0, 0.0], "first_node": [0, 0]}, "step is the distance"), ({"step": [1, 1]}, "give both or neither")],
)
def test_wrong_entries_are_refused(tmp_path, entry, told):
    camera = {"kind": "location_grid", "file": "grid.tif"} | entry
    (tmp_path / "scene.yaml").write_text(
        yaml.safe_dump({"schema": 1, "views": [{"name": "a", "image": "a.tif", "camera": camera}]})
    )
    with pytest.raises(InputError, match=told):
        open_scene([tmp_path / "scene.yaml"])


def test_a_local_frame_has_no_place_for_it(location_grid, image, tmp_path):
    camera = {"kind": "location_grid", "file": "grid.tif", "first_pixel": list(FIRST_PIXEL)}
    written(tmp_path / "grid.tif", location_grid)
    views = [{"name": "a", "image": image.name, "camera": camera}]
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "frame": {"local": True}, "views": views}))
    with pytest.raises(InputError, match="knows its place on the Earth, but frame is local"):
        open_scene([tmp_path / "scene.yaml"], least=1)


def test_the_physical_model_of_ventoux_is_its_rpc(shared_data, tmp_path):
    folder = shared_data / "pleiades_pair_ventoux"
    views = []
    for name, (file, at) in VENTOUX.items():
        camera = {"kind": "location_grid", "file": str(folder / "physical_model_grids" / file), "first_pixel": at}
        views.append({"name": name, "image": str(folder / name), "camera": camera})
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "views": views}))
    by_grid, by_rpc = open_scene([tmp_path / "scene.yaml"]), open_scene([folder / name for name in VENTOUX])
    assert by_grid.crs == by_rpc.crs
    rng = np.random.default_rng(1)
    for one, other in zip(by_grid.views, by_rpc.views, strict=True):
        xy, z = rng.uniform(0, np.subtract(one.image.shape, 1)[::-1], (2000, 2)), rng.uniform(0, 2000, 2000)
        xyz = one.sensor.ground_from_image(xy, z)
        np.testing.assert_allclose(other.sensor.image_from_ground(xyz), xy, rtol=0, atol=RPC_PX)
