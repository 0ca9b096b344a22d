"""Control points and terrain heights: files and their faults, and the heights between cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bundle_scenes import views_of
from zlocus.core.errors import InputError
from zlocus.io.control_points import read_control, write_control
from zlocus.orientation.control import GroundControl, TerrainHeights

HEADER = "name,x,y,z,sigma,sigma_z,role,image,column,row"
GOOD = """# surveyed in June
name,x,y,z,sigma,sigma_z,role,image,column,row
gcp1,500000.25,5200000.5,431.125,0.02,0.04,control,view0,10.5,20.25
gcp1,500000.25,5200000.5,431.125,0.02,0.04,control,view1.tif,11.5,21.25
chk7,500100,5200100,440,0.02,0.04,check,view0,50,60
chk7,500100,5200100,440,0.02,0.04,check,view1,51,61
"""
PLAIN = "name;x;y;z;image;column;row\na;1;2;3;view0;4;5\n"


@pytest.fixture
def views():
    return views_of([None, None], (100, 80))


def written(folder: Path, text: str) -> Path:
    path = folder / "points.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_control_and_check_points_are_read(tmp_path, views):
    found = read_control(written(tmp_path, GOOD), views)
    assert found.names == ("chk7", "gcp1")
    assert found.is_check.tolist() == [True, False]
    assert found.xyz.tolist() == [[500100, 5200100, 440], [500000.25, 5200000.5, 431.125]]
    assert found.sigma_m.tolist() == [[0.02, 0.02, 0.04]] * 2
    assert found.observations.view.tolist() == [0, 1, 0, 1]
    assert found.observations.point.tolist() == [1, 1, 0, 0]
    assert found.observations.xy.tolist() == [[10.5, 20.25], [11.5, 21.25], [50, 60], [51, 61]]
    plain = read_control(written(tmp_path, PLAIN), views)
    assert np.isnan(plain.sigma_m).all()
    assert not plain.is_check.any()


def test_some_points_keep_their_image_points(tmp_path, views):
    found = read_control(written(tmp_path, GOOD), views)
    control = found.only(~found.is_check)
    assert control.names == ("gcp1",)
    assert control.observations.point.tolist() == [0, 0]
    assert control.observations.xy.tolist() == [[10.5, 20.25], [11.5, 21.25]]
    assert len(GroundControl.none().only(np.empty(0, bool))) == 0


ROW = "gcp1,1,2,3,0.1,0.1,control,view0,10,20"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "holds no rows"),
        (f"{HEADER}\n", "holds no rows"),
        ("name,x,y,z,image,column\na,1,2,3,view0,4\n", "has no column row"),
        ("name,x,y,z,picture,column,row\na,1,2,3,view0,4,5\n", "the column 'picture'"),
        (f"{HEADER}\n{ROW},9\n", "line 2: 11 values, but 10 columns"),
        (f"{HEADER}\n{ROW.replace('1,2,3', '1,two,3')}\n", "line 2: 'two' is not a finite number"),
        (f"{HEADER}\n{ROW.replace('1,2,3', '1,nan,3')}\n", "line 2: 'nan' is not a finite number"),
        (f"{HEADER}\n{ROW.replace('view0', 'view9')}\n", "line 2: the scene has no image 'view9'; it has view0, view1"),
        (f"{HEADER}\n{ROW.replace('10,20', '100,20')}\n", "line 2: column 100, row 20 lies outside view0"),
        (f"{HEADER}\n{ROW.replace('10,20', '10,-0.6')}\n", "lies outside view0, which has 100 columns and 80 rows"),
        (f"{HEADER}\n{ROW}\n{ROW}\n", "line 3: the point gcp1 is given in view0 on line 2 already"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('view0', 'view1').replace('1,2,3', '1,2,4')}\n", "line 3: the point gcp1 has"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('view0', 'view1').replace('control', 'check')}\n", "line 3: the point gcp1"),
        (f"{HEADER}\n{ROW.replace('control', 'tie')}\n", "line 2: the role 'tie' is neither control nor check"),
        (f"{HEADER}\n{ROW.replace('0.1,0.1', '0,0.1')}\n", "line 2: a sigma is a standard deviation"),
        (f"{HEADER}\n{ROW.replace('control', 'check')}\n", "line 2: the check point gcp1 is seen in one image only"),
    ],
)
def test_faults_of_the_file_are_said_with_their_line(tmp_path, views, text, says):
    with pytest.raises(InputError) as caught:
        read_control(written(tmp_path, text), views)
    assert says in str(caught.value)
    assert "points.csv" in str(caught.value)
    assert str(caught.value).endswith(".")


def test_terrain_between_its_cells():
    """A plane is itself, with its slope; beyond the middles of the outer cells there is nothing."""
    col, row = np.meshgrid(np.arange(6.0), np.arange(5.0))
    terrain = TerrainHeights(100.0 + 3.0 * col + 2.0 * row, west=50.0, north=900.0, cell_m=10.0)
    xy = np.array([[50.0, 900.0], [73.0, 881.0], [99.9, 860.1]])
    z, slope = terrain.at(xy)
    np.testing.assert_allclose(z, 100.0 + 0.3 * (xy[:, 0] - 50.0) + 0.2 * (900.0 - xy[:, 1]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(slope, [[0.3, -0.2]] * 3, rtol=0, atol=1e-12)
    outside = np.array([[49.9, 880.0], [100.1, 880.0], [70.0, 900.1], [70.0, 859.9], [np.nan, 880.0]])
    assert np.isnan(terrain.at(outside)[0]).all()
    holed = TerrainHeights(np.where((col == 2) & (row == 1), np.nan, 5.0), 50.0, 900.0, 10.0)
    assert np.isnan(holed.at(np.array([[65.0, 885.0]]))[0]).all()
    assert holed.at(np.array([[85.0, 885.0]]))[0] == pytest.approx(5.0)


def test_a_table_that_was_written_is_read_again(tmp_path, views):
    found = read_control(written(tmp_path, GOOD), views)
    write_control(tmp_path / "again.csv", found, views)
    again = read_control(tmp_path / "again.csv", views)
    assert again.names == found.names
    assert again.xyz == pytest.approx(found.xyz, abs=1e-4)
    assert again.sigma_m == pytest.approx(found.sigma_m)
    assert (again.is_check == found.is_check).all()
    assert again.observations.xy == pytest.approx(found.observations.xy)
