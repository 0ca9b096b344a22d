"""Styles as QGIS draws them, results in a project, and a run that is cancelled and resumed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import shapely.geometry
from ept import write_ept

# Pictures for people to look at, where this names a folder.
PICTURES = os.environ.get("ZLOCUS_QGIS_PICTURES")


@pytest.fixture(scope="module")
def drawn(qgis, surface, tmp_path_factory):
    return qgis.script("in_qgis.py", "draw", surface, PICTURES or tmp_path_factory.mktemp("pictures"))


def zlocus(*words):
    command = [str(Path(sys.executable).parent / "zlocus"), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def drawn_of_others(qgis, scene, surface, images, middle, tmp_path_factory):
    """Products of the other commands, each in a folder of its name."""
    out, truth = tmp_path_factory.mktemp("others"), scene / "truth_dsm.tif"
    area = out / "area.geojson"
    crs = {"type": "name", "properties": {"name": "EPSG:32632"}}
    feature = {
        "type": "Feature",
        "properties": {"name": "a"},
        "geometry": shapely.geometry.mapping(shapely.box(*middle)),
    }
    area.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    zlocus("evaluate", surface / "dsm.tif", truth, "-o", out / "evaluation", "--margin", 0)
    zlocus("mosaic", surface, f"{truth}=0.3", "-o", out / "mosaic")
    zlocus("change", surface, f"{truth}=0.3", "-o", out / "change", "--area", area)
    zlocus("ortho", surface, *images[:2], "-o", out / "ortho")
    zlocus("cloud", *images, "-o", out / "cloud", "--bounds", *middle, "--reference", Path(images[0]).stem, "--partial")
    zlocus("rank", *images, "-o", out / "rank")
    area.unlink()
    shutil.copy(out / "cloud" / "cloud.qml", write_ept(out / "cloud" / "cloud.laz", out / "points").with_suffix(".qml"))
    pictures = Path(PICTURES) / "others" if PICTURES else tmp_path_factory.mktemp("pictures")
    return qgis.script("in_qgis.py", "draw", out, pictures)


RENDERERS = {
    "dsm.tif": "singlebandpseudocolor", "dtm.tif": "singlebandpseudocolor", "sigma.tif": "singlebandpseudocolor",
    "quality.tif": "paletted", "reasons.vrt": "paletted", "views.tif": "paletted", "water.tif": "paletted",
    "ortho.tif": "singlebandgray", "hillshade.tif": "singlebandgray", "contours.gpkg": "RuleRenderer",
    "ties.gpkg": "RuleRenderer", "footprints.geojson": "RuleRenderer",
}  # fmt: skip
# Of the other commands. `points` holds the cloud in a form that this QGIS opens.
OTHERS = {
    "evaluation/error.tif": "singlebandpseudocolor", "mosaic/source.tif": "paletted", "mosaic/seams.tif": "paletted",
    "mosaic/dsm.tif": "singlebandpseudocolor", "change/difference.tif": "singlebandpseudocolor",
    "change/significance.tif": "singlebandpseudocolor", "change/class.tif": "paletted",
    "change/volumes.gpkg": "RuleRenderer", "ortho/mosaic.tif": "singlebandgray",
    "ortho/mosaic_images.tif": "paletted", "points/ept.json": "rgb", "rank/ranking.gpkg": "RuleRenderer",
    "rank/ties.gpkg": "RuleRenderer",
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


@pytest.mark.parametrize("name", OTHERS)
def test_qgis_draws_what_other_commands_write(drawn_of_others, name):
    found = drawn_of_others[name]
    assert found["renderer"] == OTHERS[name]
    assert found["qml"] == ["", True]
    assert found["reloaded"], "the style was there from the start"
    assert found["colours"] > 1


def test_images_of_a_cloud_and_ortho_images_are_drawn(drawn_of_others, images):
    """In files with the name of their image; flags and their groups lie the same way up."""
    name = Path(images[0]).stem
    kinds = {"cloud/{}_height.tif": "singlebandpseudocolor", "cloud/{}_quality.tif": "paletted",
             "cloud/{}_reasons.vrt": "paletted", "ortho/{}_ortho.tif": "singlebandgray"}  # fmt: skip
    found = {kind: drawn_of_others[kind.format(name)] for kind in kinds}
    assert {kind: each["renderer"] for kind, each in found.items()} == kinds
    assert all(each["colours"] > 1 for each in found.values())
    assert found["cloud/{}_quality.tif"]["colours"] == found["cloud/{}_reasons.vrt"]["colours"]


def test_legends_name_runs_and_images(drawn_of_others, images):
    assert {"out", "truth_dsm.tif=0.3"} <= {Path(text).name for text in drawn_of_others["mosaic/source.tif"]["legend"]}
    assert Path(images[1]).stem in drawn_of_others["ortho/mosaic_images.tif"]["legend"]
    assert "lowered in all, m\u00b3" in drawn_of_others["change/volumes.gpkg"]["legend"]


@pytest.mark.parametrize("name", ["contours.gpkg", "ties.gpkg", "footprints.geojson"])
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
