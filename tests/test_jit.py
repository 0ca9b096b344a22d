"""Where compiled kernels are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from zlocus.kernels import _jit
from zlocus.kernels._jit import cache_folder


@pytest.fixture
def sources(tmp_path):
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "a.py").write_text("ONE = 1\n")
    (folder / "b.py").write_text("TWO = 2\n")
    return folder


def test_beside_the_sources(sources):
    found = cache_folder(sources)
    assert found.parent == sources / "__pycache__"
    assert cache_folder(sources) == found
    assert not list(found.parent.iterdir())


def test_a_change_in_any_source_gives_another_folder(sources):
    """A kernel holds the code of the kernels it calls, so each file counts for all."""
    found = {cache_folder(sources)}
    for name in ("a.py", "b.py", "new.py"):
        (sources / name).write_text("CHANGED = 3\n")
        found.add(cache_folder(sources))
    assert len(found) == 4
    (sources / "notes.txt").write_text("no source")
    assert cache_folder(sources) in found


def test_where_the_sources_cannot_be_written_beside(sources, tmp_path, monkeypatch):
    """An installation of another user: the user's own cache (here a file stands in the folder's place)."""
    beside = cache_folder(sources)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    (sources / "__pycache__").rmdir()
    (sources / "__pycache__").write_text("no folder")
    found = cache_folder(sources)
    assert found == tmp_path / "home" / ".cache" / "zlocus" / beside.name


def test_a_folder_that_takes_no_files(sources, tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    monkeypatch.setattr(_jit.tempfile, "TemporaryFile", refuse)
    assert cache_folder(sources).parent == tmp_path / "home" / ".cache" / "zlocus"
