"""Frame cameras of a scene file: all keys, refused values, maps, and the up axis."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from pyproj import CRS

from places import ROOT
from rpc_fixtures import write_image
from zlocus.core.errors import ConfigError, InputError
from zlocus.io.cameras.frame_camera import FrameCamera
from zlocus.io.scene_file import open_scene, read_scene_file, write_scene_file
from zlocus.sensors.distortion import BrownDistortion, FisheyeDistortion
from zlocus.sensors.earth_frame import FRAME_SPACE, EarthSpace
from zlocus.sensors.frame import rotation_from_angles
from zlocus.sensors.frame_axes import rotation_to_z
from zlocus.sensors.rolling_shutter import RollingShutter

PIXELS = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60)
POSE = {"centre": [700_120.0, 4_790_230.0, 1450.0], "angles": [1.0, -2.0, 30.0]}
CAMERA = {"kind": "frame", "focal": 70.0, "principal_point": [30.0, 19.0], **POSE}
BROWN = {"kind": "brown", "k1": -0.2, "p2": 1e-3}
MOTION = {"readout_s": 0.03, "velocity_m_s": [8.0, -1.0, 0.5]}


def document(frame=None, **changes):
    camera = {key: value for key, value in (CAMERA | changes).items() if value is not None}
    views = [{"name": name, "image": f"{name}.tif", "camera": camera} for name in "ab"]
    return {"schema": 1, "frame": frame or {"crs": "EPSG:32631"}, "views": views}


def scene(folder, content, crs=None):
    for view in content["views"]:
        write_image(folder / view["image"], PIXELS)
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(content))
    return open_scene([path], crs)


def test_every_entry(tmp_path):
    fisheye = {"kind": "fisheye", "k1": 0.1, "k4": 0.01}
    sensor = scene(tmp_path, document(focal=[70.0, 77.0], skew=0.5, distortion=fisheye)).views[0].sensor
    assert (sensor.focal, sensor.aspect, sensor.skew) == (70.0, 1.1, 0.5)
    assert sensor.distortion == FisheyeDistortion(k1=0.1, k4=0.01)
    sensor = scene(tmp_path, document(distortion=BROWN)).views[0].sensor
    assert sensor.distortion == BrownDistortion(k1=-0.2, p2=1e-3)
    assert scene(tmp_path, document(distortion={"kind": "brown"})).views[0].sensor.distortion is None


def test_a_rolling_shutter_has_the_rows_of_the_image(tmp_path):
    sensor = scene(tmp_path, document(rolling_shutter=MOTION, earth="flat")).views[0].sensor
    assert sensor.rolling_shutter == RollingShutter(0.03, (8.0, -1.0, 0.5), 40)
    curved = scene(tmp_path, document(rolling_shutter=MOTION)).views[0].sensor
    assert np.linalg.norm(curved.rolling_shutter.velocity) == pytest.approx(np.linalg.norm([8.0, -1.0, 0.5]))


def test_written_file_reads_back_equal(tmp_path):
    given = document(distortion=BROWN, focal=[70.0, 71.0], earth="flat", rolling_shutter=MOTION)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(given))
    here = read_scene_file(tmp_path / "scene.yaml")
    write_scene_file(tmp_path / "again.yaml", here)
    assert read_scene_file(tmp_path / "again.yaml") == here
    camera = yaml.safe_load((tmp_path / "again.yaml").read_text())["views"][0]["camera"]
    expected = {"distortion": BROWN, "focal": [70.0, 71.0], "earth": "flat", "rolling_shutter": MOTION}
    assert camera == CAMERA | expected
    assert next(iter(camera)) == "kind"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"focal": [70.0, 0.0]}, r"focal\[1\]"),
        ({"focal": [70.0]}, r"focal\[1\] is missing"),
        ({"focal": "long"}, "focal"),
        ({"focal": True}, "focal"),
        ({"distortion": {"kind": "brown", "k7": 1.0}}, "unknown key k7; allowed here: kind, k1"),
        ({"distortion": {"kind": "fisheye", "p1": 1.0}}, "unknown key p1"),
        ({"distortion": {"kind": "division"}}, "distortion"),
        ({"distortion": {"kind": "brown", "k1": float("nan")}}, r"k1: Input should be a finite number"),
        ({"centre": [1e300, 0.0, 0.0]}, r"centre\[0\]"),
        ({"angles": None, "rotation": [[1e12, 0, 0], [0, 1, 0], [0, 0, 1]]}, "right angles"),
        ({"angles": None, "rotation": [[1e200, 0, 0], [0, 1, 0], [0, 0, 1]]}, "less than or equal to"),
        ({"earth": "hollow"}, "earth"),
        ({"crs": "EPSG:999999"}, "is no CRS"),
        ({"rolling_shutter": {"readout_s": 0.03}}, "velocity_m_s is missing"),
        ({"rolling_shutter": {"readout_s": 30.0, "velocity_m_s": [8.0, 0.0, 0.0]}}, "readout_s"),
        ({"rolling_shutter": {"readout_s": 0.03, "velocity_m_s": [1e9, 0.0, 0.0]}}, r"velocity_m_s\[0\]"),
    ],
)
def test_what_is_refused(tmp_path, changes, says):
    with pytest.raises(InputError, match=says) as caught:
        scene(tmp_path, document(**changes))
    assert "\n" not in str(caught.value)


def test_a_map_is_curved_unless_said_otherwise(tmp_path):
    curved, flat = (scene(tmp_path, document(**changes)).views[0].sensor for changes in ({}, {"earth": "flat"}))
    assert flat.space == FRAME_SPACE
    assert flat.centre == tuple(POSE["centre"])
    assert isinstance(curved.space, EarthSpace)
    assert np.linalg.norm(curved.centre) == pytest.approx(6.37e6, rel=1e-2)
    xyz = np.array([[700_000.0, 4_790_300.0, 400.0]])
    gap = np.linalg.norm(curved.image_from_ground(xyz) - flat.image_from_ground(xyz))
    assert 0.0 < gap < 0.1


def test_another_map_for_the_surface(tmp_path):
    xy, z = np.array([[10.0, 20.0]]), np.array([400.0])
    here = scene(tmp_path, document()).views[0].sensor
    there = scene(tmp_path, document(), CRS.from_epsg(2154)).views[0].sensor
    assert np.linalg.norm(here.ground_from_image(xy, z) - there.ground_from_image(xy, z)) > 1e4, "metres apart"
    np.testing.assert_allclose(there.image_from_ground(there.ground_from_image(xy, z)), xy, atol=1e-6)
    own = scene(tmp_path, document({"crs": "EPSG:2154"}, crs="EPSG:32631")).views[0].sensor
    assert own == there
    with pytest.raises(ConfigError, match="earth: flat, which holds in EPSG:32631 only"):
        scene(tmp_path, document(earth="flat"), CRS.from_epsg(2154))


def test_without_a_frame_the_map_is_found(tmp_path):
    content = document(crs="EPSG:2154", centre=[700_000.0, 6_600_000.0, 2000.0])
    del content["frame"]
    assert scene(tmp_path, content).crs == CRS.from_epsg(32631)
    content = document()
    del content["frame"]
    with pytest.raises(InputError, match="does not place its centre"):
        scene(tmp_path, content)


def test_a_centre_that_its_crs_cannot_express_is_refused(tmp_path):
    with pytest.raises(InputError, match="no place in EPSG:32631"):
        scene(tmp_path, document(centre=[7e8, 4_790_230.0, 1450.0]))


def test_kinds_that_do_not_fit_together(tmp_path):
    content = document()
    content["views"][1]["camera"] = CAMERA | {"earth": "flat"}
    with pytest.raises(InputError, match="some cameras have earth: flat and some not"):
        scene(tmp_path, content)
    for changes in ({"earth": "curved"}, {"crs": "EPSG:32631"}):
        with pytest.raises(InputError, match="frame is local, where a camera has no crs and no earth"):
            scene(tmp_path, document({"local": True}, **changes))


@pytest.mark.parametrize(
    ("up", "says"), [([0, 0, 0], "not 0"), ([1, 0], "is missing"), ([0, 0, float("inf")], "finite")]
)
def test_invalid_ups_are_refused(tmp_path, up, says):
    with pytest.raises(InputError, match=says):
        scene(tmp_path, document({"local": True, "up": up}))
    with pytest.raises(InputError, match="up is for local: true"):
        scene(tmp_path, document({"crs": "EPSG:32631", "up": [0, 0, 1]}))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (0, -1, 0), (1, 2, 3), (1e-9, 0, -1), (1e300, -1e300, 0)])
def test_the_smallest_turn_to_z(up):
    rotation = rotation_to_z(up)
    unit = np.array(up) / np.max(np.abs(up))
    unit /= np.linalg.norm(unit)
    np.testing.assert_allclose(rotation @ unit, [0.0, 0.0, 1.0], atol=1e-8)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-8)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    assert angle == pytest.approx(np.arccos(np.clip(unit[2], -1, 1)), abs=1e-6)


def test_up_turns_the_cameras(tmp_path):
    pose = {"centre": [1.0, -8.0, 2.0], "angles": [90.0, 0.0, 0.0]}
    plain, turned = (
        scene(tmp_path, document({"local": True, **up}, distortion=BROWN, **pose)).views[0].sensor
        for up in ({}, {"up": [0, -1, 0]})
    )
    xyz = np.array([[1.1, -1.0, 2.3], [0.0, 1.0, 1.0]])
    rotation = rotation_to_z((0, -1, 0))
    seen = plain.turned(np.diag([1.0, 1.0, 1.0])).image_from_ground(-xyz)
    np.testing.assert_allclose(turned.image_from_ground(-xyz @ rotation.T), seen, atol=1e-9)
    np.testing.assert_allclose(turned.centre, rotation @ np.array(pose["centre"]))


def test_the_entry_of_the_documents(tmp_path):

    page = (ROOT / "docs" / "reference" / "frame.md").read_text(encoding="utf-8")
    start = page.index("```\ncamera:") + 4
    entry = yaml.safe_load(page[start : page.index("```", start)])["camera"]
    # The rows of a rolling shutter are those of the image, which is not there.
    camera = FrameCamera.model_validate(entry).model_copy(update={"rolling_shutter": None})
    assert camera.read(tmp_path, tmp_path / "a.tif").sensor_in_own_crs.camera_from_ground == rotation_from_angles(
        0.3, -1.1, 92.0
    )
