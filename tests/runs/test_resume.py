"""Runs that are killed, interrupted or lose memory or inputs: finished tiles are kept and the resumed run has the same
bytes.
"""

from __future__ import annotations

import io
import json
import os
import pkgutil
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest

import zlocus.matching.tile
import zlocus.pipeline.image_tiles
import zlocus.pipeline.tile_run
from interrupted_runs import (
    ENDING,
    RASTERS,
    STOPS_WITHIN_S,
    check_end,
    children_of,
    command,
    given_again,
    n_finished,
    same,
    started,
    wait_for_tiles,
    wait_until,
)
from rendered_scenes import CENTRE, HEIGHTS, N_SMALL_TILES, SMALL_TILES, read, run
from zlocus.core.errors import GeometryError, InputError, OutputError, StoppedError
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.progress import progress_for
from zlocus.core.resources import held_bytes
from zlocus.matching.quality import Quality
from zlocus.pipeline.execution.checkpoint import BEFORE, FOLDER
from zlocus.pipeline.execution.tasks import MAX_ATTEMPTS

# Number of signals at random moments; benchmarks/acceptance.py sends more.
SIGNALS = int(os.environ.get("ZLOCUS_SIGNALS", "2"))
SEED = 20261122
# Side of nine tiles of the area, cells: enough for a worker that takes the place of another one.
SIDE_OF_NINE = 64


@pytest.fixture(scope="module")
def straight(images, tmp_path_factory):
    """The surface of a run without interruption, in small tiles."""
    return run(images("sine"), tmp_path_factory.mktemp("straight") / "out", SMALL_TILES, workers=1, report=False).out


@pytest.fixture(scope="module")
def straight_in_nine(images, tmp_path_factory):
    """The same in nine tiles."""
    nine = RunConfig(pyramid=PyramidOptions(tile=SIDE_OF_NINE))
    return run(images("sine"), tmp_path_factory.mktemp("nine") / "out", nine, workers=1, report=False).out


def test_signals_at_random_moments(images, straight, tmp_path):
    """Signals of four kinds interrupt the command or all its processes at random moments; the next run resumes.

    If a run finishes before its signal, its folder is removed and the next run begins anew.
    """
    out, rng = tmp_path / "out", random.Random(SEED)
    for _ in range(SIGNALS):
        process = started(command(images("sine"), out, tmp_path, "--workers", "2"))
        before, wanted = n_finished(out), rng.choice([0, 0, 1, 2])
        number, is_to_all = rng.choice([*ENDING, signal.SIGKILL]), rng.random() < 0.5
        wait_for_tiles(out, before + wanted, process)
        time.sleep(rng.uniform(0.0, 1.0))
        children = children_of(process.pid)
        with suppress(ProcessLookupError):
            (os.killpg if is_to_all else os.kill)(process.pid, number)
        said = process.communicate(timeout=STOPS_WITHIN_S)[1]
        check_end(process.returncode, number, said)
        assert n_finished(out) >= before or (out / "run.json").exists()
        _, alive = psutil.wait_procs(children, STOPS_WITHIN_S)
        assert not [one for one in alive if one.status() != psutil.STATUS_ZOMBIE]
        if number != signal.SIGKILL:
            assert not hidden(out)
        if (out / "run.json").exists() and not (out / FOLDER).exists():
            assert same(out, straight)
            shutil.rmtree(out)
    last = subprocess.run(command(images("sine"), out, tmp_path), capture_output=True, text=True, check=False)
    assert last.returncode == 0, last.stderr
    assert same(out, straight)
    assert not (out / FOLDER).exists()
    assert not hidden(out)


def hidden(out):
    """Temporary files, whose names begin with a dot until they are complete."""
    return list(out.rglob(".*")) if out.exists() else []


# Signal, whether all processes of the command get it, and number of workers.
INTERRUPTS = [(signal.SIGINT, True, 2), (signal.SIGHUP, False, 1)]


@pytest.mark.parametrize(("number", "is_to_all", "workers"), INTERRUPTS)
def test_a_signal_stops_the_run_within_seconds_and_the_run_is_resumed(
    images, straight, tmp_path, number, is_to_all, workers
):
    out = tmp_path / "out"
    process = started(command(images("sine"), out, tmp_path, "--workers", str(workers)))
    wait_for_tiles(out, 2, process)
    children, start = children_of(process.pid), time.monotonic()
    (os.killpg if is_to_all else os.kill)(process.pid, number)
    _, stderr = process.communicate(timeout=STOPS_WITHIN_S)
    assert time.monotonic() - start < STOPS_WITHIN_S
    assert process.returncode == 128 + number
    check_end(process.returncode, number, stderr)
    _, alive = psutil.wait_procs(children, STOPS_WITHIN_S)
    assert not [one for one in alive if one.status() != psutil.STATUS_ZOMBIE]
    assert "finished and kept: the same command resumes from there" in stderr
    n = n_finished(out)
    said = given_again(command(images("sine"), out, tmp_path))
    assert f"{n} of " in said
    assert "tiles are there already" in said
    assert same(out, straight)
    events = events_of(out)
    assert [e["event"] for e in events if e["event"] != "tile"] == ["began", "interrupted", "began", "resumed", "ended"]
    assert len({e["tile"] for e in events if e["event"] == "tile"}) == sum(e["event"] == "tile" for e in events)


def test_a_worker_that_is_killed_costs_no_tile(images, straight_in_nine, tmp_path):
    """As by a system that is short of memory: another worker takes its place and makes its tile again."""
    out = tmp_path / "out"
    process = started(command(images("sine"), out, tmp_path, "--workers", "2", tile=SIDE_OF_NINE))
    killed = []

    def is_one_killed():
        for child in children_of(process.pid):
            with suppress(psutil.NoSuchProcess):
                if child.ppid() != process.pid and not killed and n_finished(out):
                    child.send_signal(signal.SIGKILL)
                    killed.append(child)
        return killed or process.poll() is not None

    wait_until(is_one_killed)
    _, stderr = process.communicate(timeout=12 * STOPS_WITHIN_S)
    assert killed
    assert process.returncode == 0, stderr
    assert same(out, straight_in_nine)
    workers = {event["worker"] for event in events_of(out) if event["event"].startswith("tile")}
    assert "worker 3" in workers
    assert all(event["again"] for event in events_of(out) if event["event"] == "tile failed")


# Function in which the run is stopped after the matching, number of the call, and files that are complete by then.
AFTERWARDS = {
    "zlocus.pipeline.tile_run.TileRun.assemble": (1, set()),
    # In the third of six rasters.
    "zlocus.io.rasters._check_written": (6, set()),
    "zlocus.pipeline.surface_products.write_observations": (1, {"dsm.tif", "ties.gpkg"}),
    "zlocus.pipeline.dsm.write_report_inputs": (1, {"dsm.tif", "observations.npz"}),
    "zlocus.pipeline.surface_products.link_all": (1, {"dsm.tif", "run.json", "hillshade.tif"}),
}


@pytest.mark.parametrize("step", AFTERWARDS)
def test_a_run_that_is_stopped_after_the_matching_keeps_its_tiles(images, straight, tmp_path, monkeypatch, step):
    """Each file is complete or missing, and the rasters of a surface are all there or all missing."""
    at, complete = AFTERWARDS[step]
    do, calls = pkgutil.resolve_name(step), []

    def stop(*given, **more):
        calls.append(given)
        if len(calls) == at:
            raise KeyboardInterrupt
        return do(*given, **more)

    said, out = io.StringIO(), tmp_path / "out"
    monkeypatch.setattr("rendered_scenes.progress_for", lambda _: progress_for(said))
    monkeypatch.setattr(step, stop)
    asked = {"workers": 1, "report": step.endswith("write_report_inputs")}
    with pytest.raises(KeyboardInterrupt):
        run(images("sine"), out, SMALL_TILES, **asked)
    assert "4 of 4 tiles are finished and kept: the same command resumes from there.\n" in said.getvalue()
    found = {path.name for path in out.iterdir() if path.is_file()}
    assert complete | {"events.jsonl"} <= found
    assert {f"{name}.tif" for name in RASTERS} <= found if complete else found == {"events.jsonl"}
    assert not hidden(out)
    monkeypatch.undo()
    run(images("sine"), out, SMALL_TILES, **asked)
    assert same(out, straight)


@pytest.mark.parametrize("option", ["--overwrite", "--no-resume"])
def test_a_command_that_starts_anew_says_how_to_resume(images, tmp_path, monkeypatch, option):
    def stop(*_, **__):
        raise KeyboardInterrupt

    said, out = io.StringIO(), tmp_path / "out"
    monkeypatch.setattr("rendered_scenes.progress_for", lambda _: progress_for(said))
    monkeypatch.setattr("zlocus.pipeline.tile_run.TileRun.assemble", stop)
    asked = {"overwrite": True} if option == "--overwrite" else {"resume": False}
    with pytest.raises(KeyboardInterrupt):
        run(images("sine"), out, SMALL_TILES, workers=1, report=False, **asked)
    assert f"finished and kept: the same command without {option} resumes from there." in said.getvalue()


def events_of(out):
    return [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]


def failing(monkeypatch, error, where=CENTRE):
    """Make the tile that contains a position fail."""
    match = zlocus.pipeline.tile_run.match_tile

    def fail(scene, core, *given):
        west, north = scene.transform(core, 0) * (0, 0)
        if west <= where[0] < west + core.cols * 0.5 and north - core.rows * 0.5 < where[1] <= north:
            raise error
        return match(scene, core, *given)

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", fail)


@pytest.mark.parametrize(
    ("error", "says", "attempts"),
    [
        (IndexError("index 7 is out of bounds"), "IndexError: index 7 is out of bounds (a fault of zlocus", 1),
        (MemoryError(), "it does not fit into memory", MAX_ATTEMPTS),
        (OSError(5, "Input/output error"), "Input/output error", MAX_ATTEMPTS),
    ],
)
def test_a_tile_that_fails_costs_no_other(images, straight, tmp_path, monkeypatch, error, says, attempts):
    out = tmp_path / "out"
    failing(monkeypatch, error)
    with pytest.raises(StoppedError, match="1 of 4 tiles failed: E 461958 to 462006 m, N 5246954 to 5247000 m") as stop:
        run(images("sine"), out, SMALL_TILES, workers=1, report=False)
    assert says in str(stop.value)
    assert stop.value.exit_status == 3
    assert not (out / "dsm.tif").exists()
    assert n_finished(out) == N_SMALL_TILES - 1
    # The surface without the failed tile.
    with pytest.raises(StoppedError, match=r"They are empty in the surface \(FAILED in quality\.tif\)"):
        run(images("sine"), out, SMALL_TILES, workers=1, report=False, partial=True)
    quality, whole = read(out / "quality.tif")[0], read(straight / "quality.tif")[0]
    lost = quality == int(Quality.FAILED)
    assert 1000 < lost.sum() <= SMALL_TILES.pyramid.tile**2 * 1.5
    np.testing.assert_array_equal(quality[~lost], whole[~lost])
    assert np.isnan(read(out / "dsm.tif")[0][lost]).all()
    failed = [
        e for e in map(json.loads, (out / "events.jsonl").read_text().splitlines()) if e["event"] == "tile failed"
    ]
    assert len(failed) == 2 * attempts
    # The surface with it, once it can be matched.
    monkeypatch.undo()
    run(images("sine"), out, SMALL_TILES, workers=1, report=False)
    assert same(out, straight)


def test_if_the_first_tile_cannot_be_matched_no_folder_is_left(images, tmp_path, monkeypatch):
    def fail(*_):
        raise GeometryError("too bent.")

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", fail)
    for partial in (False, True):
        with pytest.raises(GeometryError, match="too bent"):
            run(images("sine"), tmp_path / "out", SMALL_TILES, partial=partial)
    assert not list(tmp_path.iterdir())


def test_if_all_tiles_fail_the_log_says_why(images, tmp_path, monkeypatch):
    def fail(*_):
        raise IndexError("index 7 is out of bounds")

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", fail)
    with pytest.raises(StoppedError, match=r"4 of 4 tiles failed: .*; and 1 more\. Nothing was made\."):
        run(images("sine"), tmp_path / "out", SMALL_TILES, partial=True)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["events.jsonl"]
    assert all("in fail" in e["trace"] for e in events_of(tmp_path / "out") if e["event"] == "tile failed")


def test_a_resumed_run_does_not_search_tie_points_again(images, straight, tmp_path, monkeypatch):
    out = stopped(images, tmp_path, monkeypatch)

    def looked_for(*_):
        raise AssertionError("ties are looked for again")

    for name in ("find_ties", "refine_ties"):
        monkeypatch.setattr(f"zlocus.orientation.orientation.{name}", looked_for)
    run(images("sine"), out, SMALL_TILES, workers=1, report=False)
    assert same(out, straight)
    assert (out / "ties.gpkg").stat().st_size > 0
    assert not (out / FOLDER).exists()


def test_damaged_tie_points_are_searched_again(images, straight, tmp_path, monkeypatch):
    out = stopped(images, tmp_path, monkeypatch)
    (out / FOLDER / BEFORE).write_bytes(b"PK nothing")
    run(images("sine"), out, SMALL_TILES, workers=1, report=False)
    assert same(out, straight)


def test_image_space_resumes_with_the_tiles_of_its_images(images, tmp_path, monkeypatch):
    """Tiles that are kept and undamaged are not matched again."""
    asked = {"method": "gc3-sgm", "report": False, "workers": 1}
    match, matched, stops_at = zlocus.pipeline.tile_run.match_tile, [], None

    def until_stopped(scene, core, *rest, **given):
        matched.append((core.row, core.col))
        if len(matched) == stops_at:
            raise KeyboardInterrupt
        return match(scene, core, *rest, **given)

    said = io.StringIO()
    monkeypatch.setattr("zlocus.pipeline.tile_run.match_tile", until_stopped)
    monkeypatch.setattr("rendered_scenes.progress_for", lambda _: progress_for(said))
    straight, out = run(images("sine"), tmp_path / "straight", SMALL_TILES, **asked).out, tmp_path / "out"
    everything, stops_at = len(matched), len(matched) + 5
    with pytest.raises(KeyboardInterrupt):
        run(images("sine"), out, SMALL_TILES, **asked)
    assert re.search(r"\n4 of \d+ tiles of images are finished and kept", said.getvalue())
    kept = sorted((out / FOLDER).glob("image*.npz"))
    assert len(kept) == 4
    kept[1].write_bytes(kept[1].read_bytes()[:-1])
    before = len(matched)
    run(images("sine"), out, SMALL_TILES, **asked)
    assert len(matched) - before == everything - 3
    assert same(out, straight)
    assert not (out / FOLDER).exists()


def test_a_damaged_tile_is_made_again(images, straight, tmp_path, monkeypatch):
    out = stopped(images, tmp_path, monkeypatch)
    tiles = sorted((out / FOLDER).glob("*.npz"))
    content = bytearray(tiles[0].read_bytes())
    content[len(content) // 2] ^= 1
    tiles[0].write_bytes(content)
    tiles[1].write_bytes(tiles[1].read_bytes()[:-1])
    tiles[2].unlink()
    run(images("sine"), out, SMALL_TILES, report=False)
    assert same(out, straight)


def stopped(images, tmp_path, monkeypatch):
    """A run of which a tile is not there."""
    failing(monkeypatch, IndexError("planted"))
    with pytest.raises(StoppedError):
        run(images("sine"), tmp_path / "out", SMALL_TILES, report=False)
    monkeypatch.undo()
    return tmp_path / "out"


def test_what_was_changed_meanwhile_is_said(images, tmp_path, monkeypatch):
    scene = images("sine")
    copied = tuple(Path(shutil.copy(path, tmp_path)) for path in scene.inputs)
    failing(monkeypatch, IndexError("planted"))
    with pytest.raises(StoppedError):
        run(copied, tmp_path / "out", SMALL_TILES, report=False)
    monkeypatch.undo()
    n = n_finished(tmp_path / "out")
    with pytest.raises(OutputError, match=r"holds 3 finished tiles of another run: --heights was"):
        run(copied, tmp_path / "out", SMALL_TILES, heights=(20.0, 80.0))
    with pytest.raises(OutputError, match=r"the option pyramid\.tile was 80 there and is"):
        run(copied, tmp_path / "out")
    os.utime(copied[1])
    with pytest.raises(OutputError, match=rf"{copied[1].name} has changed since"):
        run(copied, tmp_path / "out", SMALL_TILES)
    assert n_finished(tmp_path / "out") == n
    # What changes no tile is no other run.
    run(copied, tmp_path / "out", SMALL_TILES, overwrite=True, products=("hillshade",), report=False)
    assert not (tmp_path / "out" / FOLDER).exists()


def test_an_image_that_disappears(images, tmp_path, monkeypatch):
    """After the first tile: all others need it, and are named; what is done is kept."""
    copied = tuple(Path(shutil.copy(path, tmp_path)) for path in images("sine").inputs)
    match, made = zlocus.pipeline.tile_run.match_tile, []

    def robbed(*given):
        made.append(given)
        if len(made) == 2:
            copied[0].rename(tmp_path / "elsewhere")
        return match(*given)

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", robbed)
    with pytest.raises(StoppedError, match=rf"3 of 4 tiles failed: .*There is no image .*{copied[0].name}"):
        run(copied, tmp_path / "out", SMALL_TILES, report=False)
    assert n_finished(tmp_path / "out") == 1
    (tmp_path / "elsewhere").rename(copied[0])
    run(copied, tmp_path / "out", SMALL_TILES, report=False)
    assert same(tmp_path / "out", run(copied, tmp_path / "straight", SMALL_TILES, report=False).out)


# When the folder of results is removed, by the call that notices it.
GOES = {
    "zlocus.pipeline.execution.checkpoint.write_atomically": (
        6,
        r"tiles has gone since the run began, with 3 finished tiles",
    ),
    "zlocus.io.rasters._check_written": (1, r"water\.tif cannot be written"),
    "zlocus.pipeline.surface_products.write_observations": (1, r"observations\.npz cannot be written: No such file"),
    "zlocus.pipeline.surface_products.write_derived": (1, r"run\.json cannot be written: No such file"),
    "zlocus.pipeline.surface_products.link_all": (1, r"There is no raster \S*dsm\.tif"),
}


@pytest.mark.parametrize("step", GOES)
def test_a_folder_of_results_that_goes(images, straight, tmp_path, monkeypatch, step):
    """The run ends in a sentence, which promises no tiles that have gone with it; the next one, which finds the same
    wherever the run was, makes everything."""
    at, says = GOES[step]
    do, calls, out = pkgutil.resolve_name(step), [], tmp_path / "out"

    def remove(*given, **more):
        calls.append(given)
        if len(calls) == at:
            shutil.rmtree(out)
        return do(*given, **more)

    monkeypatch.setattr(step, remove)
    with pytest.raises((StoppedError, OutputError, InputError), match=says) as stop:
        run(images("sine"), out, SMALL_TILES, workers=1, report=False)
    assert "kept" not in str(stop.value)
    assert not out.exists()
    monkeypatch.undo()
    if step.endswith("write_atomically"):
        assert same(run(images("sine"), out, SMALL_TILES, workers=1, report=False).out, straight)


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full or a small tmpfs")
def test_a_disk_that_fills(images, straight, tmp_path, monkeypatch):
    """After some tiles there is no room for the next: those are kept, and the run goes on when there is."""
    import zlocus.pipeline.execution.checkpoint as store

    write, written = store.write_atomically, []

    def until_full(path, content):
        if path.suffix == ".npz" and path.name != BEFORE:
            written.append(path)
            if len(written) > 2:
                with Path("/dev/full").open("wb", buffering=0) as full:
                    full.write(content)
        write(path, content)

    monkeypatch.setattr(store, "write_atomically", until_full)
    with pytest.raises(StoppedError, match=r"No space left on device\. The 2 finished tiles are kept; make room"):
        run(images("sine"), tmp_path / "out", SMALL_TILES, report=False)
    assert n_finished(tmp_path / "out") == 2
    monkeypatch.undo()
    run(images("sine"), tmp_path / "out", SMALL_TILES, report=False)
    assert same(tmp_path / "out", straight)


SMALL_DISK = """
mount -t tmpfs -o size={small} tmpfs {disk} || exit 99
{command}
echo "exit status $?"
ls {disk}/out/tiles | grep -c npz
mount -o remount,size=64m {disk} || exit 99
{command}
echo "exit status $?"
cp {disk}/out/*.tif {kept}
ls -A {disk}/out {disk}
"""


@pytest.mark.parametrize(("small", "said"), [("450k", "tiles cannot be written"), ("900k", "cannot be written")])
def test_a_small_disk_that_fills_and_grows(images, straight, tmp_path, small, said):
    """A file system in memory, first too small for the tiles, or for the rasters beside them."""
    disk, kept = tmp_path / "disk", tmp_path / "kept"
    disk.mkdir()
    kept.mkdir()
    words = shlex.join(command(images("sine"), disk / "out", tmp_path, "--workers", "1"))
    script = SMALL_DISK.format(small=small, disk=disk, command=words, kept=kept)
    alone = shutil.which("unshare")
    if alone is None:
        pytest.skip("needs unshare, to mount a file system of its own")
    done = subprocess.run([alone, "--map-root-user", "--mount", "sh", "-c", script], capture_output=True, text=True,
                          check=False)  # fmt: skip
    if done.returncode == 99 or done.stderr.startswith("unshare:"):
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()[-200:]}")
    assert re.findall(r"exit status (\d+)", done.stdout) == ["3", "0"], done.stderr
    assert said in done.stderr
    assert "No space left on device" in done.stderr
    assert int(done.stdout.split("exit status 3\n")[1].split()[0]) > 2
    assert "are there already" in done.stderr
    assert same(kept, straight)
    assert not [
        name for name in done.stdout.split("exit status 0")[1].split() if name.startswith(".") or name == "tiles"
    ]


def test_a_plain_script_may_use_processes(images, straight, tmp_path):
    """Without a guard around what it does: workers do not run it again."""
    script = tmp_path / "mine.py"
    names = [str(path) for path in images("sine").inputs]
    script.write_text(
        f"""
import zlocus
from zlocus.core.options import PyramidOptions, RunConfig
print("once")
zlocus.match(*{names}, out={str(tmp_path / "out")!r}, workers=2, crs="EPSG:32632", resolution=0.5,
             heights={HEIGHTS}, report=False, config=RunConfig(pyramid=PyramidOptions(tile=80)))
"""
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "once\n"
    assert same(tmp_path / "out", straight)
    assert {event["worker"] for event in events_of(tmp_path / "out") if event["event"] == "tile"} >= {"worker 1"}


@pytest.mark.parametrize("asked", [{"workers": 2}, {"workers": 3, "memory_gb": 1.0}, {"workers": None}])
def test_the_same_bytes_however_many_work(images, straight, tmp_path, asked):
    """With a limit of memory above what the process of the tests holds already, which is no matter of the run."""
    if "memory_gb" in asked:
        asked = asked | {"memory_gb": asked["memory_gb"] + held_bytes() / 1e9}
    assert same(run(images("sine"), tmp_path / "out", SMALL_TILES, report=False, **asked).out, straight)


def test_what_a_killed_run_had_begun_goes(images, straight, tmp_path):
    """And nothing else: hidden files of others stay."""
    out = tmp_path / "out"
    out.mkdir()
    begun = [
        ".ties.29684.part.gpkg",
        ".dsm.tif.7.part.tif",
        ".dsm.tif.7.cog.tif",
        ".ortho.tif.7.mask",
        ".run.json.9.part",
    ]
    for name in (*begun, ".mine", ".mine.tif"):
        (out / name).write_text("x")
    run(images("sine"), out, SMALL_TILES, report=False)
    assert sorted(path.name for path in out.iterdir() if path.name.startswith(".")) == [".mine", ".mine.tif"]
    assert same(out, straight)
