"""A surface made by independent processes: the same files as one run, whatever happens to them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import rasterio
from typer.testing import CliRunner

import zlocus.pipeline.array_jobs
import zlocus.pipeline.tile_run
from inspected import opened
from interrupted_runs import command, same, started, wait_until
from rendered_scenes import SMALL_TILES, read, run
from zlocus.cli.app import app
from zlocus.core.errors import OutputError
from zlocus.inspector.inspection import Inspection
from zlocus.io.run_record import versions_record
from zlocus.matching.quality import Quality
from zlocus.pipeline.array_jobs import matching_of_tasks
from zlocus.pipeline.array_plan import PLAN, VALUES, stored_plan
from zlocus.pipeline.execution.checkpoint import FOLDER
from zlocus.pipeline.finished_record import checksum

# Files that say when they were made, or how long it took.
WITH_TIMES = {"run.json", "item.json", "metadata.xml", "report.html", "events.jsonl", "finished.json"}
N_TASKS = 3


@pytest.fixture
def zl():
    """Run the command line in this process."""
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def straight(images, tmp_path_factory):
    """The surface of one run, with all products and the report."""
    return run(images("sine"), tmp_path_factory.mktemp("straight") / "out", SMALL_TILES, workers=1, report=True).out


@pytest.fixture(scope="module")
def made_plan(images, tmp_path_factory):
    """A folder with a plan of the same surface in three tasks, of which none has begun."""
    folder = tmp_path_factory.mktemp("plan")
    done = CliRunner().invoke(app, asked(images, folder / "out", folder))
    assert done.exit_code == 0, done.output
    return folder / "out"


@pytest.fixture
def out(made_plan, tmp_path):
    """A copy of it, which may be changed."""
    return Path(shutil.copytree(made_plan, tmp_path / "out"))


def asked(images, out, folder, *more, inputs=None):
    """Words of `zlocus tiles plan` for the surface of `straight`."""
    dsm = command(images("sine"), out, folder)
    options = dsm[dsm.index("--crs") :]
    options.remove("--no-report")
    return ["tiles", "plan", str(out), *map(str, inputs or images("sine").inputs), "--tasks", "3", *options, *more]


def sentence_of(result, status):
    """The one sentence with which a command ends."""
    assert result.exit_code == status, result.output
    assert "Traceback" not in result.output
    return " ".join(result.stderr.splitlines()[-1].split())


def all_run(zl, out):
    for number in (3, 1, 2):
        done = zl("tiles", "run", out, number)
        assert done.exit_code == 0, done.output
        assert f"task {number} is finished, " in done.stdout


def check_same_files(out, straight):
    """All files are there, and those that do not tell times have the same bytes; of layers of points the same rows."""
    names = {path.name for path in straight.iterdir()}
    assert {path.name for path in out.iterdir()} == names
    assert len(names - WITH_TIMES) > 8
    for name in names - WITH_TIMES:
        assert checksum(out / name) == checksum(straight / name), name


def test_tasks_in_any_order_make_the_files_of_one_run(zl, images, straight, out, tmp_path):
    all_run(zl, out)
    done = zl("tiles", "assemble", out)
    assert done.exit_code == 0, done.output
    assert "of the cells seen by two images or more have a height" in done.stdout
    check_same_files(out, straight)
    record, once = (json.loads((folder / "run.json").read_text()) for folder in (out, straight))
    assert record["tasks"] == N_TASKS
    assert set(record) - {"tasks"} == set(once)
    assert [stage["name"] for stage in record["stages"]] == [stage["name"] for stage in once["stages"]]
    assert record["orientation"] == once["orientation"]
    # The same command of one run finds it finished, and so do those of tasks.
    words = command(images("sine"), out, tmp_path)
    again = zl(*words[words.index("dsm") :])
    assert again.exit_code == 0
    assert "already finished" in again.stdout
    for words, says in (
        (("plan", out), "already finished, assembled from 3 tasks"),
        (("run", out, 2), "the surface is finished already"),
        (("assemble", out), "already finished"),
    ):
        again = zl("tiles", *words)
        assert again.exit_code == 0, again.output
        assert says in again.stdout
    assert "4 is none of them" in sentence_of(zl("tiles", "run", out, 4), 2)


def test_report_products_and_inspector_take_the_assembled_surface(zl, out):
    all_run(zl, out)
    assert zl("tiles", "assemble", out).exit_code == 0
    assert zl("report", out).exit_code == 0
    assert zl("products", out, "--products", "contours").exit_code == 0
    with Inspection(out) as inspection:
        state = opened(inspection).state()
    assert not [part for part in state.values() if isinstance(part, dict) and part.get("is") == "failed"]
    names = {line["event"] for line in map(json.loads, (out / "events.jsonl").read_text().splitlines())}
    assert names == {"began", "tile", "ended"}


def test_a_plan_says_what_there_is_and_what_is_left(zl, out):
    said = zl("tiles", "plan", out).stdout
    assert "4 tiles in 3 tasks, numbered from 1 to 3, each of at most 2 tiles. A task needs" in said
    assert "GB of memory" in said
    assert "Done: 0 of 3 tasks, 0 of 4 tiles." in said
    assert "Left: tasks 1-3." in said
    assert zl("tiles", "run", out, 2).exit_code == 0
    again = zl("tiles", "run", out, 2)
    assert again.exit_code == 0
    assert "task 2 is finished already" in again.stdout
    said = zl("tiles", "plan", out).stdout
    assert "Done: 1 of 3 tasks, 1 of 4 tiles." in said
    assert "Left: tasks 1,3." in said
    all_but = zl("tiles", "run", out, 1), zl("tiles", "run", out, 3)
    assert [done.exit_code for done in all_but] == [0, 0]
    assert "Left: nothing but the assembly" in zl("tiles", "plan", out).stdout


def test_the_number_of_tasks_is_that_of_the_tiles_by_default(zl, images, tmp_path):
    words = asked(images, tmp_path / "out", tmp_path)
    del words[words.index("--tasks") : words.index("--tasks") + 2]
    assert "4 tiles in 4 tasks" in zl(*words).stdout
    out = tmp_path / "more"
    words[words.index(str(tmp_path / "out"))] = str(out)
    more = zl(*words, "--tasks", 9)
    assert (
        "4 tiles in 9 tasks, numbered from 1 to 9, each of at most 1 tile; only tasks 3,5,7,9 have any." in more.stdout
    )
    left = stored_plan(out).left(())
    assert len(left) == 4
    for number in range(1, 10):
        done = zl("tiles", "run", out, number)
        assert done.exit_code == 0
        assert ("has no tile" in done.stdout) == (number not in left)
    assert zl("tiles", "assemble", out).exit_code == 0
    assert "--tasks 0 is too few" in sentence_of(zl(*words, "--tasks", 0), 2)


def test_the_same_plan_again_changes_nothing(zl, images, out, tmp_path):
    assert zl("tiles", "run", out, 1).exit_code == 0
    before = (out / FOLDER / PLAN).read_bytes(), (out / FOLDER / VALUES).read_bytes()
    again = zl(*asked(images, out, tmp_path))
    assert again.exit_code == 0, again.output
    assert "Done: 1 of 3 tasks" in again.stdout
    assert ((out / FOLDER / PLAN).read_bytes(), (out / FOLDER / VALUES).read_bytes()) == before
    other = asked(images, out, tmp_path, "--tasks", "2")
    assert "is planned in 3 tasks already" in sentence_of(zl(*other), 2)
    another = asked(images, out, tmp_path, "--fill", "interpolate")
    assert "holds 1 finished tile of another run: --fill was none there" in sentence_of(zl(*another), 2)
    anew = zl(*asked(images, out, tmp_path, "--fill", "interpolate", "--overwrite"))
    assert "Done: 0 of 3 tasks" in anew.stdout


def test_tasks_find_no_tie_points(zl, out, monkeypatch):
    def looked_for(*_):
        raise AssertionError("ties are looked for again")

    for name in ("find_ties", "refine_ties"):
        monkeypatch.setattr(f"zlocus.orientation.orientation.{name}", looked_for)
    all_run(zl, out)
    assert zl("tiles", "assemble", out).exit_code == 0


def test_assembling_too_early_says_which_tasks_are_left_and_writes_nothing(zl, straight, out):
    assert zl("tiles", "run", out, 2).exit_code == 0
    before = sorted(path.name for path in out.rglob("*"))
    said = sentence_of(zl("tiles", "assemble", out), 3)
    assert "2 of 3 tasks are not finished (1,3)" in said
    assert "nothing was written" in said
    assert sorted(path.name for path in out.rglob("*")) == before
    # An incomplete surface is made on request, and completed later.
    said = sentence_of(zl("tiles", "assemble", out, "--partial"), 3)
    assert "3 of 4 tiles are empty in the surface" in said
    assert "1,3" in said
    lost = read(out / "quality.tif")[0] == int(Quality.FAILED)
    assert 0.3 < lost.mean() < 0.9
    assert [zl("tiles", "run", out, number).exit_code for number in (1, 3)] == [0, 0]
    assert zl("tiles", "assemble", out).exit_code == 0
    check_same_files(out, straight)


def test_without_any_tile_nothing_is_assembled(zl, out):
    said = sentence_of(zl("tiles", "assemble", out, "--partial"), 3)
    assert "3 of 3 tasks are not finished (1-3)" in said
    assert [path.name for path in out.iterdir()] == [FOLDER]
    assert stored_plan(out) is not None


def test_a_damaged_tile_is_made_again(zl, straight, out):
    all_run(zl, out)
    (name,) = stored_plan(out).names_of(1)
    (out / FOLDER / f"{name}.npz").write_bytes(b"PK nothing")
    assert "(1)" in sentence_of(zl("tiles", "assemble", out), 3)
    assert not (out / "dsm.tif").exists()
    assert "1 of its 1 tile made" in zl("tiles", "run", out, 1).stdout
    assert zl("tiles", "assemble", out).exit_code == 0
    check_same_files(out, straight)


def test_tasks_that_are_killed_at_any_moment_are_given_again(straight, out):
    """A process is killed once it has begun to match, and another one later."""
    words = [sys.executable, "-m", "zlocus", "tiles", "run", str(out), "3"]
    for wait_s in (0.0, 0.4):
        process = started(words)
        logs = set(out.glob(f"{FOLDER}/events.3.*"))
        wait_until(lambda: process.poll() is not None or set(out.glob(f"{FOLDER}/events.3.*")) - logs)  # noqa: B023
        time.sleep(wait_s)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    for number in (1, 2, 3):
        done = subprocess.run([*words[:-1], str(number)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    done = subprocess.run([*words[:-3], "assemble", str(out)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    check_same_files(out, straight)


def test_two_processes_with_the_same_task_do_no_harm(straight, out):
    words = [sys.executable, "-m", "zlocus", "tiles"]
    numbers = (3, 3, 1, 2, 1)
    both = [started([*words, "run", str(out), str(number)]) for number in numbers]
    said = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0] * len(numbers), said
    done = subprocess.run([*words, "assemble", str(out)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    check_same_files(out, straight)


def test_a_task_is_interrupted_as_a_run_is(out):
    process = started([sys.executable, "-m", "zlocus", "tiles", "run", str(out), "3"])
    wait_until(lambda: process.poll() is not None or list(out.glob(f"{FOLDER}/events.3.*")))
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=10)[1]
    assert process.returncode in (0, 143), said
    assert process.returncode == 0 or said.endswith("zlocus: Ended by SIGTERM.\n")
    assert not list(out.glob(f"{FOLDER}/.*.part"))
    assert stored_plan(out) is not None


def test_relative_paths_are_those_of_the_plan(zl, images, straight, tmp_path, monkeypatch):
    for path in images("sine").inputs:
        shutil.copy2(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    names = [Path(path.name) for path in images("sine").inputs]
    done = zl(*asked(images, Path("out"), tmp_path, inputs=names))
    assert done.exit_code == 0, done.output
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    all_run(zl, Path("../out"))
    done = zl("tiles", "assemble", Path("../out"))
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("../out: ")
    assert same(tmp_path / "out", straight)


@pytest.fixture
def own(zl, images, tmp_path):
    """A plan of images that may be changed: the folder of the result."""
    inputs = [Path(shutil.copy2(path, tmp_path)) for path in images("sine").inputs]
    done = zl(*asked(images, tmp_path / "out", tmp_path, inputs=inputs))
    assert done.exit_code == 0, done.output
    return tmp_path / "out"


def changed(path):
    """Change the last byte of a file."""
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


def test_an_input_that_has_changed_is_refused(zl, own):
    image = own.parent / "fore.tif"
    state = image.stat()
    os.utime(image)
    assert zl("tiles", "run", own, 1).exit_code == 0, "the same content with another time"
    changed(image)
    for words in (("run", own, 2), ("assemble", own, "--partial")):
        said = sentence_of(zl("tiles", *words), 2)
        assert f"The input {image} has changed since {own} was planned" in said
        assert "Put the file back" in said
    changed(image)
    assert [zl("tiles", "run", own, number).exit_code for number in (2, 3)] == [0, 0]
    # Even where size and time are those of before.
    changed(image)
    os.utime(image, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert "has changed since" in sentence_of(zl("tiles", "assemble", own), 2)
    assert [path.name for path in own.iterdir() if path.name != "events.jsonl"] == [FOLDER]
    image.unlink()
    assert "is missing on this machine" in sentence_of(zl("tiles", "assemble", own), 2)


def test_an_input_that_changes_during_a_task_stops_it(zl, own, monkeypatch):
    match, image = zlocus.pipeline.tile_run.match_tile, own.parent / "aft.tif"

    def change(*given):
        result = match(*given)
        os.utime(image)
        return result

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", change)
    said = sentence_of(zl("tiles", "run", own, 1), 3)
    assert f"The input {image} was replaced, written to or removed while task 1" in said
    assert not stored_plan(own).checkpoint().finished


def test_a_tile_that_fails_costs_no_other(zl, straight, out, monkeypatch):
    match, calls = zlocus.pipeline.tile_run.match_tile, []

    def fail(*given):
        calls.append(given)
        if len(calls) == 1:
            raise IndexError("index 7 is out of bounds")
        return match(*given)

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", fail)
    said = sentence_of(zl("tiles", "run", out, 3), 3)
    assert said.startswith("zlocus: Task 3: 1 of 2 tiles failed: E ")
    assert "IndexError: index 7 is out of bounds" in said
    assert "give the same command again" in said
    monkeypatch.undo()
    assert "1 of its 2 tiles made. 1 was there already." in zl("tiles", "run", out, 3).stdout
    assert [zl("tiles", "run", out, number).exit_code for number in (1, 2)] == [0, 0]
    assert zl("tiles", "assemble", out).exit_code == 0
    check_same_files(out, straight)


def test_a_task_may_have_workers(zl, straight, out):
    done = [zl("tiles", "run", out, number, "--workers", 2) for number in (3, 1, 2)]
    assert [each.exit_code for each in done] == [0, 0, 0], done[0].output
    assert "2 at a time in processes of their own" in done[0].stderr
    assert zl("tiles", "assemble", out).exit_code == 0
    assert same(out, straight)


def test_a_task_needs_a_worker(zl, out):
    assert "--workers 0 is too few" in sentence_of(zl("tiles", "run", out, 1, "--workers", 0), 2)


@pytest.mark.parametrize("number", [0, 4, -1])
def test_a_number_without_a_task_is_refused(zl, out, number):
    said = sentence_of(zl("tiles", "run", out, "--", number), 2)
    assert f"is planned in 3 tasks, numbered from 1 to 3, and {number} is none of them" in said


def test_folders_without_a_plan_are_refused(zl, straight, tmp_path):
    (tmp_path / "empty").mkdir()
    for words in (("run", 1), ("assemble",), ("plan",)):
        verb, *more = words
        assert "there is no such folder" in sentence_of(zl("tiles", verb, tmp_path / "gone", *more), 2)
        assert "holds no plan of tasks" in sentence_of(zl("tiles", verb, tmp_path / "empty", *more), 2)
        assert "holds another run (run.json, dsm.tif)" in sentence_of(zl("tiles", verb, straight, *more), 2)
    assert not list((tmp_path / "empty").iterdir())


def test_another_run_in_the_folder_is_kept(zl, images, straight, tmp_path):
    out = Path(shutil.copytree(straight, tmp_path / "out"))
    said = sentence_of(zl(*asked(images, out, tmp_path, "--fill", "interpolate")), 2)
    assert "holds another run" in said
    same_run = zl(*asked(images, out, tmp_path))
    assert same_run.exit_code == 0, same_run.output
    assert f"{out}: already finished. Nothing is left." in same_run.stdout
    assert same(out, straight)
    (out / "views.tif").unlink()
    assert "Done: 0 of 3 tasks" in zl(*asked(images, out, tmp_path)).stdout
    all_run(zl, out)
    assert zl("tiles", "assemble", out).exit_code == 0
    check_same_files(out, straight)


def test_what_matches_whole_images_has_no_tasks(zl, images, tmp_path):
    said = sentence_of(zl(*asked(images, tmp_path / "out", tmp_path, "--method", "gc3-sgm")), 2)
    assert "--method gc3-sgm matches whole images in one process" in said
    assert not (tmp_path / "out").exists()


def test_options_without_inputs_are_refused(zl, out):
    assert "--fill is about a new plan" in sentence_of(zl("tiles", "plan", out, "--fill", "interpolate"), 2)


def test_another_installation_is_refused(zl, out, monkeypatch):
    assert zl("tiles", "run", out, 1).exit_code == 0
    versions = versions_record() | {"numpy": "1.0"}
    monkeypatch.setattr("zlocus.pipeline.array_plan.versions_record", lambda: versions)
    for words in (("run", out, 2), ("assemble", out, "--partial")):
        said = sentence_of(zl("tiles", *words), 2)
        assert "was planned with numpy " in said
        assert "this machine has numpy 1.0" in said


def test_damaged_plans_are_made_again(zl, images, straight, out, tmp_path):
    assert zl("tiles", "run", out, 1).exit_code == 0
    (out / FOLDER / VALUES).write_bytes(b"nothing")
    assert "plan.bin is missing or damaged" in sentence_of(zl("tiles", "run", out, 2), 2)
    assert "Done: 1 of 3 tasks" in zl(*asked(images, out, tmp_path)).stdout
    assert zl("tiles", "run", out, 2).exit_code == 0
    (out / FOLDER / PLAN).write_text("{")
    assert "and no plan of tasks" in sentence_of(zl("tiles", "run", out, 2), 2)
    assert "Done: 2 of 3 tasks" in zl(*asked(images, out, tmp_path)).stdout
    assert zl("tiles", "run", out, 3).exit_code == 0
    assert zl("tiles", "assemble", out).exit_code == 0
    check_same_files(out, straight)


def test_one_run_finishes_what_tasks_began_and_the_other_way_round(zl, images, straight, out, tmp_path, monkeypatch):
    assert zl("tiles", "run", out, 3).exit_code == 0
    dsm = command(images("sine"), out, tmp_path)
    dsm = [word for word in dsm[dsm.index("dsm") :] if word != "--no-report"]
    match, calls = zlocus.pipeline.tile_run.match_tile, []

    def until_second(*given):
        calls.append(given)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return match(*given)

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", until_second)
    interrupted = zl(*dsm, "--workers", 1)
    assert interrupted.exit_code == 130
    assert "2 of 4 tiles are there already" in interrupted.stderr
    assert "3 of 4 tiles are finished and kept" in interrupted.stderr
    monkeypatch.undo()
    assert zl("tiles", "plan", out).stdout.count("3 of 4 tiles") == 1
    assert [zl("tiles", "run", out, number).exit_code for number in (1, 2)] == [0, 0]
    assert zl("tiles", "assemble", out).exit_code == 0
    check_same_files(out, straight)


def test_a_run_keeps_out_while_a_task_works(zl, images, out, tmp_path):
    plan = stored_plan(out)
    dsm = command(images("sine"), out, tmp_path)
    with plan.checkpoint().joined("1"):
        refused = zl(*dsm[dsm.index("dsm") :])
        assert "Another run writes to" in sentence_of(refused, 2)
        assert len(refused.stderr.splitlines()) == 1  # before images are opened
        assert zl("tiles", "run", out, 2).exit_code == 0
    with plan.checkpoint().open(plan.digest):
        assert "needs" in sentence_of(zl("tiles", "run", out, 1), 2)
    assert stored_plan(out) is not None


def test_an_interrupt_while_assembling_keeps_the_tiles(zl, straight, out, monkeypatch):
    all_run(zl, out)

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(zlocus.pipeline.array_jobs, "write_products", stop)
    stopped = zl("tiles", "assemble", out)
    assert stopped.exit_code == 130
    assert "4 of 4 tiles are finished and kept: the same command resumes from there" in stopped.stderr
    monkeypatch.undo()
    assert zl("tiles", "assemble", out).exit_code == 0
    check_same_files(out, straight)


def test_a_full_disk_keeps_the_tiles(zl, out, monkeypatch):
    all_run(zl, out)

    def full(*_, **__):
        raise OutputError("dsm.tif cannot be written: no space left on device.")

    monkeypatch.setattr(zlocus.pipeline.array_jobs, "write_rasters", full)
    assert "The 4 finished tiles are kept" in sentence_of(zl("tiles", "assemble", out), 3)


def test_the_time_of_tasks_is_that_while_any_of_them_worked():
    """Three tiles at the same time, with a gap between two of them and the third."""
    ends = ("2026-11-29T10:00:10.000+00:00", "2026-11-29T10:00:12.000+00:00", "2026-11-29T10:01:00.500+00:00")
    tiles = [
        {"event": "tile", "time": time, "wall_s": wall_s, "cpu_s": 3.0, "peak_mb": 100.0 + wall_s}
        for time, wall_s in zip(ends, (10.0, 4.0, 0.5), strict=True)
    ]
    stage = matching_of_tasks([*tiles, {"event": "began", "time": ends[0]}])
    assert stage == {"name": "match", "wall_s": 12.5, "cpu_s": 9.0, "peak_mb": 110.0}
    assert matching_of_tasks([])["wall_s"] == 0.0


def test_one_run_says_that_it_takes_a_plan_over(zl, images, out, tmp_path):
    dsm = command(images("sine"), out, tmp_path)
    planned = zl(*dsm[dsm.index("dsm") :], "--dry-run")
    assert "holds a plan of tasks for this surface" in planned.stdout
    assert (out / FOLDER).exists()
    done = zl(*dsm[dsm.index("dsm") :], "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    (note,) = (sentence for sentence in record["notes"] if "plan of tasks" in sentence)
    assert note.endswith("This run makes it at once, with the tiles that are finished, and removes the plan.")
    assert not (out / FOLDER).exists()
    # The object names everything that was written, and where it lies.
    assert {Path(file).name for file in record["files"]} >= {"dsm.tif", "run.json", "finished.json", "ties.gpkg"}
    assert all(Path(file).is_file() for file in record["files"])
    assert Path(record["run_record"]) == out / "run.json"
    with rasterio.open(out / "dsm.tif") as source:
        assert record["grid"]["bounds"] == pytest.approx(tuple(source.bounds))
        assert record["grid"]["shape"] == list(source.shape)
    assert record["wall_s"] > 0


def test_a_plan_with_more_tasks_than_tiles_counts_those_with_tiles(zl, images, tmp_path):
    words = asked(images, tmp_path / "out", tmp_path)
    words[words.index("3")] = "9"
    record = json.loads(zl(*words, "--json").stdout)
    assert (record["tasks"], record["tasks_with_tiles"], len(record["left"])) == (9, 4, 4)
