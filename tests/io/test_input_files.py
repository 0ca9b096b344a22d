"""Inputs that change during a run: the run stops, and run.json never names a content that was not matched."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
from pathlib import Path

import pytest
import rasterio
import yaml

import zlocus.pipeline.dsm
import zlocus.pipeline.open_run
import zlocus.pipeline.setup
import zlocus.pipeline.tile_run
from rendered_scenes import HEIGHTS, PART, SMALL_TILES, run
from zlocus.core.errors import OutputError, StoppedError
from zlocus.core.options import RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import progress_for
from zlocus.core.requests import CloudRequest, RankRequest
from zlocus.io.input_files import InputFiles
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.cloud import run_cloud
from zlocus.pipeline.execution.checkpoint import FOLDER
from zlocus.pipeline.orient import run_orient
from zlocus.pipeline.rank import run_rank
from zlocus.pipeline.tile_run import TileRun
from zlocus.products.report.file_names import CURVES

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture
def copied(images, tmp_path):
    """Images that may be changed."""
    folder = tmp_path / "images"
    folder.mkdir()
    return tuple(Path(shutil.copy2(path, folder)) for path in images("sine").inputs)


@pytest.fixture
def elsewhere(tmp_path):
    """What an image was before it was changed."""
    return tmp_path / "as_it_was.tif"


def rewrite(path: Path, elsewhere: Path) -> None:
    """Give a file other pixels, of the same number; as it was it lies elsewhere."""
    shutil.move(path, elsewhere)
    with rasterio.open(elsewhere) as source:
        grey, profile, rpcs = source.read(), source.profile, source.rpcs
    with rasterio.open(path, "w", **profile, rpcs=rpcs) as file:
        file.write(grey[:, ::-1])


def after_tiles(monkeypatch, n_tiles, change):
    """Have a change happen while a tile is matched."""
    match, made = zlocus.pipeline.tile_run.match_tile, []

    def changing(*given):
        made.append(given)
        if len(made) == n_tiles + 1:
            change()
        return match(*given)

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", changing)


def asked(copied, out, **more):
    """A run of few tiles."""
    return run(copied, out, SMALL_TILES, **({"report": False, "workers": 1} | more))


def names(out):
    return sorted(path.name for path in out.iterdir()) if out.exists() else []


def n_tiles(out):
    return len([name for name in names(out / FOLDER) if name.endswith(".npz") and name != "before.npz"])


def test_a_run_stops_when_an_image_is_replaced(copied, elsewhere, tmp_path, monkeypatch):
    straight, out = asked(copied, tmp_path / "straight").out, tmp_path / "out"
    after_tiles(monkeypatch, 3, lambda: rewrite(copied[0], elsewhere))
    says = rf"The input .*{copied[0].name} was replaced or written to .* 3 finished tiles"
    with pytest.raises(StoppedError, match=says) as stop:
        asked(copied, out)
    assert stop.value.exit_status == 3
    assert names(out) == ["events.jsonl", FOLDER]
    assert n_tiles(out) == 3
    # The tiles are of the image as it was, so they are no part of a run with what it is now.
    with pytest.raises(OutputError, match=rf"3 finished tiles of another run: .*{copied[0].name} has changed since"):
        asked(copied, out)
    shutil.move(elsewhere, copied[0])
    asked(copied, out)
    for name in ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif"):
        assert (out / name).read_bytes() == (straight / name).read_bytes()


def test_an_image_replaced_by_one_of_another_size_is_named(copied, elsewhere, tmp_path, monkeypatch):
    """Each tile fails then, but the message tells why, and the status is that of a run that was stopped."""

    def smaller():
        shutil.move(copied[0], elsewhere)
        with rasterio.open(elsewhere) as source:
            grey, profile, rpcs = source.read(), source.profile, source.rpcs
        with rasterio.open(copied[0], "w", **profile | {"height": 100}, rpcs=rpcs) as file:
            file.write(grey[:, :100])

    after_tiles(monkeypatch, 0, smaller)
    with pytest.raises(StoppedError, match=rf"{copied[0].name} was replaced .* Give the same command again when"):
        asked(copied, tmp_path / "out")
    assert names(tmp_path / "out") == ["events.jsonl"]


@pytest.mark.parametrize("change", ["replaced", "gone"])
def test_a_run_stops_when_an_image_changes_after_the_last_tile(copied, elsewhere, tmp_path, monkeypatch, change):
    check, out = TileRun.check, tmp_path / "out"

    def changing(self, *given):
        check(self, *given)
        rewrite(copied[1], elsewhere) if change == "replaced" else shutil.move(copied[1], elsewhere)

    monkeypatch.setattr(TileRun, "check", changing)
    said = "was replaced or written to" if change == "replaced" else "disappeared"
    with pytest.raises(StoppedError, match=rf"{copied[1].name} {said} .* 4 finished tiles are kept"):
        asked(copied, out)
    assert names(out) == ["events.jsonl", FOLDER]
    monkeypatch.undo()
    shutil.move(elsewhere, copied[1])
    after_tiles(monkeypatch, 0, lambda: pytest.fail("a tile is matched again"))
    asked(copied, out)
    assert (out / "dsm.tif").exists()


def test_a_run_writes_nothing_when_an_image_changes_during_the_search_for_tie_points(copied, tmp_path, monkeypatch):
    settle = zlocus.pipeline.dsm.set_up_run
    monkeypatch.setattr(zlocus.pipeline.dsm, "set_up_run", lambda *given: [os.utime(copied[2]), settle(*given)][1])
    with pytest.raises(StoppedError, match=rf"{copied[2].name} was replaced or written to"):
        asked(copied, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_image_that_changes_while_others_are_opened_is_noticed(copied, elsewhere, tmp_path, monkeypatch):
    """Also where a scene file names it: what it was is known from before its first byte was read."""
    views = [{"name": path.stem, "image": str(path), "camera": {"kind": "rpc"}} for path in copied]
    scene = tmp_path / "scene.yaml"
    scene.write_text(yaml.safe_dump({"schema": 1, "views": views}))
    opened = zlocus.pipeline.open_run.open_inputs

    def opening(*given):
        found = opened(*given)
        rewrite(copied[0], elsewhere)
        return found

    monkeypatch.setattr(zlocus.pipeline.open_run, "open_inputs", opening)
    for inputs in ((scene,), copied):
        with pytest.raises(StoppedError, match=rf"{copied[0].name} was replaced"):
            asked(inputs, tmp_path / "out")
        shutil.move(elsewhere, copied[0])


def test_the_checksum_is_that_of_the_image_that_was_matched(copied, elsewhere, tmp_path, monkeypatch):
    """Where it changes after that, the surface is right, and the page shows no curves of another image."""
    digest, write = hashlib.sha256(copied[0].read_bytes()).hexdigest(), zlocus.pipeline.dsm.write_points

    def writing(*given):
        rewrite(copied[0], elsewhere)
        write(*given)

    said = io.StringIO()
    monkeypatch.setattr("rendered_scenes.progress_for", lambda _: progress_for(said))
    monkeypatch.setattr(zlocus.pipeline.dsm, "write_points", writing)
    out = asked(copied, tmp_path / "out", report=True, bounds=PART).out
    assert hashlib.sha256(copied[0].read_bytes()).hexdigest() != digest
    (listed,) = (
        each for each in json.loads((out / "run.json").read_text())["inputs"] if each["path"] == str(copied[0])
    )
    assert listed["sha256"] == digest
    assert (out / "report.html").exists()
    assert not (out / CURVES).exists()
    assert f"{copied[0]} has changed since the surface was matched" in said.getvalue()


def test_a_run_stops_when_the_dem_changes(copied, tmp_path, monkeypatch):
    dem = asked(copied, tmp_path / "dem", bounds=PART).out / "dsm.tif"
    after_tiles(monkeypatch, 0, lambda: os.utime(dem))
    with pytest.raises(StoppedError, match=r"dsm\.tif was replaced or written to"):
        asked(copied, tmp_path / "out", bounds=PART, heights=None, dem=dem)


@pytest.mark.parametrize("stage", ["cloud", "orient", "ties", "rank"])
def test_other_commands_write_nothing_when_an_input_changes(copied, tmp_path, monkeypatch, stage):
    out, progress = tmp_path / "out", progress_for(io.StringIO())
    run_stage = {
        "cloud": lambda: run_cloud(CloudRequest(copied, out, heights=HEIGHTS), RunConfig(), progress),
        "orient": lambda: run_orient(OrientRequest(copied, out), RunConfig(), progress),
        "ties": lambda: run_orient(OrientRequest(copied, out, cameras=False), RunConfig(), progress),
        "rank": lambda: run_rank(RankRequest(copied, out, resolution=4.0), RunConfig(), progress),
    }[stage]
    orient = zlocus.pipeline.setup.orient
    monkeypatch.setattr(zlocus.pipeline.setup, "orient", lambda *given: [os.utime(copied[0]), orient(*given)][1])
    with pytest.raises(StoppedError, match=rf"{copied[0].name} was replaced or written to .* no result is written"):
        run_stage()
    assert not out.exists()


def test_changed_files_are_listed_with_missing_ones_last(tmp_path):
    paths = [tmp_path / name for name in "abcd"]
    for path in paths:
        path.write_text(path.name)
    inputs = InputFiles.of([*paths, Path("/vsicurl/https://a.b/c.tif"), tmp_path / "never"])
    assert inputs.changed() == []
    inputs.check()
    paths[0].unlink()
    paths[1].write_text("longer")
    os.utime(paths[2], ns=(1, 1))
    assert inputs.changed() == [str(paths[1]), str(paths[2]), str(paths[0])]
    with pytest.raises(StoppedError, match=r"b was replaced or written to .*, and so did 2 more inputs"):
        inputs.check()
    with pytest.raises(StoppedError, match=r"and so did 1 more input;"):
        inputs.check(may_miss=True)
    # What was known before counts.
    assert InputFiles.of(paths, earlier_inputs=inputs).changed() == inputs.changed()


def test_files_that_a_virtual_raster_lists_are_inputs(copied, tmp_path):
    """And masks beside an image; they are content that is matched."""
    virtual = []
    for path in copied[:2]:
        with rasterio.open(path) as source:
            rows, cols, tags = *source.shape, source.tags(ns="RPC")
        items = "".join(f'<MDI key="{key}">{value}</MDI>' for key, value in tags.items())
        virtual.append(tmp_path / f"{path.stem}.vrt")
        virtual[-1].write_text(
            f'<VRTDataset rasterXSize="{cols}" rasterYSize="{rows}"><Metadata domain="RPC">{items}</Metadata>'
            '<VRTRasterBand dataType="UInt16" band="1"><SimpleSource><SourceFilename relativeToVRT="1">'
            f"images/{path.name}</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
        )
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(copied[2], "r+") as file:
        file.write_mask(file.read(1) > 0)
    scene = open_scene([*virtual, copied[2]])
    listed = [path for view in scene.views for path in view.files]
    assert listed == [virtual[0], copied[0], virtual[1], copied[1], copied[2], Path(f"{copied[2]}.msk")]
