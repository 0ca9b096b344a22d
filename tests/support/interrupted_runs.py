"""Commands of tests that are started, watched and interrupted."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import psutil
from typer.testing import CliRunner

from rendered_scenes import HEIGHTS, SMALL_TILES
from zlocus.cli.app import app
from zlocus.pipeline.execution.checkpoint import DONE, FOLDER


def command(images, out, folder, *more, tile=SMALL_TILES.pyramid.tile):
    """The command line of `zlocus dsm` on images, in small tiles."""
    options = folder / "options.toml"
    options.write_text(f"[pyramid]\ntile = {tile}\n")
    asked = ["--crs", "EPSG:32632", "--resolution", "0.5", "--heights", *map(str, HEIGHTS), "--no-report"]
    words = ["dsm", *map(str, images.inputs), "-o", str(out), *asked, "--config", str(options), *more]
    return [sys.executable, "-m", "zlocus", *words]


def given_again(words):
    """What a command of `command` or `cloud_command` says that is given again and succeeds, in this process."""
    done = CliRunner().invoke(app, words[words.index("zlocus") + 1 :])
    assert done.exit_code == 0, done.output
    return done.stderr


def started(words):
    """Start a command in a session of its own, where signals reach it even if this process ignores them."""
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=accept_signals,
    )  # fmt: skip


def children_of(pid):
    """All processes that a process has started, directly or not."""
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def n_finished(out):
    """Number of the finished tiles of a run."""
    done = out / FOLDER / DONE
    return len(done.read_bytes().splitlines()) if done.exists() else 0


def wait_for_tiles(out, wanted, process):
    """Wait until a run has finished so many tiles, or has ended."""
    wait_until(lambda: process.poll() is not None or n_finished(out) >= wanted)


def check_end(status, number, said):
    """Check status and last message of a process that was sent a signal; it may have ended before."""
    if number == signal.SIGKILL:
        assert status in (0, -number)
        return
    assert status in (0, 128 + number), said
    assert "Traceback" not in said
    assert "xception" not in said
    last = "Interrupted." if number == signal.SIGINT else f"Ended by {number.name}."
    assert said.endswith(f"zlocus: {last}\n") == (status != 0)


def same(out, straight):
    """Whether the rasters of two results have the same bytes."""
    return all((out / f"{name}.tif").read_bytes() == (straight / f"{name}.tif").read_bytes() for name in RASTERS)


def accept_signals():
    """Let the ending signals end this process."""
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)


def wait_until(condition, seconds=120.0):
    """Wait until a condition holds; fail after some seconds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited for too long"
        time.sleep(0.01)


RASTERS = ("dsm", "sigma", "quality", "views", "ortho")
STOPS_WITHIN_S = 5.0
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def cloud_command(images, out, folder, *more, tile):
    """The command line of `zlocus cloud` on images, in tiles of so many pixels a side."""
    options = folder / "options.toml"
    options.write_text(f"[pyramid]\ntile = {tile}\n")
    asked = ["--crs", "EPSG:32632", "--heights", *map(str, HEIGHTS), "--config", str(options)]
    return [sys.executable, "-m", "zlocus", "cloud", *map(str, images.inputs), "-o", str(out), *asked, *more]
