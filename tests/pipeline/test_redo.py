"""`zlocus dsm --redo`: a part of a finished surface is made again; all other cells keep their bytes."""

import hashlib
import json
import os
import shutil
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from zlocus.core.errors import ConfigError, GeometryError, InputError, OutputError
from zlocus.core.progress import KeptNotes
from zlocus.core.redo_request import RedoRequest
from zlocus.core.requests import DsmRequest
from zlocus.core.rerun_request import RerunRequest
from zlocus.io import exchanged_folders
from zlocus.io.grid_inputs import cells_inside, read_polygons
from zlocus.io.run_record import read_record
from zlocus.matching.quality import Quality
from zlocus.pipeline.dsm import run_dsm
from zlocus.pipeline.finished_record import checksum, read_finished
from zlocus.pipeline.recorded_run import config_of, request_of
from zlocus.pipeline.redo import run_redo
from zlocus.pipeline.redo_folder import RedoFolder
from zlocus.pipeline.rerun import run_again
from zlocus.products.raster_cells import SurfaceReader
from zlocus.products.redone_area import RedoneArea

RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
# Weaker penalties of jumps, which change nearly every cell.
OTHER = ("semiglobal.p2=60",)
# Rounding of a height of some 500 m.
ROUNDING_M = 1e-4


@pytest.fixture
def surface(small_surface, tmp_path):
    """A copy of a finished surface of 0.5 m cells."""
    return Path(shutil.copytree(small_surface, tmp_path / "surface"))


@pytest.fixture
def square(surface, tmp_path):
    """`square(name, west, south, side, **attributes)`: the file of a square polygon, from shares of the grid."""
    with SurfaceReader(surface) as reader:
        box = reader.geobox.boundingbox

    def of(name, west, south, side, **attributes):
        x, y = box.left + west * (box.right - box.left), box.bottom + south * (box.top - box.bottom)
        width = side * (box.right - box.left)
        ring = [[x, y], [x + width, y], [x + width, y + width], [x, y + width], [x, y]]
        return vector(tmp_path / name, [("Polygon", [ring], attributes)])

    return of


def vector(path, features):
    """A GeoJSON file in the CRS of the town. features : kind, coordinates and attributes of each."""
    listed = [
        {"type": "Feature", "properties": attributes, "geometry": {"type": kind, "coordinates": coordinates}}
        for kind, coordinates, attributes in features
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": listed}))
    return path


def redo(surface, area, progress=None, **more):
    """Redo a part of a surface with the inputs of its run."""
    inputs = request_of(surface / "run.json", read_record(surface / "run.json")).inputs
    given = more.pop("given", {})
    request = DsmRequest(inputs=inputs, out=surface, **given)
    return run_redo(RedoRequest(dsm_request=request, area=area, **more), progress or KeptNotes())


def cells_of(surface):
    with SurfaceReader(surface) as reader:
        return reader.read(0, 0, tuple(reader.geobox.shape))


def inside(surface, area):
    with SurfaceReader(surface) as reader:
        return cells_inside(read_polygons(area, CRS.from_epsg(32632)), reader.geobox)


def state(folder):
    """Checksums of all files of a folder."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.iterdir()) if p.is_file()}


def test_the_same_options_give_the_same_bytes(surface, square):
    before, run = state(surface), read_record(surface / "run.json")
    result = redo(surface, square("area.geojson", 0.2, 0.2, 0.5))
    after = state(surface)
    assert result.n_changed == 0
    assert {name: after[name] for name in RASTERS} == {name: before[name] for name in RASTERS}
    again = read_record(surface / "run.json")
    (entry,) = again.pop("redone")
    assert again == run
    assert entry["setup_sha256"] == run["setup_sha256"]
    assert entry["options"] == {}


def test_all_other_cells_keep_their_bytes_and_the_history_lists_all_parts(surface, square, tmp_path):
    before = cells_of(surface)
    one, two = square("one.geojson", 0.1, 0.1, 0.35), square("two.geojson", 0.55, 0.5, 0.3)
    redo(surface, one, settings=OTHER)
    between = cells_of(surface)
    is_one, is_two = inside(surface, one), inside(surface, two)
    changed = between.differs_from(before)
    assert not (changed & ~is_one).any()
    assert (changed & is_one).sum() > is_one.sum() / 2
    second = redo(surface, two, given={"views": "all"}, settings=OTHER, margin_m=1.0)
    after = cells_of(surface)
    assert not (after.differs_from(between) & ~is_two).any()
    run = read_record(surface / "run.json")
    first, last = run["redone"]
    assert first["area"] == [{"path": str(one), "sha256": hashlib.sha256(one.read_bytes()).hexdigest()}]
    assert first["options"] == {"semiglobal.p2": {"was": None, "is": 60}}
    assert first["cells_changed"] == changed.sum()
    assert first["cells_inside"] == is_one.sum()
    assert first["share_changed"] == round(changed.sum() / changed.size, 8)
    assert last["options"]["views"] == {"was": "auto", "is": "all"}
    assert last["margin_m"] == 1.0
    assert second.n_inside == is_two.sum()
    finished = read_finished(surface)
    assert finished.n_redone == 2
    assert {name: checksum(surface / name) for name in finished.checksums} == finished.checksums
    assert run["rasters"] == {name: finished.checksums[name] for name in RASTERS}
    assert not (tmp_path / ".surface.redo").exists()


def test_heights_at_the_border_pass_over_where_both_agree(surface, square, tmp_path):
    area = square("area.geojson", 0.2, 0.2, 0.5)
    before, without_ramp = cells_of(surface), Path(shutil.copytree(surface, tmp_path / "without"))
    redo(surface, area, settings=OTHER)
    redo(without_ramp, area, settings=OTHER, margin_m=0.0)
    after, new = cells_of(surface), cells_of(without_ramp)
    with SurfaceReader(surface) as reader:
        redone_area = RedoneArea.of(read_polygons(area, CRS.from_epsg(32632)), reader.geobox, None)
    weight = redone_area.weights(0, 0, before.height.shape)
    both = (weight > 0) & (weight < 0.5) & np.isfinite(before.height) & np.isfinite(new.height)
    assert both.sum() > 100
    step, whole_step = (np.abs(cells.height - before.height)[both] for cells in (after, new))
    assert np.median(whole_step) > 0.01
    assert (step <= weight[both] * whole_step + ROUNDING_M).all()
    assert (step[whole_step > 0.1] > 0.0).mean() > 0.5


def test_the_products_of_the_run_follow(surface, square):
    before = state(surface)
    redo(surface, square("area.geojson", 0.2, 0.2, 0.5), settings=OTHER)
    after = state(surface)
    assert set(after) == set(before)
    changed = {name for name in after if after[name] != before[name]}
    assert changed >= {"dsm.tif", "hillshade.tif", "run.json", "finished.json", "item.json", "metadata.xml"}
    assert changed.isdisjoint({"ties.gpkg", "observations.npz", "events.jsonl"})


def test_a_level_holds_all_cells_inside(surface, square):
    area = square("area.geojson", 0.3, 0.3, 0.2, height=451.25)
    before = cells_of(surface)
    result = redo(surface, area, level="height")
    after, is_inside = cells_of(surface), inside(surface, area)
    assert (after.height[is_inside] == np.float32(451.25)).all()
    assert np.isnan(after.sigma[is_inside]).all()
    assert ((after.quality[is_inside] & Quality.FILLED) != 0).all()
    assert not (after.differs_from(before) & ~is_inside).any()
    assert result.n_changed == is_inside.sum()
    assert read_record(surface / "run.json")["cells"]["filled"] == is_inside.sum()
    redo(surface, area, level="450.5")
    assert (cells_of(surface).height[is_inside] == np.float32(450.5)).all()


def test_a_line_with_heights_holds_the_cells_along_it(surface, square, tmp_path):
    area = square("area.geojson", 0.2, 0.2, 0.5)
    with SurfaceReader(surface) as reader:
        geobox = reader.geobox
    before, row = cells_of(surface), geobox.shape[0] // 2
    west, y = geobox.transform * (0, row + 0.5)
    east, _ = geobox.transform * (geobox.shape[1], row + 0.5)
    z = float(np.nanmedian(before.height)) + 1.0
    lines = vector(tmp_path / "lines.geojson", [("LineString", [[west, y, z], [east, y, z]], {})])
    redo(surface, area, break_lines=lines)
    after, is_inside = cells_of(surface), inside(surface, area)
    assert (after.height[row][is_inside[row]] == np.float32(z)).all()
    assert not (after.differs_from(before) & ~is_inside).any()
    entry = read_record(surface / "run.json")["redone"][0]
    assert entry["break_lines"][0]["sha256"] == hashlib.sha256(lines.read_bytes()).hexdigest()


def test_a_line_without_heights_changes_the_surface_inside_only(surface, square, tmp_path):
    area = square("area.geojson", 0.2, 0.2, 0.5)
    with SurfaceReader(surface) as reader:
        box = reader.geobox.boundingbox
    middle = (box.left + box.right) / 2
    lines = vector(tmp_path / "l.geojson", [("LineString", [[middle, box.bottom], [middle + 0.1, box.top]], {})])
    before = cells_of(surface)
    result = redo(surface, area, break_lines=lines)
    assert result.n_changed > 0
    assert not (cells_of(surface).differs_from(before) & ~inside(surface, area)).any()


def stopped(*_):
    raise KeyboardInterrupt


def test_an_interrupted_part_leaves_the_surface_and_resumes(surface, square, monkeypatch):
    area, before = square("area.geojson", 0.2, 0.2, 0.5), state(surface)
    with monkeypatch.context() as patch:
        patch.setattr(RedoFolder, "replace", stopped)
        with pytest.raises(KeyboardInterrupt):
            redo(surface, area, settings=OTHER)
    assert state(surface) == before
    progress = KeptNotes()
    result = redo(surface, area, progress, settings=OTHER)
    assert any("there already" in note for note in progress.sentences)
    assert result.n_changed > 0
    again = redo(surface, area, settings=OTHER)
    assert again.was_finished
    assert len(read_record(surface / "run.json")["redone"]) == 1


def test_tiles_of_a_part_with_other_options_are_dropped(surface, square, monkeypatch):
    area = square("area.geojson", 0.2, 0.2, 0.5)
    with monkeypatch.context() as patch:
        patch.setattr(RedoFolder, "replace", stopped)
        with pytest.raises(KeyboardInterrupt):
            redo(surface, area, settings=OTHER)
    progress = KeptNotes()
    redo(surface, area, progress)
    assert any("dropped" in note for note in progress.sentences)
    assert read_record(surface / "run.json")["redone"][0]["options"] == {}


def test_a_raster_that_cannot_be_written_leaves_the_surface(surface, square, monkeypatch):
    before = state(surface)

    def full(*_):
        raise OutputError("The disk is full.")

    monkeypatch.setattr("zlocus.products.rasters.SurfaceRasters.write_cells", full)
    with pytest.raises(OutputError, match="full"):
        redo(surface, square("area.geojson", 0.2, 0.2, 0.5), level="450")
    assert state(surface) == before
    assert not surface.with_name(".surface.redo").exists()


def test_a_system_that_cannot_exchange_folders_renames_them(surface, square, monkeypatch):
    monkeypatch.setattr(exchanged_folders, "_exchanged", lambda one, other: False)
    redo(surface, square("area.geojson", 0.3, 0.3, 0.2), level="450")
    assert len(read_record(surface / "run.json")["redone"]) == 1


def test_a_process_killed_between_two_renames_is_undone(surface, square, monkeypatch):
    area, before = square("area.geojson", 0.3, 0.3, 0.2), state(surface)
    monkeypatch.setattr(exchanged_folders, "_exchanged", lambda one, other: False)
    renames = []

    def killed(source, to):
        if renames:
            raise SystemExit
        renames.append(source)
        return rename(source, to)

    rename = os.rename
    with monkeypatch.context() as patch:
        patch.setattr(exchanged_folders.os, "rename", killed)
        with pytest.raises(SystemExit):
            redo(surface, area, level="450")
    assert not surface.exists()  # as after a kill: nothing could put it back
    with pytest.raises(InputError, match="no vector file"):
        redo_missing(surface, area)
    assert state(surface) == before


def redo_missing(surface, area):
    """A redo with an area that is missing, of a folder that is not there."""
    request = DsmRequest(inputs=(area, area.with_name("other.tif")), out=surface)
    run_redo(RedoRequest(dsm_request=request, area=area.with_name("missing.geojson")), KeptNotes())


@pytest.mark.parametrize(
    ("given", "more", "error", "said"),
    [
        ({"resolution": 1.0}, {}, ConfigError, "--resolution 1 is not that of the run"),
        ({"bounds": (0.0, 0.0, 1.0, 1.0)}, {}, ConfigError, "--bounds 0.0 0.0 1.0 1.0 is not that of the run"),
        ({"method": "gc3-sgm"}, {}, ConfigError, "ground grid"),
        ({"level_water": True}, {}, ConfigError, "--level-water"),
        ({}, {"settings": ("orientation.model=joint",)}, ConfigError, "which --redo keeps"),
        ({}, {"settings": ("products.contour_interval_m=5",)}, ConfigError, "which --redo keeps"),
        ({}, {"level": "height"}, InputError, "no attribute height"),
        ({}, {"level": "9000"}, InputError, "outside the heights"),
    ],
)
def test_what_cannot_be_redone_is_refused_and_changes_nothing(surface, square, given, more, error, said):
    before = state(surface)
    with pytest.raises(error, match=said):
        redo(surface, square("area.geojson", 0.2, 0.2, 0.5), given=given, **more)
    assert state(surface) == before


def test_a_polygon_without_a_level_is_named(surface, square):
    with pytest.raises(InputError, match=r"Polygon 1 of .* has no level in height"):
        redo(surface, square("area.geojson", 0.2, 0.2, 0.2, height=None), level="height")


def test_areas_and_lines_elsewhere_are_refused(surface, square, tmp_path):
    with pytest.raises(GeometryError, match="holds a cell of the surface"):
        redo(surface, square("area.geojson", 3.0, 0.2, 0.5))
    lines = vector(tmp_path / "lines.geojson", [("LineString", [[0, 0], [1, 1]], {})])
    with pytest.raises(GeometryError, match="meets the area"):
        redo(surface, square("area.geojson", 0.2, 0.2, 0.5), break_lines=lines)


def test_heights_of_lines_that_are_not_searched_are_refused(surface, square, tmp_path):
    with SurfaceReader(surface) as reader:
        box = reader.geobox.boundingbox
    lines = vector(
        tmp_path / "lines.geojson", [("LineString", [[box.left, box.bottom, 9000], [box.right, box.top, 9000]], {})]
    )
    with pytest.raises(InputError, match=r"has heights from 9000.00 to 9000.00 m outside"):
        redo(surface, square("area.geojson", 0.2, 0.2, 0.5), break_lines=lines)


def test_other_images_are_refused(surface, square):
    inputs = request_of(surface / "run.json", read_record(surface / "run.json")).inputs[:3]
    request = RedoRequest(DsmRequest(inputs=inputs, out=surface), square("area.geojson", 0.2, 0.2, 0.5))
    with pytest.raises(InputError, match="not those of the run"):
        run_redo(request, KeptNotes())


def test_a_folder_without_a_finished_surface_is_refused(tmp_path, surface, square):
    area = square("area.geojson", 0.2, 0.2, 0.5)
    (surface / "finished.json").unlink()
    with pytest.raises(OutputError, match="holds no finished surface"):
        redo(surface, area)


def test_the_command_of_the_run_finds_a_redone_surface_finished_and_never_drops_its_parts(surface, square):
    redo(surface, square("area.geojson", 0.3, 0.3, 0.2), level="450")
    run = read_record(surface / "run.json")
    request, config = request_of(surface / "run.json", run), config_of(surface / "run.json", run)
    before = state(surface)
    assert run_dsm(request, config, KeptNotes()).was_finished
    assert state(surface) == before
    (surface / "sigma.tif").unlink()
    with pytest.raises(OutputError, match="parts of it were redone since"):
        run_dsm(request, config, KeptNotes())
    with pytest.raises(OutputError, match=r"lacks sigma.tif"):
        redo(surface, square("area.geojson", 0.3, 0.3, 0.2), level="451")


def test_a_rerun_of_a_redone_surface_is_refused(surface, square, tmp_path):
    redo(surface, square("area.geojson", 0.3, 0.3, 0.2), level="450")
    with pytest.raises(InputError, match="1 part was redone"):
        run_again(RerunRequest(record=surface, out=tmp_path / "again"), KeptNotes())


def test_files_of_others_in_the_folder_are_kept(surface, square):
    (surface / "mine").mkdir()
    (surface / "mine" / "notes.txt").write_text("mine")
    (surface / "project.qgz").write_text("project")
    surface.chmod(0o750)
    redo(surface, square("area.geojson", 0.3, 0.3, 0.2), level="450")
    assert (surface / "mine" / "notes.txt").read_text() == "mine"
    assert (surface / "project.qgz").read_text() == "project"
    assert stat.S_IMODE(surface.stat().st_mode) == 0o750


def test_a_working_folder_is_not_replaced(surface, square, monkeypatch):
    area = square("area.geojson", 0.3, 0.3, 0.2)
    monkeypatch.chdir(surface)
    with pytest.raises(OutputError, match="working folder"):
        redo(surface, area, level="450")


def test_options_that_exclude_each_other_are_refused(surface, square, tmp_path):
    request = DsmRequest(inputs=(tmp_path / "a.tif", tmp_path / "b.tif"), out=surface)
    area = square("area.geojson", 0.3, 0.3, 0.2)
    with pytest.raises(ConfigError, match="--break-lines"):
        RedoRequest(request, area, level="3", break_lines=area)
    with pytest.raises(ConfigError, match="--overwrite"):
        RedoRequest(replace(request, overwrite=True), area)
    with pytest.raises(ConfigError, match="--redo-margin"):
        RedoRequest(request, area, margin_m=-1.0)
    with pytest.raises(ConfigError, match="no height"):
        RedoRequest(request, area, level="nan")
