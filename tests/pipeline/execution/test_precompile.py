"""Kernels are compiled in advance once, and the user is told."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys

import pytest

from places import TESTS
from zlocus.core.jit import COMPLETE, KernelCache
from zlocus.core.progress import LineProgress
from zlocus.pipeline.execution import precompile
from zlocus.pipeline.execution.precompile import kernels_compiling


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, and groups that compile nothing: each ends with the status of its name."""
    monkeypatch.setattr("zlocus.core.jit.config.CACHE_DIR", str(tmp_path))
    cache = KernelCache(tmp_path)
    cache.folder.mkdir(parents=True, exist_ok=True)
    monkeypatch.setattr(precompile, "CACHE", cache)
    monkeypatch.setattr(precompile, "FOR_ANOTHER", "import sys; sys.exit(int(sys.argv[1]))")
    return cache


def told(groups, monkeypatch):
    """What is printed while the kernels of these groups are compiled."""
    monkeypatch.setattr(precompile, "GROUPS", groups)
    stream = io.StringIO()
    with kernels_compiling(LineProgress(stream)):
        pass
    return stream.getvalue()


def test_the_first_run_says_that_kernels_are_compiled_and_for_how_long(cache, monkeypatch):
    assert not cache.is_complete
    text = told(("0", "0"), monkeypatch)
    assert "Kernels are being compiled, once after an installation or an update" in text
    assert " s of this run" in text or " min " in text
    assert str(cache.folder) in text
    assert cache.is_complete
    assert (cache.folder / COMPLETE).exists()


def test_later_runs_compile_nothing(cache, monkeypatch):
    cache.mark_complete()
    monkeypatch.setattr(precompile.subprocess, "Popen", lambda *_, **__: sys.exit("nothing is to be started"))
    assert not told(("0",), monkeypatch)


def test_kernels_that_did_not_compile_are_tried_again(cache, monkeypatch):
    assert told(("0", "1"), monkeypatch)
    assert not cache.is_complete


def test_nothing_is_compiled_where_nothing_can_be_kept(cache, monkeypatch):
    cache.folder = None
    assert not told(("0",), monkeypatch)
    cache.mark_complete()
    assert not cache.is_complete


# What the kernels that a process has called so far were called with, by their names.
CALLED = """
import gc, json
from zlocus.core.lazy_kernels import LazyKernel
print(json.dumps(sorted(
    f"{each.__module__}.{each.__name__}{signature}"
    for each in gc.get_objects() if type(each) is LazyKernel and "dispatcher" in each.__dict__
    for signature in each.dispatcher.overloads
)))
"""
WARM = "from zlocus.pipeline.execution import precompile\nfor group in precompile.GROUPS: precompile.warm(group)\n"
RUN = """
import sys
from pathlib import Path
from rendered_scenes import run
run(tuple(map(Path, sys.argv[2:])), Path(sys.argv[1]), heights=None, report=True, workers=1)
"""


def called(code, *arguments):
    """The calls of kernels of a process that runs some code."""
    done = subprocess.run(
        [sys.executable, "-c", code + CALLED, *map(str, arguments)], capture_output=True, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": str(TESTS / "support")},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_all_kernels_of_a_run_are_compiled_in_advance(images, tmp_path):
    """Otherwise the first tile of each process takes ten times as long as the plan says."""
    in_advance = called(WARM)
    of_run = called(RUN, tmp_path / "out", *images("sine").inputs)
    assert len(of_run) > 20
    assert of_run <= in_advance


def test_a_process_that_compiles_for_another_ends_well():
    """While its input is open still."""
    code = "from zlocus.pipeline.execution import precompile as p; p.warm = lambda group: None; p.warm_for_another('x')"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.wait(60) == 0
        assert process.stderr.read() == b""
