"""CSM states, compared with the formulas of usgscsm, and states that are refused."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from csm_states import COLUMNS, ROWS, state
from rpc_fixtures import write_image
from zlocus.core.errors import InputError
from zlocus.io.cameras.csm import MODEL, convert_csm, lagrange_interpolated, read_csm
from zlocus.io.scene_file import open_scene
from zlocus.sensors.earth_frame import MAJOR_M, MINOR_M, WGS84_EARTH, east_north_up

# Splines through samples of the same polynomials (measured: 1e-7).
SAME_PX = 1e-5
GROUND_M = 450.0


def usgscsm_sight(s, line, sample):
    """Centre and (unsigned) direction as UsgsAstroLsSensorModel::losToEcf has them, at CSM's line and sample."""
    piece = max(np.searchsorted(s["m_intTimeLines"], line, side="right") - 1, 0)
    time = s["m_intTimeStartTimes"][piece] + s["m_intTimes"][piece] * (line - s["m_intTimeLines"][piece] + 0.5)
    centre = lagrange_interpolated(
        np.reshape(s["m_positions"], (-1, 3)), s["m_t0Ephem"], s["m_dtEphem"], np.array([time]), 8
    )[0]
    q = lagrange_interpolated(
        np.reshape(s["m_quaternions"], (-1, 4)), s["m_t0Quat"], s["m_dtQuat"], np.array([time]), 8
    )[0]
    x, y, z, w = q / np.linalg.norm(q)
    body = np.array([
        [x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w],
    ])  # fmt: skip
    sample = sample * s["m_detectorSampleSumming"] + s["m_startingDetectorSample"]
    m11, m12, m21, m22 = *s["m_iTransL"][1:], *s["m_iTransS"][1:]
    t1 = s["m_startingDetectorLine"] - s["m_detectorLineOrigin"] - s["m_iTransL"][0]
    t2 = sample - s["m_detectorSampleOrigin"] - s["m_iTransS"][0]
    determinant = m11 * m22 - m12 * m21
    fx, fy = (m22 * t1 - m12 * t2) / determinant, (-m21 * t1 + m11 * t2) / determinant
    k = s["m_opticalDistCoeffs"]
    squared = fx * fx + fy * fy
    shrink = 1 - (k[0] + squared * (k[1] + squared * k[2]))
    look = np.array([-fx * shrink * s["m_zDirection"], -fy * shrink * s["m_zDirection"], -s["m_focalLength"]])
    return centre, body @ look


def ground_point(s, row, column, height):
    """Geocentric, where the sight of a pixel meets the ellipsoid whose axes are longer by the height."""
    centre, look = usgscsm_sight(s, row + 0.5, column + 0.5)
    a, b = MAJOR_M + height, MINOR_M + height
    k = (a / b) ** 2
    at = look[0] ** 2 + look[1] ** 2 + k * look[2] ** 2
    bt = 2 * (look[0] * centre[0] + look[1] * centre[1] + k * look[2] * centre[2])
    ct = centre[0] ** 2 + centre[1] ** 2 + k * centre[2] ** 2 - a * a
    root = np.sqrt(bt * bt - 4 * at * ct)
    scale = min((-bt - root) / (2 * at), (-bt + root) / (2 * at), key=abs)
    return centre + scale * look


def converted(folder, s):
    (folder / "state.json").write_text(f"{MODEL}\n{json.dumps(s)}")
    camera = convert_csm(folder / "state.json", folder, "cam")
    for name in "ab":
        write_image(folder / f"{name}.tif", np.arange(ROWS * COLUMNS, dtype=np.uint16).reshape(ROWS, COLUMNS) % 999)
    views = [{"name": name, "image": f"{name}.tif", "camera": camera.model_dump(exclude_none=True)} for name in "ab"]
    (folder / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "views": json.loads(json.dumps(views))}))
    return open_scene([folder / "scene.yaml"])


@pytest.mark.parametrize("z", [1, -1])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("pieces", [False, True])
def test_a_converted_state_sees_what_usgscsm_sees(tmp_path, z, sign, pieces):
    s = state(z, sign, pieces, (1e-4, 2e-5, -1e-6))
    scene = converted(tmp_path, s)
    model = scene.views[0].sensor
    for row, column in ((0.0, 0.0), (0.0, 299.0), (150.0, 40.0), (260.0, 130.5), (399.0, 299.0)):
        xyz = ground_point(s, row, column, GROUND_M)
        found = model.image_from_ground(model.space.ground_from_cartesian(xyz[None]))
        np.testing.assert_allclose(found, [[column, row]], rtol=0, atol=SAME_PX, err_msg=str((row, column)))


def test_the_converted_scene_lies_below_the_satellite(tmp_path):
    scene = converted(tmp_path, state())
    assert scene.crs.to_epsg() == 32632
    assert {path.name for path in scene.views[0].camera_files} == {"cam_focal_plane.csv", "cam_trajectory.csv"}


def test_lagrange_is_exact_for_polynomials_of_its_order():
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(8, 2))
    nodes = np.arange(12)[:, None] ** np.arange(8)
    at = rng.uniform(3.0, 8.0, 50)
    found = lagrange_interpolated(nodes @ coefficients, 0.0, 1.0, at, 8)
    np.testing.assert_allclose(found, (at[:, None] ** np.arange(8)) @ coefficients, rtol=1e-7)
    ends = lagrange_interpolated((nodes @ coefficients)[:, :1], 0.0, 1.0, np.array([0.25]), 8)
    np.testing.assert_allclose(ends, 0.75 * coefficients[0, 0] + 0.25 * coefficients[:, 0].sum())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"m_modelName": "USGS_ASTRO_FRAME_SENSOR_MODEL"}, "only USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL is read"),
        ({"m_majorAxis": 1737400.0}, "other bodies are not read"),
        ({"m_distortionType": 3, "m_opticalDistCoeffs": [0.1]}, "undistort the image first"),
        ({"m_currentParameterValue": [0.0, 1.0]}, "apply the adjustment"),
        ({"m_intTimes": [1.0, 2.0]}, "not of the same length"),
        ({"m_intTimes": [0.0]}, "line times of the state do not run on"),
        ({"m_positions": [1.0] * 7}, "not triples"),
        ({"m_quaternions": [0.0] * 8}, "one of length 0"),
        ({"m_quaternions": [1.0] * 4}, "m_quaternions: Tuple should have at least 8 items"),
        ({"m_iTransL": [0.0, 0.0, 0.0]}, "are parallel"),
        ({"m_zDirection": 2}, "m_zDirection"),
        ({"m_focalLength": float("nan")}, "it holds NaN, which is no number"),
        ({"m_intTimeStartTimes": [70.0]}, "known from -1.000000 to 1.000000 s only"),
        ({"m_detectorSampleSumming": 0.0}, "do not lie along a line"),
    ],
)
def test_states_that_are_refused(tmp_path, changes, message):
    path = tmp_path / "state.json"
    path.write_text(json.dumps(state(**changes)))
    with pytest.raises(InputError, match=message) as caught:
        read_csm(path)
    assert "state.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "words", "[" * 100_000, json.dumps({"m_modelName": MODEL})])
def test_files_that_are_no_state(tmp_path, text):
    (tmp_path / "state.json").write_text(text)
    with pytest.raises(InputError, match=r"state\.json"):
        read_csm(tmp_path / "state.json")


WHOLE = json.dumps(state())


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(st.integers(0, len(WHOLE)), st.integers(0, 300), st.binary(max_size=8))
def test_damaged_states_give_one_sentence_or_a_camera(tmp_path, at, cut, filler):
    (tmp_path / "s.json").write_bytes(WHOLE[:at].encode() + filler + WHOLE[at + cut :].encode())
    try:
        scanner = read_csm(tmp_path / "s.json")
    except InputError as error:
        said = str(error)
    else:
        said = "s.json"
        assert np.isfinite(scanner.trajectory.centres).all()
    assert "s.json" in said
    assert "\n" not in said


def test_the_test_orbit_is_level():
    s = state()
    centre, look = usgscsm_sight(s, 200.0, 150.0)
    lon, lat, height = WGS84_EARTH.geographic_from_cartesian(centre[None]).T
    assert height[0] > 4e5
    down = east_north_up(*np.deg2rad([lon, lat]))[0].T @ (look / np.linalg.norm(look))
    assert abs(down[2]) > 0.99


@pytest.mark.parametrize("step", [2.6475717016343294e-70, 1e-310])
def test_samples_of_no_length_give_numbers_without_a_warning(step):
    """A damaged state: its samples end long before the first line, which is said later."""
    values = np.arange(30.0).reshape(10, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = lagrange_interpolated(values, -1.0, step, np.array([6e-5]), 8)
    assert np.isfinite(found).all()
