"""`zlocus export` on the command line: its answer, and what it refuses, one sentence each."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from rendered_scenes import HEIGHTS
from zlocus.cli.app import app


@pytest.fixture
def zl():
    return lambda *arguments: CliRunner().invoke(app, ["export", *(str(a) for a in arguments)])


def test_the_answer_says_the_errors(zl, images, tmp_path):
    paths, out = images("step").inputs, tmp_path / "out"
    asked = ("--crs", "EPSG:32632", "--heights", *HEIGHTS, "--no-points")
    done = zl("colmap", *paths, "-o", out, *asked)
    assert done.exit_code == 0, done.output
    assert "3 images, no tie points." in done.stdout
    assert "3 fitted cameras differ from their sensor models by 0.0" in done.stdout
    answer = json.loads(zl("nerf", *paths, "-o", out, *asked, "--overwrite", "--quiet", "--json").stdout)
    assert {view["camera"] for view in answer["images"].values()} == {"fitted"}
    assert max(view["max_px"] for view in answer["images"].values()) < 0.1
    assert "request" not in answer


def test_wrong_input_is_one_sentence(zl, images, tmp_path):
    paths, out = images("step").inputs, tmp_path / "out"
    for arguments, said in (
        (("obj", *paths), "obj is no format of an export. Choose from colmap, nerf, asp, rpc, mesh."),
        (("rpc", *paths, "--jump", "3"), "--jump says nothing to an export of the format rpc"),
        (("colmap", *paths, "--no-points"), "No area is known"),
        (("colmap", tmp_path / "none"), "There is no file"),
        (("mesh", tmp_path / "none.tif", *paths), "There is no surface"),
        (("nerf", *paths, "--crs", "EPSG:4326", "--no-points"), "EPSG:4326"),
    ):
        done = zl(*arguments, "-o", out)
        assert done.exit_code == 2, done.output
        (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("zlocus: ")]
        assert said in sentence
    assert not out.exists()
