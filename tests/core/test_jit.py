"""Where compiled kernels are kept."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest
from numba import config

import zlocus
from places import SUPPORT
from zlocus.core import jit as _jit
from zlocus.core.errors import ZlocusWarning
from zlocus.core.jit import KernelCache, cache_folder


@pytest.fixture
def sources(tmp_path):
    package = tmp_path / "package"
    for path, content in (("stage/kernels/a.py", "ONE = 1\n"), ("other/kernels/b.py", "TWO = 2\n")):
        (package / path).parent.mkdir(parents=True)
        (package / path).write_text(content)
    return package


def test_beside_the_sources(sources):
    found = cache_folder(sources)
    assert found.parent == sources / "__pycache__"
    assert cache_folder(sources) == found
    assert not list(found.parent.iterdir())


def test_a_change_in_any_source_gives_another_folder(sources):
    """A kernel holds the code of the kernels it calls, so each file counts for all."""
    found = {cache_folder(sources)}
    for name in ("stage/kernels/a.py", "other/kernels/b.py", "other/kernels/new.py"):
        (sources / name).write_text("CHANGED = 3\n")
        found.add(cache_folder(sources))
    assert len(found) == 4
    (sources / "stage" / "kernels" / "notes.txt").write_text("no source")
    (sources / "stage" / "no_kernel.py").write_text("THREE = 3\n")
    assert cache_folder(sources) in found


def test_another_numba_has_a_folder_of_its_own(sources, monkeypatch):
    """Two environments may share the sources, and the one cannot read the machine code of the other."""
    found = cache_folder(sources)
    monkeypatch.setattr("numba.__version__", f"{numba.__version__}.post1")
    assert cache_folder(sources) != found


def test_where_the_sources_cannot_be_written_beside(sources, tmp_path, monkeypatch):
    """An installation of another user: the user's own cache (here a file stands in the folder's place)."""
    beside = cache_folder(sources)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    (sources / "__pycache__").rmdir()
    (sources / "__pycache__").write_text("no folder")
    found = cache_folder(sources)
    assert found == tmp_path / "home" / ".cache" / "zlocus" / beside.name


def refuse_below(monkeypatch, *folders):
    """Let no file be written below some folders."""
    write = _jit.tempfile.TemporaryFile

    def written(dir):
        if any(dir.is_relative_to(folder) for folder in folders):
            raise PermissionError(13, "Permission denied")
        return write(dir=dir)

    monkeypatch.setattr(_jit.tempfile, "TemporaryFile", written)


@pytest.mark.parametrize("made_by_another", [False, True])
def test_a_folder_that_takes_no_files(sources, tmp_path, monkeypatch, made_by_another):
    """Itself, or what another user has made in it."""
    beside = cache_folder(sources)
    (beside / "kernels_0").mkdir(parents=True)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    refuse_below(monkeypatch, beside / "kernels_0" if made_by_another else beside.parent)
    assert cache_folder(sources).parent == tmp_path / "home" / ".cache" / "zlocus"


def test_a_full_disk_takes_no_kernels_but_keeps_those_it_has(sources, tmp_path, monkeypatch):
    beside = cache_folder(sources)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    full = [beside.parent]
    monkeypatch.setattr(_jit.shutil, "disk_usage", lambda path: SimpleNamespace(free=0 if path in full else 10**12))
    assert cache_folder(sources).parent == tmp_path / "home" / ".cache" / "zlocus"
    beside.mkdir()
    assert cache_folder(sources) == beside


def test_the_folder_that_a_user_names_comes_first(sources, tmp_path, monkeypatch):
    """By NUMBA_CACHE_DIR; another version of the kernels gets another folder there too."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "mine"))
    found = cache_folder(sources)
    assert found.parent == tmp_path / "mine"
    (sources / "stage" / "kernels" / "a.py").write_text("CHANGED = 3\n")
    assert cache_folder(sources) not in (found, None)


def nowhere():
    raise RuntimeError("Could not determine home directory.")


def test_where_nothing_can_be_written_kernels_go_to_a_temporary_folder(sources, monkeypatch):
    """And whose home nobody knows."""
    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setattr(Path, "home", nowhere)
    refuse_below(monkeypatch, sources)
    assert cache_folder(sources) is None
    with pytest.warns(ZlocusWarning, match=r"cannot be kept in \S*__pycache__\. They are kept in \S+ until") as warned:
        cache = KernelCache(sources)
    assert len(warned) == 1
    assert cache.temporary.is_dir()
    assert cache.folder.parent == cache.temporary
    with cache.in_use() as is_kept:
        assert is_kept
        assert str(cache.folder) == config.CACHE_DIR
    assert config.CACHE_DIR == ""
    cache.remove_temporary()
    assert not cache.temporary.exists()


def test_without_a_temporary_folder_nothing_is_kept(sources, monkeypatch):
    def none(**_):
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr(Path, "home", nowhere)
    refuse_below(monkeypatch, sources)
    monkeypatch.setattr(_jit.tempfile, "TemporaryDirectory", none)
    with pytest.warns(ZlocusWarning, match="every process of a run compiles them for itself"):
        cache = KernelCache(sources)
    monkeypatch.setattr(_jit, "CACHE", cache)
    double = _jit.kernel(lambda x: 2 * x)
    assert double(21) == 42
    cache.remove_temporary()


# A command, with workers, whose kernels are compiled anew.
PROGRAM = """
import sys
from zlocus.cli.exit_status import show_our_warnings
show_our_warnings()

import numba
import zlocus.pipeline.execution.processes as processes
from worker_tasks import Compiling
from zlocus.pipeline.execution.tasks import Here, run_tasks
from zlocus.core.jit import CACHE
assert numba.config.CACHE_DIR == "", "of the process, whose own functions are kept elsewhere"
processes.PRELOADED = ()
mine, = run_tasks(Here(Compiling()), [5])
with processes.Processes(Compiling(), 2) as workers:
    theirs = list(run_tasks(workers, range(2)))
found = {outcome.result and (outcome.result[0], *outcome.result[1]) for outcome in [mine, *theirs]}
assert found == {(str(CACHE.folder), *mine.result[1])} and mine.result[1], found
print(CACHE.temporary)
"""


def test_a_program_without_any_cache_folder(tmp_path):
    """Here files stand in the place of both folders: as root too, nothing can be written below them."""
    package = Path(zlocus.__file__).parent
    shutil.copytree(package, tmp_path / "zlocus", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "zlocus" / "__pycache__").write_text("no folder")
    here = [str(tmp_path), str(SUPPORT)]
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"} | {
        "HOME": str(tmp_path / "zlocus" / "__pycache__" / "home"), "PYTHONPATH": os.pathsep.join(here),
    }  # fmt: skip
    # Short, for the socket of the workers lies in it too.
    with tempfile.TemporaryDirectory(prefix="z") as folder:
        words = [sys.executable, "-c", PROGRAM]
        done = subprocess.run(words, capture_output=True, text=True, env=environment | {"TMPDIR": folder})
        assert done.returncode == 0, done.stderr
        temporary = Path(done.stdout.strip())
        assert temporary.parent == Path(folder)
        assert not list(Path(folder).iterdir())
    assert done.stderr.startswith("zlocus: Compiled kernels cannot be kept in ")
    assert done.stderr.count("\n") == 1
    assert f"They are kept in {temporary} until this process ends." in done.stderr
