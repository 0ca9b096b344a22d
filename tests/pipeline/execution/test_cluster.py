"""A Dask cluster on loopback: a scheduler and two workers, each a process of its own."""

from __future__ import annotations

import gc
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import distributed
import pytest

from interrupted_runs import check_end, command, given_again, n_finished, started, wait_for_tiles
from overlapping_surfaces import two_runs
from places import SUPPORT
from rendered_scenes import N_SMALL_TILES, SMALL_TILES, run
from worker_tasks import Planted
from zlocus.core.errors import ConfigError, StoppedError
from zlocus.core.progress import SilentProgress
from zlocus.core.surface_requests import MosaicRequest
from zlocus.pipeline.execution.cluster import Cluster
from zlocus.pipeline.execution.tasks import Cause, run_tasks
from zlocus.pipeline.mosaic import run_mosaic

pytestmark = pytest.mark.filterwarnings("ignore::Warning:distributed", "ignore::ResourceWarning")
BUSY_S = 2.0
RASTERS = ("dsm", "sigma", "quality", "views", "ortho")


class Loopback:
    """The processes of a cluster."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "scheduler.json"
        paths = [str(SUPPORT), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(paths), "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
        }  # fmt: skip
        where = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
        self.scheduler = self._started("scheduler", *where, "--scheduler-file", str(self._file))
        self.address = self._address()
        self.workers: list[subprocess.Popen[bytes]] = []

    def _address(self) -> str:
        """The address in the scheduler's file, once the file is there and complete."""
        end = time.monotonic() + 60
        while time.monotonic() < end:
            if self._file.exists() and (text := self._file.read_text()).rstrip().endswith("}"):
                return str(json.loads(text)["address"])
            time.sleep(0.05)
        raise AssertionError("the scheduler did not start")

    def add_worker(self) -> None:
        """Start one, of one thread, that nobody starts again."""
        more = ["--nthreads", "1", "--no-nanny", "--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0"]
        self.workers.append(self._started("worker", self.address, *more))

    def wait_for_workers(self) -> None:
        """Return when every worker can be given tasks. On a busy machine one would do all before another starts."""
        with distributed.Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(len(self.workers), timeout=60)

    def _started(self, kind: str, *arguments: str) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments]
        return subprocess.Popen(words, env=self._environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def stop(self) -> None:
        """End all processes."""
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@contextmanager
def cluster(folder, n_workers=2):
    found = Loopback(folder)
    try:
        for _ in range(n_workers):
            found.add_worker()
        found.wait_for_workers()
        yield found
    finally:
        found.stop()


@pytest.fixture(scope="module")
def straight(images, tmp_path_factory):
    return run(images("sine"), tmp_path_factory.mktemp("straight") / "out", SMALL_TILES, workers=1, report=False).out


def same(out, straight):
    return all((out / f"{name}.tif").read_bytes() == (straight / f"{name}.tif").read_bytes() for name in RASTERS)


def test_a_cluster_makes_the_same_bytes(images, straight, tmp_path):
    with cluster(tmp_path) as found:
        out = run(images("sine"), tmp_path / "out", SMALL_TILES, scheduler=found.address, report=False).out
        assert same(out, straight)
        done = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
        assert len({event["worker"] for event in done if event["event"] == "tile"}) == 2
        # And again, for workers that know another run already.
        assert same(
            run(images("sine"), tmp_path / "b", SMALL_TILES, scheduler=found.address, report=False).out, straight
        )


def test_a_worker_that_is_lost_costs_its_tiles_only(images, straight, tmp_path):
    with cluster(tmp_path) as found:
        out = tmp_path / "out"

        def rob():
            done = out / "tiles" / "done.jsonl"
            while not done.exists() or len(done.read_bytes().splitlines()) < 2:
                time.sleep(0.01)
            found.workers[0].send_signal(signal.SIGKILL)

        robber = threading.Thread(target=rob)
        robber.start()
        run(images("sine"), out, SMALL_TILES, scheduler=found.address, report=False)
        robber.join()
        assert found.workers[0].poll() is None or found.workers[0].wait() == -signal.SIGKILL
        assert same(out, straight)
        tiles = [
            json.loads(line)["tile"] for line in (out / "events.jsonl").read_text().splitlines() if '"tile"' in line
        ]
        assert len(tiles) == len(set(tiles)) == N_SMALL_TILES


def test_a_scheduler_that_goes_keeps_what_is_done(images, straight, tmp_path):
    out = tmp_path / "out"
    with cluster(tmp_path) as found:

        def rob():
            done = out / "tiles" / "done.jsonl"
            while not done.exists() or len(done.read_bytes().splitlines()) < 2:
                time.sleep(0.01)
            found.scheduler.send_signal(signal.SIGKILL)

        robber = threading.Thread(target=rob)
        robber.start()
        with pytest.raises(
            StoppedError, match=r"The scheduler at tcp://127\.0\.0\.1:\d+ has gone\. Finished tiles are kept"
        ):
            run(images("sine"), out, SMALL_TILES, scheduler=found.address, report=False)
        robber.join()
    assert len((out / "tiles" / "done.jsonl").read_bytes().splitlines()) >= 2
    run(images("sine"), out, SMALL_TILES, report=False)
    assert same(out, straight)


def test_a_mosaic_of_a_cluster_has_the_same_bytes(tmp_path):
    runs = [str(folder) for folder in two_runs(tmp_path, seed=2).folders]
    run_mosaic(MosaicRequest((*runs,), tmp_path / "here"), SilentProgress())
    with cluster(tmp_path, 1) as found:
        request = MosaicRequest((*runs,), tmp_path / "there", scheduler=found.address)
        run_mosaic(request, SilentProgress())
    for name in ("dsm.tif", "sigma.tif", "source.tif", "seams.tif", "quality.tif"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes(), name


def test_failures_on_a_cluster(tmp_path):
    """A fault at once, a lack of memory after all attempts; a task that kills its workers is given up, and others that
    were theirs are not."""
    with cluster(tmp_path, 6) as found:
        planted = Planted(tmp_path, kill=(2,), exhaust=(4,), break_=(6,))
        with Cluster(planted, found.address) as workers:
            assert workers.slots >= 1
            ends = {o.task: o for o in run_tasks(workers, range(9)) if o.is_final}
    assert sorted(n for n, o in ends.items() if o.failure) == [2, 4, 6]
    assert (ends[2].failure.cause, ends[4].failure.cause, ends[6].failure.cause) == (
        Cause.LOST, Cause.MEMORY, Cause.FAULT,
    )  # fmt: skip
    assert [ends[n].result[0] for n in (0, 8)] == [0, 64]


@pytest.fixture
def short_wait(monkeypatch):
    """An address at which nothing answers is given up soon."""
    monkeypatch.setattr("zlocus.pipeline.execution.cluster.CONNECT_S", 1.0)


@pytest.mark.usefixtures("short_wait")
def test_where_nothing_answers(images, tmp_path):
    for address in ("tcp://127.0.0.1:9", "nonsense"):
        with pytest.raises(ConfigError, match=rf"--scheduler {address} does not answer"):
            run(images("sine"), tmp_path / "out", SMALL_TILES, scheduler=address, report=False)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ConfigError, match=r"--method gc3-sgm matches whole images in one process\. Leave --scheduler"):
        run(images("sine"), tmp_path / "out", SMALL_TILES, scheduler="tcp://127.0.0.1:9", method="gc3-sgm")


@pytest.mark.usefixtures("short_wait")
def test_a_client_that_found_nobody_is_collected_at_once(tmp_path):
    """It closes itself then. While another client starts, both would wait for one lock of `distributed` without end."""

    def clients():
        return [kept for kept in gc.get_objects() if isinstance(kept, distributed.Client)]

    gc.collect()
    before = len(clients())
    with pytest.raises(ConfigError, match="does not answer"):
        Cluster(Planted(tmp_path), "tcp://127.0.0.1:9")
    assert len(clients()) == before


def test_a_signal_as_a_call_begins(tmp_path, caplog):
    """Results are waited for where no signal interrupts `distributed`, which would print a traceback."""
    # A process that a shell starts in the background ignores this signal.
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with cluster(tmp_path, n_workers=1) as found, Cluster(Planted(tmp_path), found.address) as workers:
            workers.submit(1)
            loop = workers._client.loop
            loop.add_callback(time.sleep, BUSY_S)  # so that the next call waits for its turn
            threading.Timer(BUSY_S / 4, os.kill, (os.getpid(), signal.SIGINT)).start()
            with pytest.raises(KeyboardInterrupt):
                workers.wait()
            handled = threading.Event()
            loop.add_callback(handled.set)
            assert handled.wait(60)
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert not caplog.records


def test_a_signal_ends_the_command_and_not_the_cluster(images, straight, tmp_path):
    """Finished tiles are kept, and the cluster makes the others when the command is given again."""
    out = tmp_path / "out"
    with cluster(tmp_path, n_workers=1) as found:
        words = command(images("sine"), out, tmp_path, "--scheduler", found.address)
        process = started(words)
        wait_for_tiles(out, 1, process)
        process.send_signal(signal.SIGTERM)
        _, stderr = process.communicate(timeout=60)
        assert process.returncode == 143
        check_end(process.returncode, signal.SIGTERM, stderr)
        assert "finished and kept: the same command resumes from there" in stderr
        assert n_finished(out)
        assert re.search("tiles? (are|is) there already", given_again(words))
        assert same(out, straight)
        assert found.workers[0].poll() is None
