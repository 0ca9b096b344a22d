"""Every algorithm through qgis_process: files, outputs, and the sentences of what is refused."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
from rasterio.warp import transform_bounds


def test_all_algorithms_are_there(qgis):
    listed = qgis.process("list").stdout
    for name in ("zlocus:dsm", "zlocus:evaluate", "zlocus:products", "zlocus:compare"):
        assert name in listed
        assert qgis.process("help", name).returncode == 0


def test_a_surface_with_its_maps_and_styles(surface, images):
    names = {path.name for path in surface.iterdir()}
    for product in ("dsm.tif", "hillshade.tif", "contours.gpkg", "dtm.tif"):
        assert {product, f"{product.partition('.')[0]}.qml"} <= names
    assert {"report.html", "reasons.vrt", "quality.tif.aux.xml"} <= names
    assert "surface.laz" not in names
    asked = request_of(surface)
    assert asked["inputs"] == images
    assert asked["resolution"] == 0.6


def test_the_same_values_find_the_surface_finished(qgis, images, surface):
    found = qgis.run("dsm", INPUT=images, RESOLUTION=0.6, MAPS="0,1", OUTPUT=surface)
    assert found["DSM"] == str(surface / "dsm.tif")
    assert 0.5 < found["COVERAGE"] <= 1.0


def request_of(folder):
    return json.loads((folder / "run.json").read_text())["config"]["request"]


def test_an_extent_in_degrees_becomes_bounds_in_utm(qgis, images, middle, tmp_path):
    west, south, east, north = transform_bounds("EPSG:32632", "EPSG:4326", *middle)
    qgis.run(
        "dsm", INPUT=images, EXTENT=f"{west},{east},{south},{north} [EPSG:4326]", RESOLUTION=1, OUTPUT=tmp_path / "out",
        LOWEST=400, HIGHEST=500, OPTIONS="--no-report --set products.styles=false",
    )  # fmt: skip
    asked = request_of(tmp_path / "out")
    assert asked["crs"] == "EPSG:32632"
    assert asked["bounds"] == pytest.approx(middle, abs=1.0)  # meridians converge
    assert asked["heights"] == [400.0, 500.0]
    assert asked["report"] is False
    assert not list((tmp_path / "out").glob("*.qml"))


def test_polygons_of_a_layer_with_a_filter_are_written(qgis, images, middle, tmp_path):
    """A layer of chosen features is no file: a copy is kept, and found again by the same values."""
    west, south, east, north = middle
    box = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    features = [
        {"type": "Feature", "properties": {"kind": kind}, "geometry": {"type": "Polygon", "coordinates": [box]}}
        for kind in (1, 2)
    ]
    path = tmp_path / "areas.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    values = {"INPUT": images, "RESOLUTION": 1, "LOWEST": 400, "HIGHEST": 500, "OPTIONS": "--no-report"}
    for _ in range(2):
        qgis.run("dsm", AREA=f'{path}|subset="kind" = 1', OUTPUT=tmp_path / "out", **values)
    area = Path(request_of(tmp_path / "out")["area"])
    assert len(json.loads(area.read_text())["features"]) == 1
    qgis.run("dsm", AREA=path, OUTPUT=tmp_path / "whole", **values)
    assert request_of(tmp_path / "whole")["area"] == str(path)


def test_an_evaluation_has_its_figures(qgis, surface, scene, tmp_path):
    out = tmp_path / "out"
    found = qgis.run("evaluate", DSM=surface / "dsm.tif", REFERENCE=scene / "truth_dsm.tif", MARGIN=0, OUTPUT=out)
    assert {path.name for path in out.iterdir()} == {
        "error.tif", "error.qml", "error.sld", "evaluation.json", "histogram.png",
    }  # fmt: skip
    figures = json.loads((out / "evaluation.json").read_text())["all"]
    assert found["RMSE"] == figures["rmse"]
    assert found["COMPLETENESS"] > 0.5


def test_an_evaluation_at_points(qgis, surface, middle, tmp_path):
    points = tmp_path / "points.csv"
    points.write_text(f"x,y,z\n{middle[0]},{middle[1]},445\n{middle[2]},{middle[3]},445\n")
    out = tmp_path / "out"
    found = qgis.run("evaluate", DSM=surface / "dsm.tif", POINTS=points, OUTPUT=out)
    assert (out / "points.csv").is_file()
    assert "ERROR" not in found


def test_maps_are_made_later(qgis, surface, tmp_path):
    found = qgis.run("products", FOLDER=surface, MAPS="0,3", INTERVAL=5)
    assert found["POINTS"] == str(surface / "surface.laz")
    assert "every 25 m" in (surface / "contours.qml").read_text()


def test_a_comparison_of_runs(qgis, surface, tmp_path):
    out = tmp_path / "out"
    found = qgis.run("compare", A=surface / "dsm.tif", B=surface / "dtm.tif", OUTPUT=out)
    assert found["PAGE"] == str(out / "compare.html")
    assert (out / "difference.qml").is_file()
    again = qgis.refused("compare", A=surface / "dsm.tif", B=surface / "dtm.tif", OUTPUT=out)
    assert f"{out} holds another comparison" in again
    qgis.run("compare", A=surface / "dsm.tif", B=surface / "dtm.tif", OUTPUT=out, OVERWRITE="true")


@pytest.mark.parametrize(
    ("algorithm", "values", "sentence"),
    [
        ("dsm", {}, "There are no images. Give two or more"),
        ("dsm", {"INPUT": ["one.tif"]}, "There is no file one.tif"),
        ("dsm", {"INPUT": ["one.tif", "two.tif"]}, "There is no image one.tif"),
        ("dsm", {"INPUT": ["one.tif", "two.tif"], "LOWEST": 3}, "Only one end of the heights is given"),
        ("dsm", {"INPUT": ["one.tif", "two.tif"], "OPTIONS": "--nothing"}, "No such option"),
        ("dsm", {"INPUT": ["one.tif", "two.tif"], "OPTIONS": "'"}, "Correct the quotation marks"),
        ("products", {"FOLDER": "/nowhere"}, "There is no"),
        ("evaluate", {"DSM": "SURFACE"}, "The reference is a raster or points, and neither is given"),
    ],
)
def test_errors_are_sentences(qgis, surface, tmp_path, algorithm, values, sentence):
    values = {name: surface / "dsm.tif" if value == "SURFACE" else value for name, value in values.items()}
    out = {} if algorithm == "products" else {"OUTPUT": tmp_path / "out"}
    said = qgis.refused(algorithm, **values, **out)
    assert sentence in said
    assert "Traceback" not in said
    assert not (tmp_path / "out" / "run.json").exists()


def test_the_path_of_the_command_is_a_setting(qgis, surface, tmp_path):
    """The program of the setting is run although none is on PATH."""
    home = Path(shutil.copytree(qgis.environment["HOME"], tmp_path / "home"))
    (settings,) = home.rglob("QGIS3.ini")
    program = Path(sys.executable).parent / "zlocus"
    with settings.open("a") as file:
        file.write(f"\n[Processing]\nConfiguration\\ZLOCUS_COMMAND={program}\n")
    words = ["run", "zlocus:products", f"--FOLDER={surface}", "--MAPS=2"]
    done = qgis.process(*words, HOME=str(home), PATH="/usr/bin:/bin")
    assert done.returncode == 0, done.stdout + done.stderr
    settings.write_text(settings.read_text().replace(str(program), "/nowhere/zlocus"))
    done = qgis.process(*words, HOME=str(home), PATH="/usr/bin:/bin")
    assert "/nowhere/zlocus is no program. Correct the path" in done.stdout + done.stderr


def test_a_command_that_is_missing_is_said(qgis, images, tmp_path):
    words = [f"--INPUT={image}" for image in images]
    done = qgis.process("run", "zlocus:dsm", *words, f"--OUTPUT={tmp_path / 'out'}", PATH="/usr/bin:/bin")
    assert done.returncode != 0
    assert "The command zlocus is not on PATH. Install it" in done.stdout + done.stderr
