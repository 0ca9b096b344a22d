"""`zlocus mosaic` on the command line: its answer, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest
from affine import Affine
from typer.testing import CliRunner

from overlapping_surfaces import CORNER, write_raster, write_run
from zlocus.cli.app import app

Z = np.full((60, 80), 10.0)


@pytest.fixture
def zl():
    return lambda *arguments: CliRunner().invoke(app, ["mosaic", *(str(a) for a in arguments)])


@pytest.fixture
def runs(tmp_path):
    moved = CORNER * Affine.translation(40, 0)
    first = write_run(tmp_path / "west", Z, np.full(Z.shape, 0.2))
    return first, write_run(tmp_path / "east", Z + 0.3, np.full(Z.shape, 0.2), moved)


def test_what_was_joined_is_said(zl, runs, tmp_path):
    done = zl(*runs, "-o", tmp_path / "out", "--quiet", "--json")
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert answer["cells"] == {"empty": 0, "one": 80 * 60, "blended": 40 * 60, "chosen": 0}
    assert answer["offsets"]["runs"][1]["offset_m"] == pytest.approx(0.3, abs=1e-4)
    assert [each.rsplit("/", 1)[1] for each in answer["files"]][:2] == ["dsm.tif", "sigma.tif"]
    text = zl(*runs, "-o", tmp_path / "text").stdout.splitlines()
    assert text[0].startswith("7200 cells of 2 surfaces: 4800 of one alone, 2400 blended, 0 where they contradict")
    assert text[1] == "offsets from west, removed: east +0.300 +-0.000 m"
    assert text[-1].endswith("written.")


def test_wrong_input_is_one_sentence(zl, runs, tmp_path):
    out = tmp_path / "out"
    raster = write_raster(tmp_path / "a.tif", Z.astype(np.float32))
    for arguments, said in (
        ((runs[0],), "One surface alone is no mosaic"),
        ((runs[0], runs[0]), "is given twice"),
        ((runs[0], tmp_path / "none"), "There is no surface"),
        ((runs[0], f"{raster}=wide"), "There is no raster of standard deviations wide"),
        ((*runs, "--feather", "-3"), "is not a size"),
        ((*runs, "--workers", "0"), "is too few"),
        ((*runs, "--geoid", raster), "is not needed"),
    ):
        done = zl(*arguments, "-o", out)
        assert done.exit_code == 2, done.output
        (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("zlocus: ")]
        assert said in sentence
    assert not out.exists()
