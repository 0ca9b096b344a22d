"""ties.gpkg and ranking.gpkg, read back with the library that others use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyogrio
import pyogrio.raw
import pytest
from pyproj import CRS
from shapely import from_wkb, get_coordinates

from rendered_scenes import CENTRE, GSD_M, HEIGHTS, LOOKS, UTM, camera
from zlocus.core.errors import OutputError
from zlocus.core.grid import CellWindow
from zlocus.core.scene import Scene, View
from zlocus.io.crs import local_frame
from zlocus.matching.pair_labels import NOT_RANKED, LabelledTies, PairLabels, TileLabels
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.tie_residuals import Residuals, ViewOrientation
from zlocus.orientation.triangulate import Observations, project_points
from zlocus.products import tie_layers as points
from zlocus.products.tie_layers import column_names, labels_in, write_ranking, write_ties

EXACT_M, EXACT_PX = 1e-6, 1e-6
PLANTED_PX = 0.7


def columns_of(path: Path, layer: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns and coordinates (n, 3) of a layer."""
    meta, _, wkb, fields = pyogrio.raw.read(path, layer=layer)
    return dict(zip(meta["fields"], fields, strict=True)), get_coordinates(from_wkb(wkb), include_z=True)


@pytest.fixture
def scene():
    views = tuple(View(name, Path(f"{name}.tif"), None, camera(name)) for name in LOOKS)
    return Scene(views, UTM)


def oriented(scene: Scene) -> Orientation:
    """Three ties: of three images, of two, and one whose rays did not meet."""
    xyz = np.array([[*CENTRE, 50.0], [CENTRE[0] + 5.0, CENTRE[1] - 3.0, 61.5], [np.nan] * 3])
    view, point = np.array([2, 0, 1, 0, 2, 0, 1]), np.array([0, 0, 0, 1, 1, 2, 2])
    seen = Observations(view, point, np.zeros((7, 2)))
    xy = project_points([v.sensor for v in scene.views], seen, xyz)
    xy[1, 0] += PLANTED_PX
    xy[2, 1] -= PLANTED_PX / 2
    seen = Observations(view, point, xy)
    nothing = Residuals.of(np.zeros((0, 2)))
    views = tuple(ViewOrientation(v.name, (0.0, 0.0), 3, nothing, nothing) for v in scene.views)
    sigma = np.array([0.1, np.nan, np.nan])
    return Orientation(views, (), xyz, sigma, seen, "shift", 6, HEIGHTS, len(xyz))


def test_ties_come_back(scene, tmp_path):
    orientation = oriented(scene)
    write_ties(tmp_path / "ties.gpkg", orientation, scene)
    assert [p.name for p in tmp_path.iterdir()] == ["ties.gpkg"]
    info = pyogrio.read_info(tmp_path / "ties.gpkg", layer="ties")
    assert (info["geometry_type"], info["features"]) == ("Point Z", 2)
    assert CRS.from_user_input(info["crs"]) == UTM
    columns, xyz = columns_of(tmp_path / "ties.gpkg", "ties")
    assert list(columns) == ["height_m", "sigma_z_m", "n_images", "images", "residual_px"]
    np.testing.assert_allclose(xyz, orientation.xyz[:2], atol=EXACT_M)
    np.testing.assert_allclose(columns["height_m"], [50.0, 61.5], atol=EXACT_M)
    np.testing.assert_array_equal(columns["sigma_z_m"], [0.1, np.nan])
    assert columns["n_images"].tolist() == [3, 2]
    assert columns["images"].tolist() == ["nadir,fore,aft", "nadir,aft"]
    np.testing.assert_allclose(columns["residual_px"], [PLANTED_PX, 0.0], atol=EXACT_PX)


def test_ranking_has_a_row_per_point_and_reference(tmp_path):
    names, xyz = ["a", "b", "A"], np.array([[CENTRE[0] + GSD_M, CENTRE[1], 51.0], [*CENTRE, 50.0]])
    all_three = np.array([[[-1, 1, 0], [1, -1, -1], [0, -1, -1]]], np.int8)
    ranked = [
        LabelledTies(xyz[:1], np.array([[[-1, 1], [1, -1]]], np.int8), np.array([2, 0])),
        LabelledTies(xyz[1:], all_three, np.arange(3)),
    ]
    write_ranking(tmp_path / "ranking.gpkg", ranked, names, UTM)
    assert [p.name for p in tmp_path.iterdir()] == ["ranking.gpkg"]
    info = pyogrio.read_info(tmp_path / "ranking.gpkg", layer="ranking")
    assert CRS.from_user_input(info["crs"]) == UTM
    columns, at = columns_of(tmp_path / "ranking.gpkg", "ranking")
    assert list(columns) == ["reference", "height_m", "n_good", "label_a", "label_b", "label_A_2"]
    assert columns["reference"].tolist() == ["a", "b", "A", "a", "A"]
    assert columns["n_good"].tolist() == [1, 1, 0, 1, 1]
    none = np.nan
    np.testing.assert_array_equal(columns["label_a"], [none, 1, 0, none, 1])
    np.testing.assert_array_equal(columns["label_b"], [1, none, -1, none, none])
    np.testing.assert_array_equal(columns["label_A_2"], [0, -1, none, 1, none])
    np.testing.assert_allclose(at, xyz[[1, 1, 1, 0, 0]], atol=EXACT_M)


def test_labels_of_very_many_images_are_one_text(tmp_path, monkeypatch):
    monkeypatch.setattr(points, "MAX_COLUMNS", 2)
    names, xyz = ["a", "b,c", "A=1"], np.array([[CENTRE[0] + GSD_M, CENTRE[1], 51.0], [*CENTRE, 50.0]])
    all_three = np.array([[[-1, 1, 0], [1, -1, NOT_RANKED], [0, -1, -1]]], np.int8)
    ranked = [
        LabelledTies(xyz[:1], np.array([[[-1, 1], [1, -1]]], np.int8), np.array([2, 0])),
        LabelledTies(xyz[1:], all_three, np.arange(3)),
    ]
    write_ranking(tmp_path / "ranking.gpkg", ranked, names, UTM)
    columns, at = columns_of(tmp_path / "ranking.gpkg", "ranking")
    assert list(columns) == ["reference", "height_m", "n_good", "labels"]
    assert columns["reference"].tolist() == ["a", "b,c", "A=1", "a", "A=1"]
    assert columns["n_good"].tolist() == [1, 1, 0, 1, 1]
    assert columns["labels"].tolist() == ["b c=1,A=1=0", "a=1", "a=0,b c=-1", "A=1=1", "a=1"]
    assert labels_in("b c=1,A=1=0") == {"b c": 1, "A=1": 0}
    np.testing.assert_allclose(at, xyz[[1, 1, 1, 0, 0]], atol=EXACT_M)
    write_ranking(tmp_path / "nothing.gpkg", [], names, UTM)
    assert pyogrio.read_info(tmp_path / "nothing.gpkg")["features"] == 0


def test_a_tile_keeps_the_points_of_its_own_cells():
    xy = np.array([[9.9, 20.0], [10.0, 20.0], [13.9, 22.9], [12.0, 23.0]])
    labels = np.arange(4, dtype=np.int8)[:, None, None] * np.ones((2, 2), np.int8)
    pair_labels = PairLabels(np.array([4, 0, 2, 1]), xy, labels, np.ones((2, 2)))
    ties = np.arange(15.0).reshape(5, 3)
    found = LabelledTies.of(TileLabels(pair_labels, [3, 5]), ties, CellWindow(20, 10, 3, 4))
    np.testing.assert_array_equal(found.xyz, ties[[0, 2]])
    assert found.labels[:, 0, 1].tolist() == [1, 2]
    assert found.views.tolist() == [3, 5]


def test_no_point_is_an_empty_layer(tmp_path):
    write_ranking(tmp_path / "ranking.gpkg", [], ["a", "b"], UTM)
    assert pyogrio.read_info(tmp_path / "ranking.gpkg")["features"] == 0


def test_a_local_frame_is_no_place_of_the_earth(tmp_path):
    ranked = LabelledTies(np.array([[1.0, 2.0, 3.0]]), np.zeros((1, 2, 2), np.int8), np.arange(2))
    write_ranking(tmp_path / "ranking.gpkg", [ranked], ["a", "b"], local_frame())
    _, xyz = columns_of(tmp_path / "ranking.gpkg", "ranking")
    np.testing.assert_allclose(xyz, [[1, 2, 3]] * 2)


def test_columns_differ_where_case_does_not_count():
    assert column_names(["x", "X", "x_2"]) == ["label_x", "label_X_2", "label_x_2_2"]


def test_a_folder_that_is_not_there_is_one_sentence(tmp_path):
    with pytest.raises(OutputError, match=r"ranking\.gpkg cannot be written: "):
        write_ranking(tmp_path / "none" / "ranking.gpkg", [], ["a", "b"], UTM)
