"""metadata.xml: every figure is that of run.json, and the document is valid by the schemas of ISO."""

import json
import os
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from iso_schemas import faults_of, iso_schema
from zlocus.cli.app import app
from zlocus.io.crs import local_frame
from zlocus.io.iso_xml import NAMESPACES, text
from zlocus.io.run_record import read_record, write_record
from zlocus.products.metadata import METADATA, write_metadata

# What a later entry of the history looks like.
REDONE = {
    "time": "2026-06-01T12:00:00+00:00", "area": [{"path": "roof <1>.gpkg", "sha256": "ab" * 32}], "level": None,
    "margin_m": 4.0, "options": {"semiglobal.p2": {"was": None, "is": 60}}, "cells_inside": 100, "cells_changed": 42,
    "versions": {"zlocus": "0.1.0"},
}  # fmt: skip
EVALUATION = {"absolute": {"all": {"n": 12, "rmse": 0.25, "le90": 0.4, "le95": None, "mean": -0.1}}}


@pytest.fixture
def surface(small_surface, tmp_path):
    return Path(shutil.copytree(small_surface, tmp_path / "surface"))


def tree(folder):
    return ElementTree.parse(folder / METADATA).getroot()


def found(element, path):
    return element.findall(path, NAMESPACES)


def texts(element, path):
    return [each.text for each in found(element, path)]


def figures(folder):
    """Value and unit of every quality result, by the pointer of its measure."""
    made = {}
    for report in found(tree(folder), "mdb:dataQualityInfo/mdq:DQ_DataQuality/mdq:report/*"):
        (pointer,) = texts(report, "mdq:measure/*/mdq:measureIdentification/*/mcc:code/*")
        (value,) = texts(report, "mdq:result/mdq:DQ_QuantitativeResult/mdq:value/gco:Record")
        assert pointer not in made
        made[pointer] = value, report.tag.rpartition("}")[2]
    return made


def at(record, pointer):
    """The value at a JSON pointer (RFC 6901)."""
    for key in pointer.split("/")[1:]:
        record = record[key.replace("~1", "/").replace("~0", "~")]
    return record


def test_every_figure_is_that_of_the_record(surface):
    run, stated = read_record(surface / "run.json"), figures(surface)
    for pointer, (value, _) in stated.items():
        name, _, place = pointer.partition("#")
        assert name == "run.json"
        assert value == json.dumps(at(run, place)), pointer
    assert {f"run.json#/sigma/{key}" for key in run["sigma"]} <= set(stated)
    assert {f"run.json#/cells/{key}" for key in run["cells"] if key != "empty"} <= set(stated)
    assert {f"run.json#/cells/empty/{flag}" for flag in run["cells"]["empty"]} <= set(stated)
    assert stated["run.json#/coverage"] == (json.dumps(run["coverage"]), "DQ_CompletenessOmission")
    assert {kind for _, kind in stated.values()} == {
        "DQ_CompletenessOmission", "DQ_GriddedDataPositionalAccuracy", "DQ_RelativeInternalPositionalAccuracy",
    }  # fmt: skip


def test_lineage_names_inputs_images_and_stages(surface):
    run, root = read_record(surface / "run.json"), tree(surface)
    lineage = "mdb:resourceLineage/mrl:LI_Lineage"
    sources = texts(root, f"{lineage}/mrl:source/*/mrl:sourceCitation/*/cit:title/*")
    assert sources == [*(each["path"] for each in run["inputs"]), *run["orientation"]["views"]]
    digests = texts(root, f"{lineage}/mrl:source/*/mrl:sourceCitation/*/cit:identifier/*/mcc:code/*")
    assert digests == [each["sha256"] for each in run["inputs"]]
    steps = texts(root, f"{lineage}/mrl:processStep/*/mrl:description/*")
    for stage, said in zip(run["stages"], steps, strict=True):
        assert said.startswith(f"{stage['name']}: {stage['wall_s']} s, {stage['cpu_s']} s of processors")
    assert set(texts(root, f"{lineage}/mrl:processStep/*/mrl:reference/*/cit:edition/*")) == {run["versions"]["zlocus"]}
    whens = texts(root, f"{lineage}/mrl:processStep/*/mrl:stepDateTime/*/gml:timePosition")
    assert set(whens) == {run["created"]}


def test_grid_reference_systems_extent_and_dates_are_those_of_the_record(surface):
    run, root = read_record(surface / "run.json"), tree(surface)
    sizes = texts(root, ".//msr:dimensionSize/*")
    assert [int(size) for size in sizes] == run["grid"]["shape"]
    assert texts(root, ".//msr:resolution/*") == [json.dumps(run["grid"]["transform"][0])] * 2
    systems = texts(root, "mdb:referenceSystemInfo/*/mrs:referenceSystemIdentifier/*/mcc:code/*")
    assert systems == [run["grid"]["crs"].removeprefix("EPSG:"), f"heights above {run['vertical']['heights_above']}"]
    box = [float(value) for value in texts(root, ".//gex:EX_GeographicBoundingBox/*/gco:Decimal")]
    west, south, east, north = json.loads((surface / "item.json").read_text())["bbox"]
    assert box == [west, east, south, north]
    low, high = texts(root, ".//gex:EX_VerticalExtent/*/gco:Real")
    assert [float(low), float(high)] == run["surface_range_m"]
    assert texts(root, "mdb:dateInfo/*/cit:date/*") == [run["created"]]


def changed(surface, **more):
    """Write the metadata of a surface whose run.json has other entries."""
    run = read_record(surface / "run.json") | more
    run.pop("schema")
    write_record(surface / "run.json", run)
    assert write_metadata(surface)


def test_parts_that_were_redone_are_steps_of_the_lineage(surface):
    changed(surface, redone=[REDONE])
    root = tree(surface)
    steps = texts(root, "mdb:resourceLineage/*/mrl:processStep/*/mrl:description/*")
    assert steps[-1] == (
        f"A part was redone inside roof <1>.gpkg (SHA-256 {'ab' * 32}), with semiglobal.p2 = 60: 42 of 100 cells "
        "changed."
    )
    assert texts(root, "mdb:dateInfo/*/cit:date/*")[-1] == REDONE["time"]


def test_an_evaluation_in_the_folder_is_the_absolute_accuracy(surface):
    (surface / "evaluation.json").write_text(json.dumps(EVALUATION))
    assert write_metadata(surface)
    stated = {pointer: value for pointer, value in figures(surface).items() if pointer.startswith("evaluation.json")}
    assert {pointer: float(value) for pointer, (value, _) in stated.items()} == {
        f"evaluation.json#/absolute/all/{key}": value
        for key, value in EVALUATION["absolute"]["all"].items()
        if value is not None
    }
    assert {kind for _, kind in stated.values()} == {"DQ_AbsoluteExternalPositionalAccuracy"}


def test_accuracy_at_check_points_is_told_as_soon_as_it_is_known(surface, tmp_path):
    with rasterio.open(surface / "dsm.tif") as source:
        z, transform = source.read(1), source.transform
        crs = source.crs.to_string()
    rows, cols = np.nonzero(np.isfinite(z[20:-20:5, 20:-20:5]))
    rows, cols = 20 + 5 * rows, 20 + 5 * cols
    x, y = transform * (cols + 0.5, rows + 0.5)
    lines = [f"{a},{b},{c + 0.25}" for a, b, c in zip(x, y, z[rows, cols], strict=True)]
    (tmp_path / "points.csv").write_text("\n".join(["x,y,z", *lines, ""]))
    words = ["evaluate", surface / "dsm.tif", tmp_path / "points.csv", "--points-crs", crs, "-o", surface]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    record, stated = read_record(surface / "evaluation.json"), figures(surface)
    for key in ("rmse_v", "n_compared"):
        value, kind = stated[f"evaluation.json#/asprs/nva/{key}"]
        assert value == json.dumps(record["asprs"]["nva"][key])
        assert kind == "DQ_AbsoluteExternalPositionalAccuracy"
    assert record["asprs"]["nva"]["rmse_v"] == pytest.approx(0.25, abs=1e-3)


def test_an_evaluation_from_before_a_part_was_redone_is_not_stated(surface):
    path = surface / "evaluation.json"
    path.write_text(json.dumps(EVALUATION))
    os.utime(path, (1.0e9, 1.0e9))
    changed(surface, redone=[REDONE])
    assert not any(pointer.startswith("evaluation") for pointer in figures(surface))


def test_a_record_of_an_earlier_version_has_no_metadata(surface):
    run = read_record(surface / "run.json")
    del run["sigma"], run["schema"]
    write_record(surface / "run.json", run)
    (surface / METADATA).unlink()
    assert not write_metadata(surface)
    assert not (surface / METADATA).exists()


def test_texts_that_xml_cannot_hold_are_shown_without_these_characters():
    made = text("gco:CharacterString", "a\x00b\udcffc&<")
    assert made[0].text == "a?b?c&<"


@pytest.mark.parametrize("kind", ["of a run", "redone and evaluated", "in a local frame", "above a geoid"])
def test_the_document_is_valid_by_the_schemas_of_iso(surface, kind):
    schema = iso_schema()
    if kind == "redone and evaluated":
        (surface / "evaluation.json").write_text(json.dumps(EVALUATION))
        earlier = REDONE | {"time": "2001-01-01T00:00:00+00:00"}
        changed(surface, redone=[earlier, earlier | {"level": "3"}])
    elif kind == "in a local frame":
        run = read_record(surface / "run.json")
        changed(surface, grid=run["grid"] | {"crs": local_frame().to_wkt()})
    elif kind == "above a geoid":
        vertical = {"heights_above": "the EGM96 geoid", "crs": "EPSG:5773", "geoid": "egm96.tif"}
        changed(
            surface, vertical=vertical, image_dates=["2026-01-01", None, "2026-03-01"], surface_range_m=[None, None]
        )
    assert faults_of(schema, surface / METADATA) == []


def test_the_schemas_find_faults(surface):
    schema, path = iso_schema(), surface / METADATA
    content = path.read_text(encoding="utf-8")
    path.write_text(
        re.sub(r"<gco:Integer>2</gco:Integer>", "<gco:Integer>two</gco:Integer>", content), encoding="utf-8"
    )
    assert faults_of(schema, path)


def test_elements_stand_in_the_order_of_the_schema(surface):
    """The order of ISO 19115-3, as far as it is used, so that a fault shows without the schemas too."""
    order = [
        "metadataIdentifier", "metadataScope", "contact", "dateInfo", "metadataStandard", "spatialRepresentationInfo",
        "referenceSystemInfo", "identificationInfo", "dataQualityInfo", "resourceLineage",
    ]  # fmt: skip
    names = [each.tag.rpartition("}")[2] for each in tree(surface)]
    assert list(dict.fromkeys(names)) == order
    assert sorted(names, key=order.index) == names
    (lineage,) = found(tree(surface), "mdb:resourceLineage/mrl:LI_Lineage")
    parts = list(dict.fromkeys(each.tag.rpartition("}")[2] for each in lineage))
    assert parts == ["statement", "scope", "source", "processStep"]
    ids = [value for each in tree(surface).iter() for key, value in each.attrib.items() if key.endswith("}id")]
    assert len(set(ids)) == len(ids)
