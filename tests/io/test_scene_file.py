from __future__ import annotations

import datetime
import os

import numpy as np
import pytest
import rasterio
import yaml
from pyproj import CRS

from rpc_fixtures import dimap_rpc, satellite_rpc, write_image
from zlocus.core.errors import ConfigError, GeometryError, InputError, OutputError, ZlocusWarning
from zlocus.core.footprints import check_overlap, footprint, ground_sample_distance
from zlocus.io.cameras.camera_kinds import RpcCamera
from zlocus.io.scene_file import SceneFile, ViewEntry, open_scene, read_scene_file, write_scene_file
from zlocus.sensors.correction import ShiftedModel

RPC = satellite_rpc()
PIXELS = np.arange(300 * 400, dtype=np.uint16).reshape(300, 400)
Z = 300.0


def crop(folder, name: str, column: float = 20000, row: float = 20000):
    """An image that is the part of the full scene that starts at (column, row)."""
    folder.mkdir(exist_ok=True)
    return write_image(folder / f"{name}.tif", PIXELS, RPC.moved(column=-column, row=-row))


@pytest.fixture
def pair(tmp_path):
    return [crop(tmp_path, "a"), crop(tmp_path, "b", 20100)]


def document(**changes):
    views = [{"name": name, "image": f"{name}.tif", "camera": {"kind": "rpc"}} for name in "ab"]
    return {"schema": 1, "frame": {"crs": "EPSG:32631"}, "views": views} | changes


def write(folder, content):
    path = folder / "scene.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_scene_of_images_has_the_utm_zone_of_its_centre(pair):
    scene = open_scene(pair)
    assert scene.crs == CRS.from_epsg(32631)
    assert [view.name for view in scene.views] == ["a", "b"]
    assert [view.path for view in scene.views] == pair
    assert (scene.bounds, scene.heights) == (None, None)
    xyz = scene.views[0].sensor.ground_from_image(np.array([[200.0, 150.0]]), np.array([Z]))
    np.testing.assert_allclose(scene.views[1].sensor.image_from_ground(xyz), [[100, 150]], atol=1e-6)


def test_the_date_of_a_view_is_that_of_the_scene_file_else_that_of_its_image(tmp_path, pair):
    for path in pair:
        with rasterio.open(path, "r+") as file:
            file.update_tags(NITF_IDATIM="20141005160138")
    given = document()
    given["views"][1]["date"] = datetime.date(2016, 2, 3)
    dates = [view.date for view in open_scene([write(tmp_path, given)]).views]
    assert dates == [datetime.date(2014, 10, 5), datetime.date(2016, 2, 3)]
    assert [view.date for view in open_scene(pair).views] == [datetime.date(2014, 10, 5)] * 2


@pytest.mark.parametrize(("lon", "lat", "epsg"), [(5.5, -43.25, 32731), (179.99, 10.0, 32660), (-180.0, 10.0, 32601)])
def test_utm_zone_of_south_and_date_line(tmp_path, lon: float, lat: float, epsg: int):
    fields = RPC.moved(-20000, -20000)
    rpc = type(RPC)(**(vars_of(fields) | {"lon_off": lon, "lat_off": lat}))
    paths = [write_image(tmp_path / f"{name}.tif", PIXELS, rpc.moved(0, row)) for row, name in enumerate("ab")]
    assert open_scene(paths).crs == CRS.from_epsg(epsg)


def test_utm_zone_of_images_on_both_sides_of_the_date_line(tmp_path):
    paths = []
    for name, lon in (("a", 179.9), ("b", -179.98)):
        rpc = type(RPC)(**(vars_of(RPC.moved(-20000, -20000)) | {"lon_off": lon}))
        paths.append(write_image(tmp_path / f"{name}.tif", PIXELS, rpc))
    assert open_scene(paths).crs == open_scene(paths[::-1]).crs == CRS.from_epsg(32660)


def vars_of(rpc):
    return {name: getattr(rpc, name) for name in rpc.__dataclass_fields__}


def test_given_crs_is_used_without_its_vertical_part(pair):
    assert open_scene(pair, CRS.from_epsg(2154)).crs == CRS.from_epsg(2154)
    assert open_scene(pair, CRS.from_user_input("EPSG:32631+5773")).crs == CRS.from_epsg(32631)


@pytest.mark.parametrize(
    ("crs", "message"),
    [(4326, r"WGS 84\) is geographic.*EPSG:326nn"), (4978, "is not projected"), (2263, "US survey foot")],
)
def test_crs_that_cannot_be_a_grid(pair, crs: int, message: str):
    with pytest.raises(ConfigError, match=message):
        open_scene(pair, CRS.from_epsg(crs))


def test_names_of_equal_stems_tell_the_folder(tmp_path):
    paths = [crop(tmp_path / "x", "a"), crop(tmp_path / "y", "a", 20100), crop(tmp_path / "y", "b", 20200)]
    assert [view.name for view in open_scene(paths).views] == ["x/a", "y/a", "b"]
    (tmp_path / "z").mkdir()
    paths = [crop(tmp_path / "y", "a"), crop(tmp_path / "z" / "y", "a", 20100)]
    names = [view.name for view in open_scene(paths).views]
    assert names == [(path.with_suffix("")).resolve().as_posix() for path in paths]


def test_inputs_that_are_no_scene(tmp_path, pair):
    (tmp_path / "link.tif").symlink_to(pair[0])
    (tmp_path / "no_camera").mkdir()
    plain = write_image(tmp_path / "d.tif", PIXELS * 0, RPC)
    bare = write_image(tmp_path / "no_camera" / "c.tif", PIXELS)
    for inputs, message in (
        ([], "none was given"),
        (pair[:1], r"two images or more: only .*a\.tif was found"),
        ([*pair, pair[0]], r"a\.tif is given twice"),
        ([pair[0], tmp_path / "link.tif"], r"link\.tif is given twice"),
        ([pair[0], tmp_path / "none.tif"], r"There is no image .*none\.tif"),
        ([pair[0], bare], r"c\.tif has no camera"),
        ([pair[0], plain], r"d\.tif has the value 0 everywhere"),
        ([write(tmp_path, document()), pair[0]], r"scene\.yaml is a scene file and stands alone"),
        ([tmp_path / "none.yaml"], "There is no scene file"),
    ):
        with pytest.raises(InputError, match=message):
            open_scene(inputs)


def test_scene_file_with_everything(tmp_path, pair):
    (tmp_path / "RPC_other.XML").write_text(dimap_rpc(RPC.moved(column=-20000, row=-20000)))
    views = [
        {"name": "first", "image": "a.tif", "camera": {"kind": "rpc", "file": "RPC_other.XML", "shift": [1.5, -2.0]}},
        {"name": "second", "image": str(pair[1]), "camera": {"kind": "rpc"}},
    ]
    area = {"bounds": [700000, 4790000, 701000, 4791000]}
    path = write(tmp_path, document(views=views, area=area, heights=[100, 400], frame={"crs": "EPSG:2154"}))
    scene = open_scene([path])
    assert scene.crs == CRS.from_epsg(2154)
    assert scene.bounds == (700000, 4790000, 701000, 4791000)
    assert scene.heights == (100, 400)
    assert [view.name for view in scene.views] == ["first", "second"]
    assert isinstance(scene.views[0].sensor, ShiftedModel)
    xyz = scene.views[1].sensor.ground_from_image(np.array([[100.0, 150.0]]), np.array([Z]))
    np.testing.assert_allclose(scene.views[0].sensor.image_from_ground(xyz), [[201.5, 148.0]], atol=1e-6)
    with pytest.raises(ConfigError, match=r"area\.bounds in another CRS"):
        open_scene([path], CRS.from_epsg(32631))


def test_frame_is_optional_for_cameras_that_know_the_earth(tmp_path, pair):
    scene_file = document()
    del scene_file["frame"]
    assert open_scene([write(tmp_path, scene_file)]).crs == CRS.from_epsg(32631)
    assert open_scene([write(tmp_path, document())], CRS.from_epsg(2154)).crs == CRS.from_epsg(2154)


def with_view(**changes):
    return document(views=[document()["views"][0] | changes, document()["views"][1]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (document(schema=2), r"schema: Input should be 1 \(there: 2\)"),
        (document(colour="red"), "unknown key colour; allowed here: schema, frame, area, heights, views"),
        (document(frame={"crs": "EPSG:1", "z": 1}), "frame: unknown key z; allowed here: crs"),
        (document(frame={"crs": "EPSG:999999"}), r"frame\.crs 'EPSG:999999' is no CRS"),
        (document(area={"bounds": [1, 2, 3]}), r"area\.bounds\[3\] is missing"),
        (document(area={"bounds": [3, 2, 1, 4]}), "xmin < xmax"),
        (document(heights=[10, 10]), "zmin < zmax"),
        (document(heights=[0, float("nan")]), r"heights\[1\]: Input should be a finite number"),
        (document(views=3), "views: Input should be a valid tuple"),
        (document(views=[1]), r"views\[0\]"),
        (with_view(name=""), r"views\[0\]\.name: String should have at least 1 character"),
        (with_view(name="b"), "'b' is used twice"),
        (with_view(day=1), r"views\[0\]: unknown key day; allowed here: name, image, camera, date"),
        (with_view(camera={"kind": "magic"}), r"views\[0\]\.camera\.kind is 'magic'\. Allowed: rpc"),
        (with_view(camera={}), r"views\[0\]\.camera\.kind is None"),
        (with_view(camera="rpc"), r"views\[0\]\.camera"),
        (
            with_view(camera={"kind": "rpc", "sift": 1}),
            r"views\[0\]\.camera: unknown key sift; allowed here: kind, file",
        ),
        (with_view(camera={"kind": "rpc", "shift": [1]}), r"views\[0\]\.camera\.shift\[1\] is missing"),
        ("schema: [1", "cannot be read as YAML"),
        ("just text", r"scene\.yaml stops within line 1"),
        ("just text\n", "is not a scene file"),
        ({"schema": 1}, "the key views is missing"),
        ({"views": []}, "the key schema is missing"),
    ],
)
def test_what_a_scene_file_must_not_hold(tmp_path, pair, content, message: str):
    with pytest.raises(InputError, match=message) as caught:
        open_scene([write(tmp_path, content)])
    assert "scene.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_area_needs_a_frame(tmp_path, pair):
    content = document(area={"bounds": [0, 0, 1, 1]})
    del content["frame"]
    with pytest.raises(InputError, match="area needs frame"):
        open_scene([write(tmp_path, content)])


def test_written_file_reads_back_equal(tmp_path):
    views = tuple(ViewEntry(name=n, image=f"{n}.tif", camera=RpcCamera(shift=(0.1, -1 / 3))) for n in ("å", "b"))
    scene_file = SceneFile(schema=1, frame={"crs": "EPSG:32631"}, heights=(1.0, 2.5), views=views)
    path = tmp_path / "scene.yaml"
    write_scene_file(path, scene_file)
    assert read_scene_file(path) == scene_file
    assert os.listdir(tmp_path) == ["scene.yaml"]
    assert yaml.safe_load(path.read_text())["views"][0]["camera"] == {"kind": "rpc", "shift": [0.1, -1 / 3]}
    for unwritable in (tmp_path / "no" / "scene.yaml", path / "scene.yaml"):
        with pytest.raises(OutputError, match="cannot be written"):
            write_scene_file(unwritable, scene_file)


def test_footprint_and_ground_sample_distance(pair):
    view = open_scene(pair).views[0]
    outline = footprint(view, Z, per_side=4)
    assert outline.shape == (16, 2)
    xyz = np.column_stack([outline, np.full(16, Z)])
    xy = view.sensor.image_from_ground(xyz)
    np.testing.assert_allclose(
        xy[[0, 4, 8, 12]], [[-0.5, -0.5], [399.5, -0.5], [399.5, 299.5], [-0.5, 299.5]], atol=1e-6
    )
    np.testing.assert_allclose(xy[1], [99.5, -0.5], atol=1e-6)
    x, y = outline.T
    area = abs(np.sum(x * np.roll(y, 1) - y * np.roll(x, 1))) / 2
    assert ground_sample_distance(view, Z) == pytest.approx(np.sqrt(area / (300 * 400)), rel=1e-4)


def test_overlap(tmp_path, pair):
    far = crop(tmp_path, "far", 25000)
    check_overlap(open_scene(pair), Z)
    with pytest.raises(GeometryError, match=r"No two images.*at 300 m \(EPSG:32631\): a E \d+ to \d+ m.*far E"):
        check_overlap(open_scene([pair[0], far]), Z)
    with pytest.warns(ZlocusWarning, match=r"far \(.*far\.tif\) overlaps no other image"):
        check_overlap(open_scene([*pair, far]), [0.0, Z])


def test_overlap_at_any_of_the_heights(shared_data):
    """The Ventoux strip is seen by both images near the ground (510 m), not at the RPC's height offset (1075 m)."""
    scene = open_scene(sorted((shared_data / "pleiades_pair_ventoux").glob("img*.tif")))
    with pytest.raises(GeometryError):
        check_overlap(scene, 1075.0)
    check_overlap(scene, [1075.0, 510.0])
