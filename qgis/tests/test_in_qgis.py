"""Styles as QGIS draws them, results in a project, and a run that is cancelled and resumed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# Pictures for people to look at, where this names a folder.
PICTURES = os.environ.get("ZLOCUS_QGIS_PICTURES")


@pytest.fixture(scope="module")
def drawn(qgis, surface, tmp_path_factory):
    return qgis.script("in_qgis.py", "draw", surface, PICTURES or tmp_path_factory.mktemp("pictures"))


RENDERERS = {
    "dsm.tif": "singlebandpseudocolor", "dtm.tif": "singlebandpseudocolor", "sigma.tif": "singlebandpseudocolor",
    "quality.tif": "paletted", "reasons.vrt": "paletted", "views.tif": "paletted", "water.tif": "paletted",
    "ortho.tif": "singlebandgray", "hillshade.tif": "singlebandgray", "contours.gpkg": "RuleRenderer",
    "ties.gpkg": "RuleRenderer",
}  # fmt: skip


@pytest.mark.parametrize("name", RENDERERS)
def test_qgis_finds_the_style_by_its_name_and_draws_it(drawn, name):
    found = drawn[name]
    assert found["renderer"] == RENDERERS[name]
    if name != "reasons.vrt":
        assert found["qml"] == ["", True]
        assert found["reloaded"], "the style was there from the start"
    # Water is transparent where there is none.
    assert found["colours"] > (0 if name == "water.tif" else 2)


@pytest.mark.parametrize("name", ["contours.gpkg", "ties.gpkg"])
def test_qgis_reads_the_sld_of_features(drawn, name):
    """Of rasters it reads none: QGIS 3.22 says that the type of layer is not supported."""
    assert drawn[name]["sld"] == ["", True]
    assert drawn[name]["colours_by_sld"] > 2


def test_legends_have_names(drawn):
    assert {"2 images", "3 images"} & set(drawn["views.tif"]["legend"])
    assert "height without a warning" in drawn["quality.tif"]["legend"]
    assert "OCCLUDED" in " ".join(drawn["quality.tif"]["legend"])
    assert "height of a fitted plane (PLANE)" in drawn["reasons.vrt"]["legend"]
    assert any(text.startswith("every ") for text in drawn["contours.gpkg"]["legend"])


def test_gdal_reads_the_attribute_table(qgis, surface):
    import subprocess

    code = (
        "import sys; from osgeo import gdal; d = gdal.Open(sys.argv[1]); t = d.GetRasterBand(1).GetDefaultRAT();"
        "print(t.GetRowCount(), [t.GetNameOfCol(k) for k in range(t.GetColumnCount())])"
    )
    done = subprocess.run(
        [qgis.python, "-c", code, str(surface / "quality.tif")], env=qgis.environment, capture_output=True, text=True
    )
    assert "'Value', 'Count', 'Name', 'Red', 'Green', 'Blue', 'HasHeight', 'Group'" in done.stdout
    assert int(done.stdout.split()[0]) > 3


def test_results_are_loaded_in_order_into_a_group(qgis, surface):
    found = qgis.script("in_qgis.py", "load", surface)
    assert found["groups"] == ["zlocus out"]
    assert found["layers"] == ["contours", "hillshade", "terrain"]
    assert found["visible"] == ["contours", "hillshade"]
    assert found["renderers"] == ["RuleRenderer", "singlebandgray", "singlebandpseudocolor"]
    assert found["percent"] == 100


def test_a_run_is_cancelled_and_resumed(qgis, images, tmp_path):
    found = qgis.script("in_qgis.py", "cancel", tmp_path / "out", *images)
    first, second = found["first"], found["second"]
    assert first["results"] == {}
    assert "Ended by SIGTERM." in first["lines"]
    assert any("Run the algorithm again with the same values to resume" in line for line in first["lines"])
    assert "dsm.tif" not in first["files"]
    assert second["error"] == ""
    assert Path(second["results"]["DSM"]).is_file()
