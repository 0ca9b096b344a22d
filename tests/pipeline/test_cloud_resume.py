"""`zlocus cloud --resume`: a killed run is completed with the same points, and a finished one is taken as it is."""

from __future__ import annotations

import gc
import io
import json
import shutil
import signal
import tracemalloc
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from interrupted_runs import cloud_command, given_again, n_finished, started, wait_for_tiles
from rendered_scenes import HEIGHTS, LOOKS, PART, SIZE_PX
from zlocus.core.errors import OutputError, StoppedError
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.progress import LineProgress
from zlocus.core.requests import CloudRequest
from zlocus.pipeline import cloud, image_tiles
from zlocus.pipeline.execution import plan
from zlocus.pipeline.execution.checkpoint import FOLDER
from zlocus.pipeline.pixel_products import PointWriter
from zlocus.pipeline.required_space import CLOUD_PIXEL_BYTES

TILE = 64
CONFIG = RunConfig(pyramid=PyramidOptions(tile=TILE))
N_TILES = 12


def made(images, out, config=CONFIG, **asked):
    """A cloud in small tiles, and what was said."""
    said = io.StringIO()
    request = CloudRequest(images("sine").inputs, out, **{"crs": "EPSG:32632", "heights": HEIGHTS} | asked)
    return cloud.run_cloud(request, config, LineProgress(said)), said.getvalue()


@pytest.fixture(scope="module")
def straight(images, tmp_path_factory):
    """The cloud of a run without interruption."""
    return made(images, tmp_path_factory.mktemp("straight") / "out")[0].out


def assert_same(out: Path, straight: Path) -> None:
    """The products are the same: points in their order, and the bytes of all other files but records."""
    one, other = (laspy.read(folder / "cloud.laz") for folder in (out, straight))
    np.testing.assert_array_equal(one.points.array, other.points.array)
    for name in ("cloud.ply", *(f"{view}_{what}.tif" for view in LOOKS for what in ("height", "quality"))):
        assert (out / name).read_bytes() == (straight / name).read_bytes(), name
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in straight.iterdir())


def test_a_killed_run_is_resumed_with_the_same_points(images, straight, tmp_path):
    out = tmp_path / "out"
    words = cloud_command(images("sine"), out, tmp_path, tile=TILE)
    process = started(words)
    wait_for_tiles(out, 7, process)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=10)
    n = n_finished(out)
    assert 7 <= n < N_TILES
    assert not (out / "cloud.laz").exists()
    # Where the run had begun to write points, an incomplete file is left.
    (out / ".cloud.laz.123456.part").touch()
    said = given_again(words)
    assert f"{n} of {N_TILES} tiles of images are there already." in said
    assert "The tie points of the interrupted run are used again." in said
    assert_same(out, straight)


def stop_after(monkeypatch, n, error):
    """Fail when so many tiles were matched."""
    whole, calls = image_tiles.matched_tile, []

    def stopping(*given):
        calls.append(given)
        if len(calls) > n:
            raise error
        return whole(*given)

    monkeypatch.setattr(image_tiles, "matched_tile", stopping)


def test_an_interrupt_says_what_is_kept(images, straight, tmp_path, monkeypatch):
    out, said = tmp_path / "out", io.StringIO()
    stop_after(monkeypatch, 5, KeyboardInterrupt)
    request = CloudRequest(images("sine").inputs, out, crs="EPSG:32632", heights=HEIGHTS)
    with pytest.raises(KeyboardInterrupt):
        cloud.run_cloud(request, CONFIG, LineProgress(said))
    assert "5 of 12 tiles of images are finished and kept: the same command resumes from there.\n" in said.getvalue()
    assert [path.name for path in out.iterdir()] == [FOLDER]
    monkeypatch.undo()
    stop_after(monkeypatch, N_TILES - 5, ZeroDivisionError)  # no tile is matched again
    made(images, out)
    assert_same(out, straight)


def interrupted(images, out, monkeypatch):
    """The folder of a run that was interrupted after five tiles."""
    stop_after(monkeypatch, 5, KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        made(images, out)
    monkeypatch.undo()
    return out


def test_a_resumed_run_has_the_same_settings(images, tmp_path, monkeypatch):
    out = interrupted(images, tmp_path / "out", monkeypatch)
    with pytest.raises(OutputError, match=r"holds 5 finished tiles of another run: --bounds was not given there"):
        made(images, out, bounds=PART)
    other = replace(CONFIG, pyramid=replace(CONFIG.pyramid, halo=8))
    with pytest.raises(OutputError, match=r"the option pyramid\.halo was"):
        made(images, out, other)
    # How the work is done changes no point.
    _, said = made(images, out, workers=2, memory_gb=4.0)
    assert "5 of 12 tiles of images are there already." in said


def test_no_resume_starts_anew(images, tmp_path, monkeypatch):
    out = interrupted(images, tmp_path / "out", monkeypatch)
    assert "there already" not in made(images, out, resume=False)[1]


def test_points_that_cannot_be_written_leave_the_tiles(images, straight, tmp_path, monkeypatch):
    out = tmp_path / "out"

    def full(*_):
        raise OutputError("cloud.laz cannot be written: no space left on device. Check the folder and the space left.")

    monkeypatch.setattr(PointWriter, "write", full)
    with pytest.raises(StoppedError, match=r"no space left .* finished tiles are kept: the same command resumes"):
        made(images, out)
    assert [path.name for path in out.iterdir()] == [FOLDER]
    monkeypatch.undo()
    made(images, out)
    assert_same(out, straight)


def test_the_same_command_after_success_makes_nothing(images, straight, tmp_path):
    out = Path(shutil.copytree(straight, tmp_path / "out"))
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    again, _ = made(images, out)
    record = json.loads((straight / "run.json").read_text())
    assert (again.was_finished, again.n_points) == (True, record["points"])
    assert again.coverage == pytest.approx(record["coverage"], abs=1e-6)
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == before
    with pytest.raises(OutputError, match="--no-resume asks not to take"):
        made(images, out, resume=False)
    with pytest.raises(OutputError, match=r"holds another run: --bounds was not given there"):
        made(images, out, bounds=PART)
    with (out / "nadir_height.tif").open("ab") as file:
        file.write(b"more")
    with pytest.raises(OutputError, match=r"nadir_height\.tif is not what the run wrote"):
        made(images, out)
    (out / "nadir_height.tif").unlink()
    _, said = made(images, out)
    assert "lacks nadir_height.tif: it is made again" in said
    assert_same(out, straight)


def test_another_cloud_replaces_all_maps(images, straight, tmp_path):
    out = Path(shutil.copytree(straight, tmp_path / "out"))
    made(images, out, references=("fore",), overwrite=True)
    assert sorted(path.name for path in out.glob("*.tif")) == ["fore_height.tif", "fore_quality.tif"]
    assert not list(out.glob("nadir*"))


def test_points_are_written_while_others_are_matched(images, tmp_path, monkeypatch):
    """When the last tile is matched, the points of the first strips of ground are in the files."""
    written, at_tile, write, match = [0], [], PointWriter.write, image_tiles.matched_tile

    def counting(self, matched_pixels, window):
        write(self, matched_pixels, window)
        written[0] += 1

    def noting(*given):
        (part,) = (tmp_path / "out").glob(".cloud.ply*.part") if written[0] else (None,)
        at_tile.append((written[0], 0 if part is None else part.stat().st_size))
        return match(*given)

    monkeypatch.setattr(PointWriter, "write", counting)
    monkeypatch.setattr(image_tiles, "matched_tile", noting)
    monkeypatch.setattr(plan, "core_size", lambda *_: (32, 32))
    made(images, tmp_path / "out")
    assert len(at_tile) == written[0] == 75
    tiles, n_bytes = at_tile[-1]
    assert tiles >= 75 / 3
    assert n_bytes > 0.25 * (tmp_path / "out" / "cloud.ply").stat().st_size


def test_memory_does_not_grow_with_the_number_of_tiles(images, tmp_path):
    """By Python's own count of memory, to which mapped files do not belong: the tiles of one image, and of three."""
    made(images, tmp_path / "first", references=("nadir",), partial=True)
    peaks = []
    for name, references in (("one", ("nadir",)), ("three", ())):
        gc.collect()
        tracemalloc.start()
        made(images, tmp_path / name, references=references, partial=True)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    arrays_bytes = 2 * SIZE_PX**2 * CLOUD_PIXEL_BYTES
    # Held arrays would count as a whole; the records of two more images take a third of that here.
    assert peaks[1] - peaks[0] < 0.5 * arrays_bytes
