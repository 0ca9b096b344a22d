"""`zlocus change` on the command line: its table, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pyogrio.raw
import pytest
import shapely
from typer.testing import CliRunner

from overlapping_surfaces import CORNER, CRS, write_run
from zlocus.cli.app import app

SHAPE = (60, 80)


@pytest.fixture
def zl():
    return lambda *arguments: CliRunner().invoke(app, ["change", *(str(a) for a in arguments)])


@pytest.fixture
def dates(tmp_path):
    rng = np.random.default_rng(0)
    first, second = 10.0 + 0.1 * rng.normal(size=(2, *SHAPE))
    second[20:30, 30:40] += 2.0
    sigma = np.full(SHAPE, 0.1)
    polygon = shapely.box(*(CORNER * (30, 30)), *(CORNER * (40, 20)))
    pyogrio.raw.write(
        tmp_path / "pit.gpkg", shapely.to_wkb(np.array([polygon])), [np.array(["north"], object)], ["pit"],
        geometry_type="Polygon", crs=CRS, driver="GPKG",
    )  # fmt: skip
    return write_run(tmp_path / "a", first, sigma), write_run(tmp_path / "b", second, sigma), tmp_path / "pit.gpkg"


def test_the_table(zl, dates, tmp_path):
    first, second, area = dates
    done = zl(first, second, "-o", tmp_path / "out", "--area", area, "--name", "pit", "--quiet")
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[:2] == [f"A: {first}", f"B: {second}"]
    name, volume, sigma, mean, known = lines[-2].split()
    assert (name, known) == ("north", "100.0")
    assert float(volume) == pytest.approx(50.0, abs=1.5)
    assert 0.1 < float(sigma) < 1.0
    assert float(mean) == pytest.approx(2.0, abs=0.05)
    again = zl(first, second, "-o", tmp_path / "out", "--overwrite", "--quiet", "--json")
    answer = json.loads(again.stdout)
    assert "volumes" not in answer
    assert answer["cells"]["raised"] >= 100
    assert not (tmp_path / "out" / "volumes.csv").exists(), "of the earlier result"


def test_wrong_input_is_one_sentence(zl, dates, tmp_path):
    first, second, area = dates
    out = tmp_path / "out"
    for arguments, said in (
        ((first, first), "is given twice"),
        ((first, tmp_path / "none.tif"), "There is no surface"),
        ((first, second, "--area", tmp_path / "none.gpkg"), "There is no vector file"),
        ((first, second, "--name", "pit"), "names polygons, and there are none"),
        ((first, second, "--area", area, "--name", "depth"), "no attribute depth"),
        ((first, second, "--level", "0"), "is no probability"),
    ):
        done = zl(*arguments, "-o", out)
        assert done.exit_code == 2, done.output
        (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("zlocus: ")]
        assert said in sentence
    assert not out.exists()
    inside = zl(first, second, "-o", first, "--overwrite")
    assert inside.exit_code == 2
    assert "might be written over" in inside.stderr
