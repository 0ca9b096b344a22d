"""`zlocus compare`: its summary, its page, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from affine import Affine
from typer.testing import CliRunner

from zlocus.cli.app import app


@pytest.fixture
def zl():
    return lambda *arguments: CliRunner().invoke(app, ["compare", *(str(a) for a in arguments)])


def written(path, add=0.0, west=4e5):
    z = (50 + np.sin(np.arange(1200).reshape(30, 40) / 9) + add).astype(np.float32)
    profile = {"driver": "GTiff", "width": 40, "height": 30, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    with rasterio.open(path, "w", transform=Affine(1, 0, west, 0, -1, 5e6), **profile) as file:
        file.write(z, 1)
    return path


def test_a_summary_is_printed_and_a_page_is_written(zl, tmp_path):
    first, second, out = written(tmp_path / "a.tif"), written(tmp_path / "b.tif", 0.5), tmp_path / "out"
    done = zl(first, second, "-o", out)
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[:2] == [f"A: {first}", f"B: {second}"]
    assert "cells with a height: 1200 in both, 0 in A only, 0 in B only" in lines
    assert "B less A: median +0.500 m, NMAD 0.000 m, RMSE 0.500 m, LE90 0.500 m" in lines
    assert lines[-1] == f"{out / 'compare.html'}: open it in a browser."
    assert sorted(path.name for path in out.iterdir()) == [
        "compare.html", "difference.qml", "difference.sld", "difference.tif",
    ]  # fmt: skip
    again = zl(first, second, "-o", out)
    assert again.exit_code == 2
    assert "holds another comparison (compare.html, difference.tif)" in again.stderr
    assert zl(first, second, "-o", out, "--overwrite").exit_code == 0


def test_identical_surfaces_have_no_difference_and_the_rest_of_b_contradicts_nothing(zl, tmp_path):
    whole = written(tmp_path / "b.tif")
    with rasterio.open(whole) as file:
        profile = file.profile | {"width": 20}
        part = file.read(1)[:, :20]
    with rasterio.open(tmp_path / "a.tif", "w", **profile) as file:
        file.write(part, 1)
    lines = zl(tmp_path / "a.tif", whole, "-o", tmp_path / "out").stdout.splitlines()
    assert "B less A: no difference in any cell with a height in both" in lines
    assert not any("+0.000" in line or "differences below" in line for line in lines)
    assert (
        "The cells of A and B lie on each other where both reach, and are compared as they are. 600 cells of B with a "
        "height lie outside of the grid of A and are left out."
    ) in lines


def test_surfaces_of_other_ground_are_refused_in_a_sentence(zl, tmp_path):
    out = tmp_path / "out"
    done = zl(written(tmp_path / "a.tif"), written(tmp_path / "b.tif", west=5e5), "-o", out)
    assert done.exit_code == 2
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("zlocus: ")]
    assert "do not overlap. Give two surfaces of the same ground" in sentence
    assert not out.exists()


def test_an_input_is_not_written_over(zl, tmp_path):
    done = zl(written(tmp_path / "difference.tif"), written(tmp_path / "b.tif"), "-o", tmp_path, "--overwrite")
    assert done.exit_code == 2
    assert "would be written over. Choose another folder with -o." in done.stderr


def test_the_usual_folder(zl, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert zl(written(tmp_path / "a.tif"), written(tmp_path / "b.tif")).exit_code == 0
    assert (tmp_path / "comparison" / "compare.html").is_file()
