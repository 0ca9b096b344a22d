"""`zlocus dsm --redo` on the command line."""

import json
import shutil

import pytest
import rasterio
from typer.testing import CliRunner

from zlocus.cli.app import app
from zlocus.io.run_record import read_record
from zlocus.pipeline.recorded_run import request_of


@pytest.fixture
def command(small_surface, tmp_path):
    """Words of the command of a finished surface, a copy of which is its output folder."""
    surface = shutil.copytree(small_surface, tmp_path / "surface")
    inputs = request_of(surface / "run.json", read_record(surface / "run.json")).inputs
    return ["dsm", *map(str, inputs), "-o", str(surface)]


@pytest.fixture
def area(small_surface, tmp_path):
    """The file of a square of 5 m in the middle of the surface."""
    with rasterio.open(small_surface / "dsm.tif") as file:
        x, y = file.xy(file.height // 2, file.width // 2, offset="ll")
    ring = [[x, y], [x + 5, y], [x + 5, y + 5], [x, y + 5], [x, y]]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    path = tmp_path / "area.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    return str(path)


@pytest.mark.parametrize("words", [["--level", "450"], ["--redo-margin", "2"], ["--break-lines", "lines.gpkg"]])
def test_options_of_a_part_need_a_part(command, words):
    done = CliRunner().invoke(app, [*command, *words])
    assert done.exit_code == 2
    assert "is given without --redo" in " ".join(done.stderr.split())


def test_a_part_is_not_planned(command, area):
    done = CliRunner().invoke(app, [*command, "--redo", area, "--dry-run"])
    assert done.exit_code == 2
    assert "--dry-run plans whole runs" in " ".join(done.stderr.split())


def test_a_part_is_redone_and_told_to_programs(command, area):
    done = CliRunner().invoke(app, [*command, "--redo", area, "--level", "450", "--json"])
    assert done.exit_code == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["cells_inside"] == answer["cells_changed"] == 100
    assert not answer["was_finished"]
    again = CliRunner().invoke(app, [*command, "--redo", area, "--level", "450"])
    assert "already redone" in " ".join(again.stdout.split())
