"""`zlocus align` and `zlocus evaluate` with points, as commands."""

from __future__ import annotations

import json
import re

import pytest
from typer.testing import CliRunner

from point_scenes import surface, table
from zlocus.cli.app import app


@pytest.fixture
def zl():
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def sentence_of(done):
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("zlocus: ")]
    return sentence


def test_align_says_what_it_removed(zl, tmp_path):
    dsm, points, out = surface(tmp_path), table(tmp_path), tmp_path / "out"
    done = zl("align", dsm, points, "-o", out)
    assert done.exit_code == 0, done.output
    assert "the surface lies +1.23" in done.stdout
    assert done.stdout.splitlines()[-1] == f"{out}: dsm.tif, run.json written."
    again = zl("align", dsm, points, "-o", out, "--overwrite", "--json", "--height-only")
    record = json.loads(again.stdout)["alignment"]
    assert record["offset_m"]["east"] is None
    assert record["horizontal_undetermined"] == "it was not asked for"


def test_evaluate_takes_points(zl, tmp_path):
    dsm, points, out = surface(tmp_path), table(tmp_path), tmp_path / "judged"
    done = zl("evaluate", dsm, points, "--points-sigma", 0.02, "-o", out)
    assert done.exit_code == 0, done.output
    assert "non-vegetated (NVA)   1500" in done.stdout
    assert f"{out}: evaluation.json, points.csv, histogram.png written." in done.stdout
    record = json.loads((out / "evaluation.json").read_text())
    assert record["asprs"]["nva"]["rmse_v2"] == pytest.approx(0.02)
    assert zl("evaluate", dsm, points, "-o", out).exit_code == 2


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("evaluate", "D", "D", "--returns", "last"), "--returns is about points, and .* is a raster"),
        (("evaluate", "D", "D", "--vegetated", "none"), "--vegetated is about points"),
        (("evaluate", "D", "D", "P"), "2 references are given, and .*dsm.tif is a raster"),
        (("evaluate", "D", "P", "P"), "2 references are given, and .*points.csv is a table"),
        (("align", "D", "P", "-o", "out", "--columns", "x"), "--columns x is not understood"),
        (("align", "D", "P", "-o", "out", "--laser-classes", "two"), "--laser-classes two is no list of numbers"),
        (("align", "D", "D", "-o", "out", "--points-sigma", 1), "--points-sigma is about points"),
    ],
)
def test_options_that_do_not_fit_are_refused(zl, tmp_path, monkeypatch, options, sentence):
    monkeypatch.chdir(tmp_path)
    files = {"D": surface(tmp_path), "P": table(tmp_path, 5)}
    done = zl(*(files.get(word, word) for word in options))
    assert done.exit_code == 2
    assert re.search(sentence, sentence_of(done))
    assert not (tmp_path / "out").exists()
