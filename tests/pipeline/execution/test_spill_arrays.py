"""Arrays in memory while there is room, and then in files without a name."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from zlocus.core.errors import OutputError
from zlocus.core.resources import held_bytes
from zlocus.pipeline.execution.spill_arrays import PART_BYTES, SpillArrays

MB = 1_000_000
# Beside the part that is written at a time: what an allocator keeps.
SLACK_BYTES = 30 * MB


@pytest.mark.parametrize("room", [1e9, 0.0], ids=["memory", "files"])
@pytest.mark.parametrize(("value", "dtype"), [(np.nan, np.float32), (7, np.uint16), (0, np.uint8)])
def test_arrays_are_those_of_numpy(tmp_path, room, value, dtype):
    spill_arrays = SpillArrays(tmp_path / "not" / "there", room)
    found = spill_arrays.full((5, 7), value, dtype)
    np.testing.assert_array_equal(found, np.full((5, 7), value, dtype))
    assert found.dtype == dtype
    found[2:4, 1:] = 3
    spill_arrays.rest()
    again = spill_arrays.copied(found)
    found[:] = 1
    assert (again[2:4, 1:] == 3).all()
    assert (again == 3).sum() == 12
    assert (spill_arrays.file_bytes > 0) == (room == 0.0)
    assert not list(tmp_path.iterdir()), "files have no name"


def test_memory_is_used_while_there_is_room(tmp_path):
    spill_arrays = SpillArrays(tmp_path, 1000.0)
    spill_arrays.full((100,), 0, np.float32)
    spill_arrays.full((200,), 0, np.float32)
    spill_arrays.full((100,), 0, np.float32)
    assert spill_arrays.room_bytes == 200.0
    assert spill_arrays.file_bytes == 800
    assert spill_arrays.full((0, 5), 0, np.float32).shape == (0, 5)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="no list of open files")
def test_many_arrays_share_a_file(tmp_path):
    """A process may have few files open."""
    spill_arrays, before = SpillArrays(tmp_path, 0.0), len(list(Path("/proc/self/fd").iterdir()))
    arrays = [spill_arrays.full((1000, k + 1), k, np.uint16) for k in range(50)]
    assert len(list(Path("/proc/self/fd").iterdir())) - before <= 1
    for k, array in enumerate(arrays):
        assert array.shape == (1000, k + 1)
        assert (array == k).all()


def test_files_do_not_count_as_memory_once_at_rest(tmp_path):
    side = 12_000
    assert 2 * side * side > 4 * PART_BYTES
    spill_arrays, before = SpillArrays(tmp_path, 0.0), held_bytes()
    found = spill_arrays.full((side, side), 9, np.uint16)
    assert held_bytes() - before < SLACK_BYTES
    other = spill_arrays.copied(found)
    assert held_bytes() - before < SLACK_BYTES
    assert (other[:: side // 7, :: side // 7] == 9).all()


def test_a_disk_without_room_is_said(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    spill_arrays = SpillArrays(tmp_path / "out", 10.0)
    with pytest.raises(OutputError, match=rf"{tmp_path} cannot hold the 1\.1 GB .*: No space left on device\. Choose"):
        spill_arrays.full((1000, 1000), 0, np.uint16)
