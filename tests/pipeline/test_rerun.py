"""A run made again from its record: the same inputs and options, and the same bytes."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import from_origin
from typer.testing import CliRunner

from geoids import write_geoid
from rendered_scenes import PART
from zlocus.cli.app import app
from zlocus.io.run_record import processor_name

RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
OPTIONS = "[pyramid]\ntile = 80\n[selection]\nmax_images = 6\n"


@pytest.fixture
def zl():
    """Run the command line in this process."""
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def folder(images, tmp_path, monkeypatch):
    """A folder with three images and a file of options, in which commands are given."""
    place = tmp_path / "project"
    place.mkdir()
    for path in images("sine").inputs:
        shutil.copy2(path, place)
    (place / "options.toml").write_text(OPTIONS)
    monkeypatch.chdir(place)
    return place


def sentence_of(result, status=2):
    """The one sentence with which a command ends."""
    assert result.exit_code == status, result.output
    assert "Traceback" not in result.output
    return " ".join(result.stderr.splitlines()[-1].split())


def asked(*more):
    """Words of `zlocus dsm` for the images of the folder, with options of many kinds."""
    return [
        "dsm", "nadir.tif", "fore.tif", "aft.tif", "-o", "surface", "--crs", "EPSG:32632", "--resolution", "0.6",
        "--heights", "25.1", "80.3", "--bounds", *PART, "--selection", "guided", "--fill", "interpolate", "--config",
        "options.toml", "--products", "contours,laz", "--no-report", "--reference", "fore", "--workers", "1", *more,
    ]  # fmt: skip


def record_of(out):
    return json.loads((out / "run.json").read_text())


def result_of(record):
    """What a record says of options and result, without times, places, and who did the work."""
    request = {n: v for n, v in record["config"]["request"].items() if n not in ("out", "workers", "inputs")}
    names = ("orientation", "grid", "heights", "vertical", "coverage", "evaluations", "rasters", "setup_sha256")
    return request, record["config"]["options"], {name: record.get(name) for name in names}


def test_a_surface_is_made_again_with_the_same_bytes(zl, folder):
    made = zl(*asked())
    assert made.exit_code == 0, made.output
    done = zl("rerun", "surface/run.json", "-o", "again")
    assert done.exit_code == 0, done.output
    assert "All 6 rasters have the recorded bytes." in done.stdout
    first, again = folder / "surface", folder / "again"
    assert {path.name for path in first.iterdir()} == {path.name for path in again.iterdir()}
    for name in (*RASTERS, "surface.laz"):
        assert (first / name).read_bytes() == (again / name).read_bytes(), name
    assert result_of(record_of(first)) == result_of(record_of(again))
    assert record_of(first)["command"] == "zlocus dsm"
    assert record_of(first)["processor"] == processor_name()
    # The folder is that of the same command, and the record may be named by its folder.
    words = asked()
    words[words.index("surface")] = "again"
    assert "already finished" in zl(*words).stdout
    assert "already finished" in zl("rerun", "surface", "-o", "again").stdout
    other = zl("rerun", "surface", "-o", "again", "--no-resume")
    assert "--no-resume" in sentence_of(other)


def test_a_cloud_is_made_again_with_the_same_bytes(zl, folder):
    words = ["cloud", "nadir.tif", "fore.tif", "aft.tif", "--crs", "EPSG:32632", "--heights", 25, 80, "--config"]
    words += ["options.toml", "--reference", "fore", "--bounds", *PART]
    made = zl(*words, "-o", "cloud")
    assert made.exit_code == 0, made.output
    done = zl("rerun", "cloud", "-o", "again")
    assert done.exit_code == 0, done.output
    assert "All 2 rasters have the recorded bytes." in done.stdout
    for name in ("fore_height.tif", "fore_quality.tif", "cloud.ply"):
        assert (folder / "cloud" / name).read_bytes() == (folder / "again" / name).read_bytes(), name
    assert "already finished" in zl(*words, "-o", "again").stdout
    # The options that count are those that were given, not as they were adapted to the images.
    record = record_of(folder / "cloud")
    assert record["given_options"]["pyramid"]["tile"] == 80
    record["config"]["options"]["pyramid"]["tile"] = 4096
    Path("run.json").write_text(json.dumps(record))
    assert "already finished" in zl("rerun", "run.json", "-o", "again").stdout


def test_records_of_earlier_runs_are_read(zl, folder):
    """Without the entries that a rerun needs and that runs did not always write."""
    assert zl(*asked()).exit_code == 0
    record = record_of(folder / "surface")
    for name in ("command", "processor", "kernels", "rasters"):
        del record[name]
    Path("old.json").write_text(json.dumps(record))
    done = zl("rerun", "old.json", "-o", "again")
    assert done.exit_code == 0, done.output
    assert "The record has no checksums of rasters" in done.stdout
    assert (folder / "surface" / "dsm.tif").read_bytes() == (folder / "again" / "dsm.tif").read_bytes()


def test_inputs_are_found_where_they_were_and_where_they_are(zl, folder, tmp_path, monkeypatch):
    assert zl(*asked()).exit_code == 0
    monkeypatch.chdir(tmp_path)
    assert zl("rerun", "project/surface", "-o", "from_elsewhere").exit_code == 0
    moved = tmp_path / "moved"
    folder.rename(moved)
    assert zl("rerun", "moved/surface", "-o", "with_its_images").exit_code == 0
    # The images alone.
    (tmp_path / "archive").mkdir()
    (moved / "surface" / "run.json").rename(tmp_path / "run.json")
    for path in moved.glob("*.tif"):
        path.rename(tmp_path / "archive" / path.name)
    said = sentence_of(zl("rerun", "run.json", "-o", "out"))
    assert "The input nadir.tif of the run of run.json is not there any more" in said
    assert "--inputs" in said
    assert not Path("out").exists()
    done = zl("rerun", "run.json", "-o", "out", "--inputs", "archive")
    assert done.exit_code == 0, done.output
    assert "All 6 rasters have the recorded bytes." in done.stdout
    assert "is no folder" in sentence_of(zl("rerun", "run.json", "-o", "other", "--inputs", "gone"))
    shutil.copy("run.json", "archive")
    assert zl("rerun", "archive/run.json", "-o", "beside").exit_code == 0, "the images lie beside the record"
    # From another machine, where they had other paths.
    text = Path("run.json").read_text()
    for name in ("nadir", "fore", "aft"):
        text = text.replace(f'"{name}.tif"', f'"/mission/images/{name}.tif"')
    Path("run.json").write_text(text)
    assert "/mission/images/nadir.tif" in sentence_of(zl("rerun", "run.json", "-o", "other"))
    assert zl("rerun", "run.json", "-o", "other", "--inputs", "archive").exit_code == 0


def test_an_input_with_another_content_is_refused(zl, folder):
    assert zl(*asked()).exit_code == 0
    image = folder / "fore.tif"
    os.utime(image)
    assert zl("rerun", "surface", "-o", "again").exit_code == 0, "another time of change is no change"
    content = bytearray(image.read_bytes())
    content[-1] ^= 1
    image.write_bytes(content)
    said = sentence_of(zl("rerun", "surface", "-o", "other"))
    assert "fore.tif has changed since the run of surface/run.json" in said
    assert not Path("other").exists()


def test_images_of_a_scene_file_and_a_geoid_are_checked(zl, folder, tmp_path, monkeypatch):
    """The scene file names the images, so they are where it says."""
    (folder / "images").mkdir()
    for path in folder.glob("*.tif"):
        path.rename(folder / "images" / path.name)
    lines = [f"  - {{name: {n}, image: images/{n}.tif, camera: {{kind: rpc}}}}" for n in ("nadir", "fore", "aft")]
    (folder / "scene.yaml").write_text("\n".join(["schema: 1", "views:", *lines]) + "\n")
    posts = np.full((8, 8), 48.0, np.float32)
    write_geoid(folder / "geoid.tif", posts, from_origin(7.5, 48.5, 0.25, 0.25))
    made = zl("dsm", "scene.yaml", "-o", "surface", "--vertical", "geoid.tif", "--heights", -23, 32, "--no-report")
    assert made.exit_code == 0, made.output
    monkeypatch.chdir(tmp_path)
    project = folder.rename(tmp_path / "elsewhere")
    (project / "surface").rename(tmp_path / "surface")
    said = sentence_of(zl("rerun", "surface", "-o", "again"))
    assert "is not there any more" in said
    done = zl("rerun", "surface", "-o", "again", "--inputs", "elsewhere")
    assert done.exit_code == 0, done.output
    assert "All 6 rasters have the recorded bytes." in done.stdout
    write_geoid(project / "geoid.tif", posts + 1, from_origin(7.5, 48.5, 0.25, 0.25))
    assert "geoid.tif has changed since" in sentence_of(zl("rerun", "surface", "-o", "b", "--inputs", "elsewhere"))
    (project / "images" / "aft.tif").write_bytes(b"II*\0 other")
    assert "aft.tif has changed since" in sentence_of(zl("rerun", "surface", "-o", "b", "--inputs", "elsewhere"))


def test_files_that_the_request_does_not_name_are_checked_where_they_are_opened(zl, folder):
    """As the grid of a geoid in the folder of PROJ, which has another place on each machine."""
    lines = [f"  - {{name: {n}, image: {n}.tif, camera: {{kind: rpc}}}}" for n in ("nadir", "fore", "aft")]
    Path("scene.yaml").write_text("\n".join(["schema: 1", "views:", *lines]) + "\n")
    assert zl("dsm", "scene.yaml", "-o", "surface", "--heights", 25, 80, "--no-report").exit_code == 0
    record = record_of(folder / "surface")
    (entry,) = (each for each in record["inputs"] if Path(each["path"]).name == "aft.tif")
    entry["path"], digest = "/other/machine/aft.tif", entry["sha256"]
    Path("run.json").write_text(json.dumps(record))
    assert zl("rerun", "run.json", "-o", "again").exit_code == 0
    entry["sha256"] = "0" * 64
    Path("run.json").write_text(json.dumps(record))
    assert "aft.tif has changed since" in sentence_of(zl("rerun", "run.json", "-o", "other"))
    entry["path"], entry["sha256"] = "/other/machine/gone.tif", digest
    Path("run.json").write_text(json.dumps(record))
    assert "gone.tif of the run of run.json is not there" in sentence_of(zl("rerun", "run.json", "-o", "other"))


def test_an_image_that_was_not_read_is_not_needed(zl, folder):
    """As one that shows nothing of the area: it has no checksum, and the run did not depend on it."""
    assert zl(*asked()).exit_code == 0
    record = record_of(folder / "surface")
    record["config"]["request"]["inputs"].append("far_away.tif")
    Path("run.json").write_text(json.dumps(record))
    assert zl("rerun", "run.json", "-o", "again").exit_code == 0


def test_other_versions_and_processors_are_told_and_differences_too(zl, folder):
    assert zl(*asked()).exit_code == 0
    record = record_of(folder / "surface")
    record["versions"]["numpy"], record["processor"] = "1.0", "pentium"
    record["rasters"]["sigma.tif"] = "0" * 64
    Path("run.json").write_text(json.dumps(record))
    done = zl("rerun", "run.json", "-o", "again")
    assert done.exit_code == 0, done.output
    assert "The run was made with numpy 1.0 (now " in done.stderr
    assert "on a processor of kind pentium, and this one is " in done.stderr
    assert "Other bytes than recorded: sigma.tif." in done.stdout
    record = record_of(folder / "surface")
    record["kernels"] = "other"
    Path("run.json").write_text(json.dumps(record))
    assert "other sources of zlocus" in zl("rerun", "run.json", "-o", "again", "--overwrite").stderr


def test_what_is_no_record_of_a_run_is_refused(zl, folder):
    assert "gone.json" in sentence_of(zl("rerun", "gone.json", "-o", "out"))
    assert zl("orient", "nadir.tif", "fore.tif", "aft.tif", "-o", "oriented").exit_code == 0
    for text in ("{}", "[]", "{", '{"config": {"request": 7}, "inputs": []}', '{"config": 3, "inputs": 3}'):
        Path("bad.json").write_text(text)
        assert "bad.json" in sentence_of(zl("rerun", "bad.json", "-o", "out"))
    said = sentence_of(zl("rerun", "oriented", "-o", "out"))
    assert "oriented/run.json is not the record of a surface or a point cloud" in said
    assert zl(*asked()).exit_code == 0
    for change in ({"inputs": [{"path": "a"}]}, {"inputs": [7]}):
        Path("bad.json").write_text(json.dumps(record_of(folder / "surface") | change))
        assert "bad.json does not hold the checksums" in sentence_of(zl("rerun", "bad.json", "-o", "out"))
    record = record_of(folder / "surface")
    record["config"]["request"]["resolution"] = "wide"
    Path("bad.json").write_text(json.dumps(record))
    assert "does not hold the request of the run" in sentence_of(zl("rerun", "bad.json", "-o", "out"))
    assert not Path("out").exists()


def test_another_run_in_the_folder_is_kept(zl, folder):
    assert zl(*asked()).exit_code == 0
    assert zl("dsm", "nadir.tif", "fore.tif", "-o", "other", "--no-report").exit_code == 0
    before = (folder / "other" / "dsm.tif").read_bytes()
    assert "holds another run" in sentence_of(zl("rerun", "surface", "-o", "other"))
    assert (folder / "other" / "dsm.tif").read_bytes() == before
    assert zl("rerun", "surface", "-o", "other", "--overwrite").exit_code == 0
    assert (folder / "other" / "dsm.tif").read_bytes() == (folder / "surface" / "dsm.tif").read_bytes()


def test_a_run_with_a_shortcoming_ends_so_again(zl, folder, monkeypatch):
    monkeypatch.setattr("zlocus.pipeline.surface_products.SUFFICIENT_COVERAGE", 2.0)
    made = zl(*asked())
    assert made.exit_code == 3, made.output
    again = zl("rerun", "surface", "-o", "again")
    assert again.exit_code == 3, again.output
    assert "All 6 rasters have the recorded bytes." in again.stderr
