"""Files of line scanners: their meaning, and one sentence for each fault."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer

from flights import FOCAL_MM, GROUND_M, INTERVAL_S, UTM, Flight, focal_line, scanner
from places import ROOT
from rpc_fixtures import write_image
from zlocus.core.errors import InputError, OutputError
from zlocus.core.scene import is_local
from zlocus.io.cameras.linescan import LineScanCamera
from zlocus.io.cameras.linescan_files import (
    navigation_rotations,
    read_calibration,
    read_times,
    read_trajectory,
    write_calibration,
    write_trajectory,
)
from zlocus.io.number_table import read_number_table, write_number_table
from zlocus.io.scene_file import open_scene
from zlocus.sensors.earth_frame import WGS84, WGS84_EARTH, EarthSpace, east_north_up
from zlocus.sensors.linescan import LineScanModel, RectifiedModel
from zlocus.sensors.trajectory import Trajectory

SAME_PX = 1e-6
ROWS, COLUMNS = 60, 80
NOTHING = np.zeros(3)
ANGLES = "time,x,y,z,omega,phi,kappa"


@dataclass(frozen=True)
class Folder:
    """A folder with two images, a focal plane of lines `nadir` and `forward`, and a trajectory in the frame."""

    path: Path

    def entry(self, **changes):
        entry = {
            "kind": "linescan", "calibration": "ads40.csv", "line": "forward", "focal_mm": FOCAL_MM,
            "first_column": 560, "trajectory": "path.csv", "rays": "frame",
            "times": {"start": 0.0, "interval": INTERVAL_S},
        } | changes  # fmt: skip
        return {key: value for key, value in entry.items() if value is not None}

    def scene(self, frame="EPSG:32632", **changes):
        nadir = self.entry(**({"line": "nadir"} | changes))
        views = [{"name": "f", "image": "a.tif", "camera": self.entry(**changes)}]
        views.append({"name": "n", "image": "b.tif", "camera": nadir})
        document = {"schema": 1, "frame": {"local": True} if frame == "local" else {"crs": frame}, "views": views}
        if frame is None:
            del document["frame"]
        (self.path / "scene.yaml").write_text(yaml.safe_dump(document))
        return open_scene([self.path / "scene.yaml"])


@pytest.fixture
def folder(tmp_path):
    image = np.arange(ROWS * COLUMNS, dtype=np.uint16).reshape(ROWS, COLUMNS)
    for name in "ab":
        write_image(tmp_path / f"{name}.tif", image)
    write_calibration(tmp_path / "ads40.csv", {"nadir": focal_line(2.0), "forward": focal_line(26.0)}, "two lines")
    write_trajectory(tmp_path / "path.csv", FLIGHT.trajectory(), "in the frame")
    return Folder(tmp_path)


FLIGHT = Flight(30.0, wobble_deg=0.2, wobble_m=0.5)


def assert_same_camera(model, expected, first_column=0):
    rng = np.random.default_rng(0)
    xy = rng.uniform((0, 0), (COLUMNS - 1, ROWS - 1), (200, 2))
    xyz = model.ground_from_image(xy, rng.uniform(400, 500, 200))
    np.testing.assert_allclose(expected.image_from_ground(xyz) - [first_column, 0], xy, rtol=0, atol=SAME_PX)


def test_a_scene_of_line_scanners(folder):
    scene = folder.scene()
    for view, along in zip(scene.views, (26.0, 2.0), strict=True):
        assert [path.name for path in view.camera_files] == ["ads40.csv", "path.csv"]
        assert_same_camera(view.sensor, scanner(FLIGHT, focal_line(along)), 560)
    with pytest.raises(InputError, match="does not place its centre on the Earth"):
        folder.scene(frame=None)
    assert is_local(folder.scene("local").crs)


def test_the_documented_scene_is_read(folder):
    page = (ROOT / "docs" / "reference" / "linescan.md").read_text(encoding="utf-8")
    example = page.split("```yaml\n")[1].split("```")[0]
    entry = yaml.safe_load(example)["camera"]
    camera = LineScanCamera.model_validate(entry)
    assert set(entry) == set(LineScanCamera.model_fields)
    assert camera.rectification is not None
    table = page.split("```csv\n")[1].split("```")[0]
    (folder.path / "table.csv").write_text(table)
    assert len(read_calibration(folder.path / "table.csv", "nadir", 62.5).xy_mm) == 12000


def earth_path(folder, names, place, turns, crs, **given):
    """A trajectory written by hand and read back, on the Earth."""
    n = 4001
    time = (np.arange(n) - 1500.0) * INTERVAL_S
    values = np.column_stack([time, place, np.broadcast_to(turns, (n, len(np.atleast_2d(turns)[0])))])
    write_number_table(folder.path / "earth.csv", dict(zip(names.split(","), values.T, strict=True)), "by hand")
    return read_trajectory(
        folder.path / "earth.csv", crs, "earth", **({"boresight_deg": NOTHING, "lever_arm": NOTHING} | given)
    )


def level_flight():
    """Longitude, latitude (degrees) of a flight to the north-east, its height, and east-north-up from the camera."""
    s = (np.arange(4001) - 1500.0) * 0.2
    lon, lat = 11.3 + s * 1e-5, 47.2 + s * 0.7e-5
    camera = navigation_rotations(*np.deg2rad([[1.0], [-2.0], [40.0]]))[0]
    return lon, lat, np.full(4001, 2440.0), camera


def test_angles_of_an_aircraft():
    """Columns are right, forward and up in east, north and up: nose up, right wing down, clockwise; and their order."""
    turns = np.deg2rad(np.array([[0.0, 0.0, 90.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [90.0, 30.0, 0.0]]))
    east, rolled, pitched, both = navigation_rotations(*turns.T)
    s, c = np.sin(np.deg2rad(10.0)), np.cos(np.deg2rad(10.0))
    np.testing.assert_allclose(east, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(rolled, [[c, 0, s], [0, 1, 0], [-s, 0, c]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(pitched, [[1, 0, 0], [0, c, -s], [0, s, c]], rtol=0, atol=1e-12)
    # The nose keeps its pitch whatever the roll, which comes last.
    np.testing.assert_allclose(both[:, 1], [0, np.sqrt(0.75), 0.5], rtol=0, atol=1e-12)


def test_four_ways_to_write_one_flight(folder):
    """Geographic with roll, pitch, heading; projected with angles against grid north; geocentric with angles and with
    quaternions: the same rays."""
    lon, lat, h, camera = level_flight()
    axes = east_north_up(np.deg2rad(lon), np.deg2rad(lat))
    centres = WGS84_EARTH.cartesian_from_ground(np.column_stack([lon, lat, h]))
    expected = Trajectory(np.arange(4001.0), centres, np.ascontiguousarray((axes @ camera).swapaxes(-1, -2)))
    x, y = Transformer.from_crs(WGS84, UTM, always_xy=True).transform(lon, lat)
    # Grid north lies (lon - 9) sin(lat) east of north, to the first order (3rd: 1e-6 of it).
    convergence = np.rad2deg(np.arctan(np.tan(np.deg2rad(lon - 9.0)) * np.sin(np.deg2rad(lat))))
    grid = np.column_stack([np.full(4001, 1.0), np.full(4001, -2.0), 40.0 - convergence])
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(axes @ camera).as_quat()
    angles = Rotation.from_matrix(camera).as_euler("XYZ", degrees=True)
    navigation, photo = "roll,pitch,heading", "omega,phi,kappa"
    ways = {
        "geographic": ("time,lon,lat,height," + navigation, np.column_stack([lon, lat, h]), [1.0, -2.0, 40.0], None),
        "projected": ("time,x,y,z," + navigation, np.column_stack([x, y, h]), grid, UTM),
        "geocentric": ("time,x,y,z," + photo, expected.centres, angles, CRS.from_epsg(4978)),
        "quaternions": ("time,x,y,z,qx,qy,qz,qw", expected.centres, quaternions, CRS.from_epsg(4978)),
    }
    for way, (names, place, turns, crs) in ways.items():
        found = earth_path(folder, names, place, turns, crs)
        np.testing.assert_allclose(found.centres, expected.centres, rtol=0, atol=1e-5, err_msg=way)
        # Map scale changes the direction of 1 m of grid north by less than this.
        np.testing.assert_allclose(found.rotations, expected.rotations, rtol=0, atol=2e-6, err_msg=way)


def test_lever_arm_and_boresight(folder):
    """Right, forward, up from the antenna to the camera; 90 degrees turn x forwards."""
    path = read_trajectory(
        folder.path / "path.csv", None, "frame", np.array([0.0, 0.0, 90.0]), np.array([1.0, 2.0, 3.0])
    )
    plain = read_trajectory(folder.path / "path.csv", None, "frame", NOTHING, NOTHING)
    arm = np.einsum("nji,j->ni", plain.rotations, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(path.centres, plain.centres + arm, rtol=0, atol=1e-8)
    np.testing.assert_allclose(path.rotations[:, 0], plain.rotations[:, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(path.rotations[:, 1], -plain.rotations[:, 0], rtol=0, atol=1e-12)


def test_sparse_calibration_is_filled_in(folder):
    x = np.arange(0, 1201, 100.0)
    file = folder.path / "sparse.csv"
    write_number_table(file, {"column": x, "x_mm": 0.0065 * x + 1e-9 * x**2, "y_mm": 1e-11 * x**3}, "every hundredth")
    line = read_calibration(file, None, FOCAL_MM)
    column = np.arange(1201)
    np.testing.assert_allclose(line.xy_mm[:, 0], 0.0065 * column + 1e-9 * column**2.0, rtol=0, atol=1e-10)
    np.testing.assert_allclose(line.xy_mm[:, 1], 1e-11 * column**3.0, rtol=0, atol=1e-10)


def test_times_from_a_table(folder):
    (folder.path / "times.txt").write_text("row time\n-10 -0.03\n20 0.06\n100 0.46\n")
    lines = read_times(folder.path / "times.txt", ROWS)
    at = lines.time(np.array([-0.5, 0.0, 20.0, 40.0, 59.0]))
    np.testing.assert_allclose(at, [-0.0015, 0.0, 0.06, 0.16, 0.255], rtol=0, atol=1e-12)
    model = folder.scene(times="times.txt").views[0].sensor
    assert model.lines.rows[-1] == ROWS - 1


def test_level_1(folder):
    raw = scanner(FLIGHT, focal_line(26.0))
    x, y = raw.ground_from_image(np.array([[600.0, 450.0]]), np.array([GROUND_M]))[0, :2].tolist()
    plane = {"height": GROUND_M, "transform": [0.2, 0.0, x, 0.0, -0.2, y], "rows": 900}
    model = folder.scene(rectification=plane, first_column=0).views[0].sensor
    assert isinstance(model, RectifiedModel)
    # GeoTIFF's transform is that of the outer corner: the centre of the first pixel lies half a pixel further.
    first = model.ground_from_image(np.zeros((1, 2)), np.array([GROUND_M]))
    np.testing.assert_allclose(first, [[x + 0.1, y - 0.1, GROUND_M]], rtol=0, atol=1e-6)
    earth = folder.scene(rectification=plane | {"crs": "EPSG:25832"}, first_column=0, rays="earth", crs="EPSG:32632")
    model = earth.views[0].sensor
    assert isinstance(model.raw_sensor.space, EarthSpace)
    first = model.ground_from_image(np.zeros((1, 2)), np.array([GROUND_M]))
    np.testing.assert_allclose(first, [[x + 0.1, y - 0.1, GROUND_M]], rtol=0, atol=1e-3)


def test_a_default_frame_and_other_frames(folder):
    scene = folder.scene(frame=None, rays="earth", crs="EPSG:32632")
    assert scene.crs == UTM
    assert isinstance(scene.views[0].sensor, LineScanModel)
    with pytest.raises(InputError, match=r"path\.csv knows its place on the Earth, but frame is local"):
        folder.scene("local", rays="earth", crs="EPSG:32632")
    with pytest.raises(InputError, match=r"rays: frame the trajectory .* in EPSG:32632 cannot be seen in EPSG:32633"):
        folder.scene("EPSG:32633", crs="EPSG:32632")
    folder.scene()
    with pytest.raises(InputError, match="in EPSG:32632 cannot be seen in EPSG:32633"):
        open_scene([folder.path / "scene.yaml"], CRS.from_epsg(32633))


def test_only_frame_cameras_are_turned(folder):
    folder.scene("local")
    document = yaml.safe_load((folder.path / "scene.yaml").read_text())
    document["frame"]["up"] = [0.0, -1.0, 0.0]
    (folder.path / "scene.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(InputError, match="up turns frame cameras only"):
        open_scene([folder.path / "scene.yaml"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"focal_mm": 0}, r"camera\.focal_mm: Input should be greater than 0"),
        ({"focal_mm": None}, r"camera\.focal_mm is missing"),
        ({"tilt": 3}, "unknown key tilt; allowed here: kind, calibration, line, focal_mm"),
        ({"line": "sideward"}, "asks for the line 'sideward'. Write line: with one of forward, nadir"),
        ({"line": None}, "names no line. Write line: with one of forward, nadir"),
        (
            {"first_column": 1121},
            "begins at column 1121 of the line .* would end at 1200, but columns go from 0 to 1199",
        ),
        ({"trajectory": "none.csv"}, r"There is no trajectory .*none\.csv"),
        ({"calibration": "."}, "is a folder"),
        ({"times": {"start": 0.0, "interval": 0.0}}, "interval is the time from row to row"),
        ({"times": {"start": 90.0, "interval": 0.1}}, r"from 90\.\d+ to 95\.\d+ s, but the trajectory"),
        ({"crs": "EPSG:1"}, "is no CRS; write it as EPSG:n"),
        ({"rays": "curved"}, "rays: Input should be 'earth' or 'frame'"),
        ({"rays": "earth"}, "has x, y, z. Name their crs"),
        ({"rays": "earth", "crs": "EPSG:4326"}, "which WGS 84 is not for"),
        ({"rays": "earth", "crs": "EPSG:32632+5773"}, "heights are ellipsoidal"),
        ({"rays": "earth", "crs": "EPSG:4978"}, "are not a place in WGS 84"),
        ({"lever_arm": [0, 0]}, r"lever_arm\[2\] is missing"),
        ({"boresight": [0, 0, float("inf")]}, r"boresight\[2\]: Input should be a finite number"),
        ({"rectification": {"height": 1, "transform": [1, 0, 0, 2, 0, 0], "rows": 9}}, "flattens the image to a line"),
    ],
)
def test_what_a_scene_must_not_hold(folder, changes, message):
    with pytest.raises(InputError, match=message) as caught:
        folder.scene(**changes)
    assert "\n" not in str(caught.value)


TRAJECTORY = [ANGLES, *(f"{t / 10},1,2,{t},0,0,0" for t in range(6))]
CALIBRATION = ["column;x_mm;y_mm", "0;-1;0", "1;0;0", "2;1;0"]
TIMES = ["row time", "0 1.5", "59 2.5"]
READERS = {
    "trajectory": (TRAJECTORY, lambda path: read_trajectory(path, None, "frame", NOTHING, NOTHING)),
    "calibration": (CALIBRATION, lambda path: read_calibration(path, None, 60.0)),
    "times": (TIMES, lambda path: read_times(path, ROWS)),
}


def changed(kind, line, text):
    lines = list(READERS[kind][0])
    lines[line] = text
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("kind", "content", "message"),
    [
        ("trajectory", "", "holds no rows"),
        ("trajectory", ANGLES, "holds no rows"),
        ("trajectory", changed("trajectory", 0, "time,x,y,z,omega,phi,phi"), "the column phi twice"),
        ("trajectory", changed("trajectory", 0, "time,x,y,z,omega,phi,speed"), "column 'speed' in its header. Allowed"),
        ("trajectory", changed("trajectory", 0, "time,x,y,z,omega,phi,roll"), "one of these only"),
        ("trajectory", changed("trajectory", 0, "time,lon,y,z,omega,phi,kappa"), "one of these only"),
        ("trajectory", "time,x,y,omega,phi,kappa\n1,2,3,4,5,6", "has no column z"),
        ("trajectory", "\n".join(TRAJECTORY[:4]), "has 3 rows. At least 4"),
        ("trajectory", changed("trajectory", 3, "0.1,1,2,3,0,0,0"), "line 4: time is 0.1 after 0.1, but must increase"),
        ("trajectory", changed("trajectory", 3, "0.2,1,2,3,0,0"), r"line 4: 6 values, but 7 columns"),
        ("trajectory", changed("trajectory", 3, "0.2,1,2,nan,0,0,0"), "line 4: 'nan' is not a finite number"),
        ("trajectory", changed("trajectory", 3, "0.2,1,2,1e999,0,0,0"), "line 4: '1e999' is not a finite number"),
        ("trajectory", changed("trajectory", 3, "0.2,1,2,1_0,0,0,0"), "line 4: '1_0' is not a finite number"),
        ("trajectory", changed("trajectory", 3, "0.2,1,2," + "7" * 90_000 + ",0,0,0"), "line 4: '7{40}...' is not a"),
        ("trajectory", changed("trajectory", 3, "0.2,1,2," + "7" * 10**7 + ",0,0,0"), "line 4: 10000014 letters are"),
        ("trajectory", "x" * 90_000, "holds no rows"),
        ("trajectory", "x" * 90_000 + "\n1", "column 'x{40}...' in its header"),
        (
            "calibration",
            changed("calibration", 1, "1;-1;0"),
            "columns are whole numbers from 0|column is 1.0 after 1.0",
        ),
        ("calibration", changed("calibration", 3, "2.5;1;0"), "columns are whole numbers from 0"),
        ("calibration", changed("calibration", 3, "9000000;1;0"), "column 9000000 is more than"),
        ("calibration", changed("calibration", 3, "2;-0.5;0"), "does not run along a line"),
        ("calibration", "column;x_mm;y_mm\n0;1;1", "holds one column only"),
        ("calibration", "column;x_mm;y_mm\n0;1;1\n1;1;1", "does not run along a line"),
        ("times", changed("times", 2, "58 2.5"), "goes from row 0 to 58, but the image has rows 0 to 59"),
        ("times", "row time\n0 1\n9 2\n70 1.5", "time is 1.5 after 2.0, but must increase, or decrease"),
    ],
)
def test_what_a_table_must_not_hold(tmp_path, kind, content, message):
    path = tmp_path / "table.txt"
    path.write_text(content + "\n")
    with pytest.raises(InputError, match=message) as caught:
        READERS[kind][1](path)
    assert "table.txt" in str(caught.value)
    assert len(str(caught.value)) < 600
    assert "\n" not in str(caught.value)


def test_quaternions_of_length_one(tmp_path):
    (tmp_path / "q.csv").write_text("time,x,y,z,qx,qy,qz,qw\n" + "".join(f"{t},1,2,3,0,0,1,0.5\n" for t in range(5)))
    with pytest.raises(InputError, match=r"q\.csv, line 2: the quaternion .* is not of length 1"):
        read_trajectory(tmp_path / "q.csv", None, "frame", NOTHING, NOTHING)


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_other_encodings(tmp_path, encoding):
    (tmp_path / "t.csv").write_bytes("\n".join(["# Höhe", *TRAJECTORY]).encode(encoding))
    with pytest.raises(InputError, match="is not text in UTF-8"):
        READERS["trajectory"][1](tmp_path / "t.csv")


@pytest.mark.parametrize("kind", READERS)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(data=st.data())
def test_damaged_files_give_one_sentence_or_the_whole_table(tmp_path, kind, data):
    """Bytes cut, put in, swapped: an `InputError` that names the file, or finite numbers in order; nothing else."""
    lines, read = READERS[kind]
    whole = "\n".join(lines).encode()
    at = data.draw(st.integers(0, len(whole)))
    until = data.draw(st.integers(at, min(at + 30, len(whole))))
    filler = data.draw(
        st.one_of(st.binary(max_size=12), st.text("0123456789.,; \n-+eEnaif#_", max_size=12).map(str.encode))
    )
    path = tmp_path / "damaged.csv"
    path.write_bytes(whole[:at] + filler + whole[until:])
    try:
        found = read(path)
    except InputError as error:
        said = str(error)
    else:
        said = None
    if said is not None:
        assert "damaged.csv" in said
        assert "\n" not in said
        return
    for values in vars(found).values():
        assert np.isfinite(values).all()
    if kind == "trajectory":
        assert (np.diff(found.times) > 0).all()


def test_what_is_written_reads_back_equal(tmp_path):
    rng = np.random.default_rng(0)
    columns = {"time": np.cumsum(rng.random(50)), "x": rng.normal(size=50) * 1e6}
    write_number_table(tmp_path / "t.csv", columns, "a comment", {"word": ["a", "b"] * 25})
    table = read_number_table(tmp_path / "t.csv", "table", columns, ("word",))
    for name, values in columns.items():
        np.testing.assert_array_equal(table.columns[name], values)
    assert table.labels == {"word": ("a", "b") * 25}
    with pytest.raises(OutputError, match="cannot be written"):
        write_number_table(tmp_path / "none" / "t.csv", columns, "")


def test_defaults_do_not_depend_on_the_order_of_imports():
    """Up to 2.11 pydantic lends the defaults of one model to another, in the order in which they are imported."""
    code = (
        "import zlocus.io.scene_file\n"
        "from zlocus.io.cameras.linescan import LineScanCamera\n"
        "print([n for n, f in LineScanCamera.model_fields.items() if f.is_required()])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert found.strip() == "['calibration', 'focal_mm', 'trajectory', 'times']"
