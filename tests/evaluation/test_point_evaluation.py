"""Evaluation at points: errors, kinds of ground, the ASPRS figures, and what the table says."""

from __future__ import annotations

import json

import numpy as np
import pytest

from evaluation_rasters import NORTH, WEST, write
from point_files import cloud, csv
from point_scenes import PLANTED, ground_points, surface, table
from zlocus.core.errors import ConfigError, InputError
from zlocus.evaluation import point_evaluation
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.files import write_evaluation, write_point_evaluation
from zlocus.evaluation.point_evaluation import evaluate_at_points
from zlocus.evaluation.point_table import point_table
from zlocus.io.number_table import read_number_table
from zlocus.io.points.ground_points import PointOptions

# Heights of a level surface are exact.
EXACT_M = 1e-6
# Bilinear heights on cells of 0.5 m of the rolling ground.
INTERPOLATED_M = 0.005


@pytest.fixture
def level(tmp_path):
    """A surface of 100 m, 200 x 200 cells of 0.5 m, with a hole."""
    z = np.full((200, 200), 100.0, np.float32)
    z[:20, :20] = np.nan
    return write(tmp_path / "level.tif", z)


def check_points(folder, errors, name="check.csv", **columns):
    """Points on the level surface with these errors of the surface."""
    at = np.arange(len(errors))
    return csv(
        folder / name,
        {"x": WEST + 20 + at, "y": NORTH - 20 - at, "z": [round(100 - e, 6) for e in errors], **columns},
    )


def judged(dsm, points, options=None, **more):
    return evaluate_at_points(dsm, Comparison(points, **more), options or PointOptions())


def test_the_table_worked_by_hand(tmp_path, level):
    # The numbers of test_asprs.py, from files.
    path = check_points(
        tmp_path, [0.06, -0.06, 0.02, -0.02, 0.3, -0.1, 0.2], sigma=[0.02] * 4 + [0.02, 0.04, 0.04],
        land_cover=["road"] * 4 + ["forest"] * 3,
    )  # fmt: skip
    found = judged(level, path, threshold_m=0.25)
    assert (found.nva.n_compared, found.vva.n_compared) == (4, 3)
    assert found.nva.rmse_v == pytest.approx(0.0489898, abs=EXACT_M)
    assert found.vva.rmse_v == pytest.approx(0.2187846, abs=EXACT_M)
    text = point_table(found)
    assert "non-vegetated (NVA)      4     0.045     0.020     0.049     0.081" in text
    assert "vegetated (VVA)          3     0.216     0.035     0.219     0.360" in text
    assert "NVA: 4 points, fewer than the 30 that the standard asks for" in text
    assert "VVA: 3 points, fewer than the 30" in text
    assert "RMSE_H and CE90 are not known" in text
    classes = found.evaluation.class_statistics
    assert {name: statistics.n for name, statistics in classes.items()} == {"forest": 3, "road": 4}
    assert classes["forest"].within == pytest.approx(2 / 3)
    record = json.loads(json.dumps(found.as_dict()))
    assert record["asprs"]["nva"]["enough_points"] is False
    assert record["asprs"]["horizontal"] is None
    assert record["all"]["n"] == 7


def test_points_in_a_hole_are_missing_and_points_of_unknown_accuracy_are_said(tmp_path, level):
    path = csv(tmp_path / "p.csv", {"x": [WEST + 3, *(WEST + 20 + np.arange(40))], "y": [NORTH - 3] + [NORTH - 50] * 40,
                                    "z": [100.0] * 41})  # fmt: skip
    found = judged(level, path)
    assert (found.nva.n, found.nva.n_compared, found.nva.is_enough) == (41, 40, True)
    text = point_table(found)
    assert "fewer than" not in text
    assert "no kind of ground is known: all points count as non-vegetated" in text
    assert "the accuracy of the points is not known and not included in RMSE_V" in text
    given = judged(level, path, PointOptions(sigma_m=0.03))
    assert given.nva.rmse_v == pytest.approx(0.03, abs=EXACT_M)
    at_rim = csv(tmp_path / "r.csv", {"x": WEST + 10.1 + np.arange(3), "y": [NORTH - 0.1] * 3, "z": [100.0] * 3})
    shift = judged(level, at_rim).evaluation.found_shift
    assert shift.undetermined == "fewer than 3 points lie between four cells with heights"
    only_hole = csv(tmp_path / "q.csv", {"x": [WEST + 3], "y": [NORTH - 3], "z": [100.0]})
    with pytest.raises(InputError, match="has no height at any of the 1 points"):
        judged(level, only_hole)


def test_measured_places_give_horizontal_figures(tmp_path, level):
    errors = np.array([[0.03, 0.04], [-0.03, 0.04], [0.01, -0.02], [-0.01, -0.02]])
    at = np.arange(4)
    measured = {"measured_x": WEST + 20 + at + errors[:, 0], "measured_y": NORTH - 20 - at + errors[:, 1]}
    path = check_points(tmp_path, [0.0, 0.02, 0.0, -0.02], sigma_xy=[0.01] * 4, sigma_z=[0.01] * 4, **measured)
    found = judged(level, path)
    assert found.horizontal.rmse_h == pytest.approx(0.0412311, abs=EXACT_M)
    # Heights: mean square 2, points 1 cm2: 3; with 17 of the places 20 cm2.
    assert found.rmse_3d == pytest.approx(np.sqrt(20) / 100, abs=EXACT_M)
    text = point_table(found)
    assert "RMSE_H 0.041, CE90 0.062" in text
    assert "RMSE_3D 0.045" in text


def test_a_shift_is_found_and_removed_on_request(tmp_path):
    dsm, points = surface(tmp_path), table(tmp_path, 800)
    found = judged(dsm, points, align=True)
    shift = found.evaluation.shift
    assert (shift.east_m, shift.north_m, shift.up_m) == pytest.approx(PLANTED, abs=0.01)
    assert found.nva.rmse_v1 < INTERPOLATED_M < found.evaluation.absolute_accuracy.statistics.rmse
    assert "no longer check the surface independently" in point_table(found)
    plain = judged(dsm, points)
    assert plain.nva.rmse_v1 == pytest.approx(plain.evaluation.absolute_accuracy.statistics.rmse)


def test_laser_points_have_their_classes(tmp_path, level, monkeypatch):
    xyz = ground_points(600, ground=lambda x, _: np.full_like(x, 100.0))
    xyz = xyz[(xyz[:, 0] < WEST + 95) & (xyz[:, 1] > NORTH - 95)]
    classes = np.resize([2, 5, 6], len(xyz))
    path = cloud(tmp_path / "p.laz", xyz + np.where(classes == 5, -4.0, 0.0)[:, None] * (0, 0, 1), classes)
    found = judged(level, path)
    assert found.vva.rmse_v1 == pytest.approx(4.0, abs=0.002)
    assert found.nva.rmse_v1 == pytest.approx(0.0, abs=0.002)
    assert list(found.evaluation.class_statistics) == ["2 ground", "5 high vegetation", "6 building"]
    assert "laser points are no surveyed check points" in point_table(found)
    monkeypatch.setattr(point_evaluation, "MAX_JUDGED", 50)
    few = judged(level, path)
    assert (len(few.points), few.n_points) == (50, len(xyz))
    assert f"{len(xyz)} points lie in the surface; 50 of them, chosen at random, are judged" in point_table(few)


def test_files_of_points_take_the_place_of_those_of_a_raster(tmp_path, level):
    from zlocus.evaluation.evaluate import evaluate

    out = tmp_path / "out"
    write_evaluation(out, evaluate(level, Comparison(level, margin_m=0.0)))
    found = judged(level, check_points(tmp_path, [0.1, -0.2, 0.3], sigma=[0.02] * 3, note=list("abc")))
    assert write_point_evaluation(out, found) == ("evaluation.json", "points.csv", "histogram.png")
    assert sorted(path.name for path in out.iterdir()) == ["evaluation.json", "histogram.png", "points.csv"]
    numbers = ("x", "y", "z", "sigma", "surface_z", "error", "main_error")
    written = read_number_table(out / "points.csv", "table", numbers, ("class",))
    assert written.columns["error"] == pytest.approx([0.1, -0.2, 0.3], abs=1e-5)
    write_evaluation(out, evaluate(level, Comparison(level, margin_m=0.0)))
    assert not (out / "points.csv").exists()


def test_options_of_reference_surfaces_are_refused(tmp_path, level):
    points = check_points(tmp_path, [0.1])
    with pytest.raises(ConfigError, match=r"--classes .* is for reference surfaces"):
        judged(level, points, classes=level)
    with pytest.raises(ConfigError, match="--coregister nuth-kaab needs the slopes of a reference surface"):
        judged(level, points, coregister="nuth-kaab")
    with pytest.raises(ConfigError, match="The kind of ground 'heath' may be vegetated or not"):
        judged(level, check_points(tmp_path, [0.1], cover=["heath"]))
