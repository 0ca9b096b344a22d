"""Plans of --dry-run say what the command then does, and write nothing."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from zlocus.cli.app import app
from zlocus.core.errors import GeometryError
from zlocus.core.options import RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import CloudRequest, DsmRequest
from zlocus.pipeline.dry_run import plan_cloud, plan_dsm, plan_orient
from zlocus.pipeline.dsm import run_dsm

CONFIG = RunConfig()


@pytest.fixture(scope="module")
def pair(small_town):
    return tuple(small_town / name for name in ("img_n1.tif", "img_f1.tif"))


def test_the_plan_of_a_surface_is_that_of_its_run(pair, tmp_path):
    request = DsmRequest(pair, tmp_path / "out", resolution=0.5, report=False, products=())
    dry = plan_dsm(request, CONFIG, SilentProgress())
    assert list(tmp_path.iterdir()) == []
    run_dsm(request, CONFIG, SilentProgress())
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    # As JSON, where a tuple is a list.
    values = json.loads(json.dumps(dry.values))
    assert values["grid"] == record["grid"]
    assert values["heights"] == record["heights"]
    assert sorted(values["images"]) == ["img_f1", "img_n1"]
    assert values["plan"]["tiles"] == record["plan"]["tiles"]
    assert (values["plan"]["is_finished"], values["plan"]["finished_tiles"]) == (False, 0)
    rows, cols = record["grid"]["shape"]
    assert f"Surface: {rows} rows x {cols} columns of 0.5 m in EPSG:" in dry.text
    assert "Nothing was written." in dry.text
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    again = plan_dsm(request, CONFIG, SilentProgress())
    assert again.values["plan"]["is_finished"]
    assert "holds this very result already" in again.text
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == before


def test_the_plans_of_a_cloud_and_an_orientation_write_nothing(pair, tmp_path):
    cloud = plan_cloud(CloudRequest(pair, tmp_path / "cloud", references=("img_n1",)), CONFIG, SilentProgress())
    assert cloud.values["images"] == ["img_n1"]
    assert cloud.values["plan"]["tiles"] >= 1
    assert "Cloud: the pixels of 1 image (img_n1)." in cloud.text
    oriented = plan_orient(OrientRequest(pair, tmp_path / "oriented"), CONFIG, SilentProgress())
    assert oriented.values["model"] == "joint"
    assert oriented.values["control_points"] == 0
    assert "2 images of" in oriented.text
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_fails_as_the_run_would(pair, tmp_path):
    request = DsmRequest(pair, tmp_path / "out", bounds=(0.0, 0.0, 1000.0, 1000.0))
    with pytest.raises(GeometryError, match="lies outside the ground"):
        plan_dsm(request, CONFIG, SilentProgress())


@pytest.mark.parametrize("command", ["dsm", "cloud", "orient"])
def test_the_command_line_prints_the_plan(pair, tmp_path, command):
    words = [command, *map(str, pair), "-o", str(tmp_path / "out"), "--dry-run", "--quiet"]
    shown = CliRunner().invoke(app, words)
    assert shown.exit_code == 0, shown.stderr
    assert shown.stdout.endswith("Nothing was written.\n")
    record = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert (record["command"], record["exit_status"]) == (command, 0)
    assert record["images"]
    assert not (tmp_path / "out").exists()
