"""The same command given again after success, and folders that hold another run."""

from __future__ import annotations

import io
import json
import os
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

import zlocus
import zlocus.pipeline.dsm
import zlocus.pipeline.fingerprint
import zlocus.pipeline.finished_run
import zlocus.pipeline.surface_products
import zlocus.pipeline.tile_run
from rendered_scenes import GSD_M, HEIGHTS, PART, SMALL_TILES, read, run
from zlocus.cli.app import app
from zlocus.core.errors import CoverageError, OutputError, StoppedError
from zlocus.core.options import ProductOptions, RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import progress_for
from zlocus.core.requests import FINISHED, CloudRequest, CurvesRequest, RankRequest
from zlocus.pipeline.cloud import run_cloud
from zlocus.pipeline.execution.checkpoint import FOLDER, MANIFEST, TileCheckpoint
from zlocus.pipeline.finished_record import checksum
from zlocus.pipeline.match_curves import run_curves
from zlocus.pipeline.orient import run_orient
from zlocus.pipeline.rank import run_rank
from zlocus.products.stac_item import PRODUCTS, STYLES

RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
OF_TIES = ("ties.gpkg", "observations.npz", "footprints.geojson", "curves.json")


@pytest.fixture(scope="module")
def finished(images, tmp_path_factory):
    """A finished run, with its page."""
    return asked(images, tmp_path_factory.mktemp("finished") / "out").out


@pytest.fixture
def out(finished, tmp_path):
    """A copy of it, which may be changed."""
    return Path(shutil.copytree(finished, tmp_path / "out"))


def asked(images, out, config=SMALL_TILES, **more):
    return run(images("sine"), out, config, **({"bounds": PART, "workers": 1, "report": True} | more))


def forbid_matching(monkeypatch):
    """Make each tile that is matched from here on a failure of the test."""
    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", lambda *_: pytest.fail("a tile is matched"))


@pytest.fixture
def no_matching(finished, monkeypatch):
    """No tile is matched in the whole test."""
    forbid_matching(monkeypatch)


@pytest.fixture
def said(monkeypatch):
    """What a run says."""
    stream = io.StringIO()
    monkeypatch.setattr("rendered_scenes.progress_for", lambda _: progress_for(stream))
    return stream


def state(out):
    """Content and time of change of all files."""
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.iterdir() if path.is_file()}


def changed(before, out):
    now = state(out)
    return {name for name in before | now if before.get(name) != now.get(name)}


def test_what_is_finished_is_said_and_left_alone(images, out, no_matching):
    before = state(out)
    styles = {style.name for style in STYLES if style.name in before}
    assert {p.name for p in PRODUCTS if p.name in before} | styles | {"item.json", FINISHED} == set(before)
    listed = json.loads((out / FINISHED).read_text())
    assert set(listed["products"]) == set(before) - styles - {FINISHED, "events.jsonl"}
    result = asked(images, out)
    assert result.was_finished
    assert result.coverage == pytest.approx(json.loads((out / "run.json").read_text())["coverage"], abs=1e-6)
    assert changed(before, out) == set()
    # What changes no surface is no other run.
    assert asked(images, out, workers=2, memory_gb=8.0, partial=True, report=False).was_finished
    assert changed(before, out) == set()


def test_the_command_says_so_and_ends_well(images, tmp_path, monkeypatch):
    words = ["dsm", *images("sine").inputs, "-o", tmp_path / "out", "--crs", "EPSG:32632", "--resolution", GSD_M]
    words = [str(word) for word in [*words, "--heights", *HEIGHTS, "--bounds", *PART]]
    first = CliRunner().invoke(app, words)
    assert first.exit_code == 0, first.stderr
    forbid_matching(monkeypatch)
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0
    assert again.stdout == first.stdout.replace(": ", ": already finished, ", 1)


@pytest.mark.parametrize("name", ["hillshade.tif", "report.html", "item.json", *OF_TIES])
def test_a_product_that_is_missing_is_made_again_and_nothing_else(images, out, no_matching, said, name):
    before = state(out)
    (out / name).unlink()
    assert asked(images, out).was_finished
    assert f"Made, for it was not there: {name}." in said.getvalue()
    assert changed(before, out) == {name, FINISHED}
    if name not in ("curves.json", "ties.gpkg"):  # which hold times, or are written at one
        assert (out / name).read_bytes() == before[name][0]
    before = state(out)
    asked(images, out)
    assert changed(before, out) == set()


def test_styles_are_made_again_where_they_are_missing_and_stay_where_they_were_changed(images, out, no_matching, said):
    """QGIS writes the style of a layer, and statistics, beside it: no product has changed then."""
    own = "<qgis/>"
    for name in ("dsm.qml", "quality.tif.aux.xml"):
        (out / name).write_text(own)
    (out / "sigma.sld").unlink()
    before = state(out)
    assert asked(images, out).was_finished
    assert "Made, for it was not there: sigma.sld." in said.getvalue()
    assert "sigma.sld" in changed(before, out) <= {"sigma.sld", "item.json", FINISHED}
    assert (out / "dsm.qml").read_text() == own
    CliRunner().invoke(app, ["products", str(out), "--products", "hillshade"], catch_exceptions=False)
    assert (out / "dsm.qml").read_text() == own


@pytest.mark.parametrize("names", [("sigma.tif",), ("dsm.tif", "run.json", "report.html"), (*RASTERS, "hillshade.tif")])
def test_what_only_matching_makes_is_matched_again(images, out, said, names):
    before = state(out)
    for name in names:
        (out / name).unlink()
    assert not asked(images, out).was_finished
    lacking = [name for name in names if name not in ("report.html", "hillshade.tif")]
    assert f"lacks {', '.join(lacking)}, which only matching makes: it is made again" in said.getvalue()
    for name in (*RASTERS, "hillshade.tif"):
        assert (out / name).read_bytes() == before[name][0]
    assert set(state(out)) == set(before)
    assert asked(images, out).was_finished


def test_what_was_added_later_is_there_after_the_run_was_made_again(images, out):
    CliRunner().invoke(app, ["products", str(out), "--products", "dtm"], catch_exceptions=False)
    terrain = (out / "dtm.tif").read_bytes()
    (out / "views.tif").unlink()
    asked(images, out, report=False)
    assert (out / "dtm.tif").read_bytes() == terrain
    assert (out / "report.html").exists()


@pytest.mark.parametrize("name", ["dsm.tif", "hillshade.tif", "run.json", "report.html", "ties.gpkg"])
def test_a_product_that_was_changed_is_named(images, out, no_matching, name):
    if name == "ties.gpkg":
        with closing(sqlite3.connect(out / name)) as database:
            for function in ("IsEmpty", "MinX", "MaxX", "MinY", "MaxY"):  # of its triggers
                database.create_function(f"ST_{function}", 1, lambda _: 0)
            database.execute("UPDATE ties SET n_images = 9 WHERE rowid = 1")
            database.commit()
    else:
        content = bytearray((out / name).read_bytes())
        content[len(content) // 2] ^= 1
        (out / name).write_bytes(content)
    before = state(out)
    says = (
        rf"already finished, but {name} is not what the run wrote\. Remove it to have it made again, or add --overwrite"
    )
    with pytest.raises(OutputError, match=says) as refused:
        asked(images, out)
    assert refused.value.exit_status == 2
    assert changed(before, out) == set()
    if name == "hillshade.tif":
        (out / name).unlink()
        assert asked(images, out).was_finished


def test_a_program_that_looks_at_a_geopackage_changes_no_product(images, out, no_matching):
    """QGIS switches the journal of what it opens, and writes to its header."""
    path, before = out / "ties.gpkg", (out / "ties.gpkg").read_bytes()
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("UPDATE gpkg_contents SET last_change = '2030-01-01T00:00:00Z'")
        database.commit()
    assert path.read_bytes() != before
    assert asked(images, out).was_finished
    # What is none has the checksum of its bytes.
    (out / "none.gpkg").write_bytes(b"nothing")
    (out / "none").write_bytes(b"nothing")
    assert checksum(out / "none.gpkg") == checksum(out / "none")


def test_another_run_is_refused_and_what_differs_is_said(images, out, no_matching, monkeypatch, tmp_path):
    before = state(out)
    for more, says in (
        ({"heights": (20.0, 80.0)}, r"--heights was 25\.0 80\.0 there and is 20\.0 80\.0 now"),
        ({"config": RunConfig()}, r"the option pyramid\.tile was 80 there and is"),
        (
            {"config": replace(SMALL_TILES, products=ProductOptions(sun_azimuth_deg=90.0))},
            "the option products.sun_azimuth",
        ),
        ({"resume": False}, r"holds this run, already finished, which --no-resume asks not to take.*add --overwrite"),
    ):
        with pytest.raises(OutputError, match=says) as refused:
            asked(images, out, **more)
        assert "another run" in str(refused.value) or "--no-resume" in str(refused.value)
    with monkeypatch.context() as patch:
        patch.setattr(zlocus.pipeline.fingerprint, "versions_record", lambda: {"zlocus": "0"})
        with pytest.raises(OutputError, match="another run: the version of"):
            asked(images, out)
    others = tuple(Path(shutil.copy(path, tmp_path)) for path in images("sine").inputs)
    with pytest.raises(OutputError, match=r"another run: .*nadir\.tif is missing"):
        run(others, out, SMALL_TILES, bounds=PART)
    assert changed(before, out) == set()


def test_an_input_that_changed_since_is_another_run(images, tmp_path):
    copied = tuple(Path(shutil.copy2(path, tmp_path)) for path in images("sine").inputs)
    out = run(copied, tmp_path / "out", SMALL_TILES, bounds=PART, report=False).out
    os.utime(copied[1])
    with pytest.raises(OutputError, match=rf"another run: .*{copied[1].name} has changed since"):
        run(copied, out, SMALL_TILES, bounds=PART)
    assert not run(copied, out, SMALL_TILES, bounds=PART, report=False, overwrite=True).was_finished
    assert run(copied, out, SMALL_TILES, bounds=PART, report=False).was_finished


@pytest.mark.parametrize("content", ["", "[]", '{"schema": 9}', '{"schema": 1, "key": 3, "products": {}}', "{" * 9999])
def test_a_list_of_checksums_that_is_damaged_is_said(images, out, content):
    (out / FINISHED).write_text(content)
    with pytest.raises(OutputError, match=rf"another run: its {FINISHED} is damaged\. Choose another folder, or add"):
        asked(images, out)


def test_products_that_are_asked_for_later_are_added(images, out, no_matching, said):
    """Terrain for its contours too, and only those; what is no longer asked for stays."""
    before = state(out)
    config = replace(SMALL_TILES, products=ProductOptions(contours_of="dtm"))
    with pytest.raises(OutputError, match="contours_of"):
        asked(images, out, config, products=("dtm",))
    assert asked(images, out, products=("dtm", "laz")).was_finished
    assert changed(before, out) == {
        "dtm.tif", "dtm.qml", "dtm.sld", "surface.laz", "surface.qml", "item.json", FINISHED,
    }  # fmt: skip
    assert "Made, for it was not there: dtm.tif, surface.laz." in said.getvalue()
    assert "dtm.tif" in (out / "item.json").read_text()
    before = state(out)
    assert asked(images, out, products=()).was_finished
    assert changed(before, out) == set()


def test_contours_of_a_terrain_that_is_there_are_added(images, tmp_path, monkeypatch):
    config = replace(SMALL_TILES, products=ProductOptions(contours_of="dtm"))
    out = asked(images, tmp_path / "out", config, products=("dtm",), report=False).out
    forbid_matching(monkeypatch)
    assert asked(images, out, config, products=("contours",), report=False).was_finished
    assert (out / "contours.gpkg").exists()


def test_a_page_that_is_asked_for_later_is_added_with_what_it_shows(images, finished, tmp_path, said):
    out = asked(images, tmp_path / "out", report=False).out
    before = state(out)
    assert asked(images, out, report=False).was_finished
    assert changed(before, out) == set()
    assert asked(images, out).was_finished
    assert changed(before, out) == {
        "footprints.geojson", "footprints.qml", "footprints.sld", "curves.json", "report.html", "item.json", FINISHED,
    }  # fmt: skip
    assert (out / "footprints.geojson").read_bytes() == (finished / "footprints.geojson").read_bytes()
    cells, others = (
        [{name: cell.get(name) for name in ("row", "col", "height_m", "svg")} for cell in json.loads(text)["cells"]]
        for text in ((out / "curves.json").read_text(), (finished / "curves.json").read_text())
    )
    assert [cell["row"] for cell in cells] == [cell["row"] for cell in others]
    assert all(cell["svg"] for cell in cells)


def test_products_and_pages_that_were_made_on_purpose_are_those_of_the_run(images, out, no_matching, tmp_path):
    options = tmp_path / "other.toml"
    options.write_text("[products]\nsun_azimuth_deg = 90.0\n")
    shade = (out / "hillshade.tif").read_bytes()
    words = [["products", out, "--products", "hillshade,contours", "--config", options],
             ["report", out, "--reference", out / "dsm.tif", "--margin", 1]]  # fmt: skip
    for command in words:
        result = CliRunner().invoke(app, [str(word) for word in command])
        assert result.exit_code == 0, result.stderr
    assert (out / "hillshade.tif").read_bytes() != shade
    before = state(out)
    assert asked(images, out).was_finished
    assert changed(before, out) == set()
    # They vouch for what they wrote, not for the rest.
    content = (out / "sigma.tif").read_bytes()
    (out / "sigma.tif").write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    CliRunner().invoke(app, ["products", str(out), "--products", "hillshade"], catch_exceptions=False)
    with pytest.raises(OutputError, match=r"sigma\.tif is not what the run wrote"):
        asked(images, out)


def test_products_of_a_folder_without_a_finished_run(finished, tmp_path):
    shutil.copy(finished / "dsm.tif", tmp_path)
    CliRunner().invoke(app, ["products", str(tmp_path), "--products", "hillshade"], catch_exceptions=False)
    assert not (tmp_path / FINISHED).exists()


@pytest.mark.parametrize("where", ["before its checksums", "before its tiles are removed"])
def test_a_run_that_was_killed_at_its_very_end(images, tmp_path, monkeypatch, where):
    out = tmp_path / "out"

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(
            *((zlocus.pipeline.dsm, "write_finished") if "checksums" in where else (TileCheckpoint, "remove")), killed
        )
        with pytest.raises(KeyboardInterrupt):
            asked(images, out, report=False)
    assert (out / FOLDER / MANIFEST).exists()
    forbid_matching(monkeypatch)
    assert asked(images, out, report=False).was_finished == ("removed" in where)
    assert not (out / FOLDER).exists()
    assert asked(images, out, report=False).was_finished


def test_a_surface_with_too_few_heights_is_no_success_the_second_time(images, tmp_path, monkeypatch):
    monkeypatch.setattr(zlocus.pipeline.surface_products, "SUFFICIENT_COVERAGE", 1.1)
    sentences = []
    for _ in range(2):
        with pytest.raises(CoverageError, match="of the cells seen by two images or more have a height") as refused:
            asked(images, tmp_path / "out", report=False)
        sentences.append(str(refused.value))
        forbid_matching(monkeypatch)
    assert sentences[0] == sentences[1]
    assert asked(images, tmp_path / "out", report=False, partial=True).was_finished
    # And one that was accepted is none when it is not.
    monkeypatch.undo()
    monkeypatch.setattr(zlocus.pipeline.surface_products, "SUFFICIENT_COVERAGE", 1.1)
    assert not asked(images, tmp_path / "accepted", report=False, partial=True).was_finished
    with pytest.raises(CoverageError, match="of the cells seen by two images or more have a height"):
        asked(images, tmp_path / "accepted", report=False)


def test_a_run_that_may_replace_another_goes_on_where_it_was_stopped(images, out, monkeypatch):
    """Given again without --overwrite: its tiles say that it was allowed to."""
    match, made = zlocus.pipeline.tile_run.match_tile, []

    def stopping(*given):
        made.append(given)
        if len(made) == 2:
            raise IndexError("planted")
        return match(*given)

    other = {"bounds": None, "report": False}
    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", stopping)
    with pytest.raises(StoppedError):
        asked(images, out, **other, overwrite=True)
    monkeypatch.undo()
    with pytest.raises(OutputError, match="finished tiles of another run"):
        asked(images, out)
    assert not asked(images, out, **other).was_finished
    assert asked(images, out, **other).was_finished


def test_the_first_moments_of_another_run_do_not_open_a_folder(images, out):
    """Its manifest is there, and no tile yet: what is finished stays."""
    with TileCheckpoint.of(out, {"request": "another"}, is_resumed=True, overwrite=True).open("s"):
        pass
    assert (out / FOLDER / MANIFEST).exists()
    before = state(out)
    with pytest.raises(OutputError, match=r"another run: --heights"):
        asked(images, out, heights=(20.0, 80.0))
    (out / FINISHED).unlink()
    with pytest.raises(OutputError, match=r"another run \(run\.json, dsm\.tif\)"):
        asked(images, out, heights=(20.0, 80.0))
    assert changed(before, out) == {FINISHED}


def test_other_commands_do_not_write_where_a_surface_is(images, out):
    result = CliRunner().invoke(app, ["cloud", *map(str, images("sine").inputs), "-o", str(out)])
    assert result.exit_code == 2
    assert "holds another run" in result.stderr


def test_functions_refuse_what_their_commands_refuse(images, out):
    inputs, progress = images("sine").inputs, progress_for(io.StringIO())
    before = state(out)
    for run_stage, request in (
        (run_cloud, CloudRequest(inputs, out)),
        (run_orient, OrientRequest(inputs, out)),
        (run_rank, RankRequest(inputs, out)),
        (run_curves, CurvesRequest(inputs, out, at=(0.0, 0.0))),
    ):
        with pytest.raises(OutputError, match=r"holds another run[ :].*add --overwrite"):
            run_stage(request, RunConfig(), progress)
    assert changed(before, out) == set()


ASKED = {"crs": "EPSG:32632", "resolution": GSD_M, "heights": HEIGHTS, "bounds": PART}


def test_a_match_into_a_folder_that_holds_another_run_is_refused(images, out):
    before = state(out)
    with pytest.raises(
        OutputError, match=r"another run: --heights was .* add --overwrite \(in Python: overwrite=True\)"
    ):
        zlocus.match(*images("sine").inputs, out=out, config=SMALL_TILES, **ASKED | {"heights": (20.0, 80.0)})
    assert changed(before, out) == set()
    other = ASKED | {"heights": (20.0, 80.0)}
    zlocus.match(*images("sine").inputs, out=out, config=SMALL_TILES, **other, overwrite=True, report=False)
    assert json.loads((out / "run.json").read_text())["config"]["request"]["heights"] == [20.0, 80.0]


def test_a_match_that_is_finished_is_opened(images, out, no_matching):
    before = state(out)
    surface = zlocus.match(*images("sine").inputs, out=out, config=SMALL_TILES, **ASKED)
    assert (surface.height.values == read(out / "dsm.tif")[0])[5:-5, 5:-5].any()
    assert changed(before, out) == set()
