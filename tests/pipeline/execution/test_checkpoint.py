"""Finished tiles on disk: whole, of this run, and nothing else."""

from __future__ import annotations

import errno
import json
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zlocus.pipeline.execution.checkpoint as store_module
from zlocus.core.errors import OutputError, StoppedError
from zlocus.pipeline.execution.checkpoint import (
    BEFORE,
    DONE,
    FOLDER,
    MANIFEST,
    TileCheckpoint,
    difference,
    kept_tiles,
)

KEY = {"versions": {"zlocus": "1"}, "request": {"crs": None}, "options": {"a": {"b": 1}}, "inputs": {"i.tif": [5, 6]}}
ARRAYS = {"height": np.arange(6, dtype=np.float32).reshape(2, 3), "views": np.ones((2, 3), np.uint8)}


def store(out, key=None, **how):
    return TileCheckpoint.of(out, key or KEY, **({"is_resumed": True, "overwrite": False} | how))


def filled(out, names=("0_0", "0_64"), settled="s", key=None):
    held = store(out, key)
    with held.open(settled, ARRAYS):
        for name in names:
            held.keep(name, ARRAYS)
    return held


def test_tiles_are_there_for_the_same_run(tmp_path):
    filled(tmp_path)
    again = store(tmp_path)
    assert set(again.finished) == {"0_0", "0_64"}
    with again.open("s"):
        assert again.holds("0_0")
        found = again.load("0_64")
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].dtype == array.dtype
        again.keep("64_0", ARRAYS)
    assert set(store(tmp_path).finished) == {"0_0", "0_64", "64_0"}
    again.remove()
    assert not list(tmp_path.iterdir())


def test_an_interrupt_right_after_the_line_of_a_tile_costs_no_tile(tmp_path, monkeypatch):
    """Before, the tile was not counted, and where it was the only one it was removed."""

    def interrupt(_):
        raise KeyboardInterrupt

    fsync, calls = os.fsync, []
    # Four files are written to disk: arrays before the tiles, manifest, tile, and the list of tiles.
    monkeypatch.setattr(
        store_module.os, "fsync", lambda n: [fsync(n), calls.append(n), len(calls) == 4 and interrupt(n)]
    )
    with pytest.raises(KeyboardInterrupt):
        filled(tmp_path, names=["0_0"])
    monkeypatch.undo()
    held = store(tmp_path)
    assert set(held.finished) == {"0_0"}
    assert held.holds("0_0")


def test_what_was_found_before_the_first_tile_is_there_for_the_same_run(tmp_path):
    """Whether or not a tile was finished; not for another run, nor for one that is not to take it on."""
    with store(tmp_path).open("s", ARRAYS) as held:
        held.keep("0_0", ARRAYS)
    for _ in range(2):
        again = store(tmp_path)
        found = again.arrays_before_tiles()
        assert set(found) == set(ARRAYS)
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(found[name], array)
        with again.open("s", {"height": np.zeros(3)}):
            assert again.holds("0_0")
    assert store(tmp_path, overwrite=True).arrays_before_tiles() is None
    assert store(tmp_path, is_resumed=False).arrays_before_tiles() is None
    (tmp_path / FOLDER / DONE).unlink()
    assert set(store(tmp_path).arrays_before_tiles()) == set(ARRAYS)
    assert store(tmp_path, KEY | {"inputs": {}}).arrays_before_tiles() is None


@pytest.mark.parametrize("damage", ["missing", "cut", "changed"])
def test_what_was_found_before_is_whole_or_not_there(tmp_path, damage):
    filled(tmp_path)
    path = tmp_path / FOLDER / BEFORE
    content = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(content[:-1] if damage == "cut" else bytes([content[0] ^ 1]) + content[1:])
    held = store(tmp_path)
    assert held.arrays_before_tiles() is None
    assert held.holds("0_0")
    with held.open("s", ARRAYS):
        assert held.holds("0_0")
    assert set(store(tmp_path).arrays_before_tiles()) == set(ARRAYS)
    assert store(tmp_path).holds("0_0")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"request": {"crs": "EPSG:32631"}}, "--crs was not given there and is EPSG:32631 now"),
        ({"options": {"a": {"b": 2}}}, "the option a.b was 1 there and is 2 now"),
        ({"inputs": {"i.tif": [5, 7]}}, "i.tif has changed since"),
        ({"inputs": {"i.tif": [5, 6], "j.tif": [1, 1]}}, "j.tif is new"),
        ({"inputs": {}}, "i.tif is missing"),
        ({"versions": {"zlocus": "2"}}, "the version of zlocus was 1 there and is 2 now"),
    ],
)
def test_tiles_of_another_run_are_refused(tmp_path, change, says):
    filled(tmp_path)
    with pytest.raises(OutputError, match="holds 2 finished tiles of another run") as caught:
        store(tmp_path, KEY | change)
    assert says in str(caught.value)
    assert store(tmp_path, KEY | change, overwrite=True).finished == {}
    new = store(tmp_path, is_resumed=False)
    assert new.finished == {}
    with new.open("s"):
        assert not new.holds("0_0")
    assert store(tmp_path).finished == {}


def test_cameras_that_came_out_otherwise_are_noticed(tmp_path):
    filled(tmp_path, settled="one")
    again = store(tmp_path)
    with pytest.raises(OutputError, match="2 finished tiles for other cameras and heights"):
        again.open("other").__enter__()
    assert set(store(tmp_path).finished) == {"0_0", "0_64"}


def test_two_runs_at_once_are_refused(tmp_path):
    one = store(tmp_path)
    TileCheckpoint.check_free(tmp_path)  # nothing is there
    assert not list(tmp_path.iterdir())
    with one.open("s"):
        with pytest.raises(OutputError, match="Another run writes to"):
            TileCheckpoint.check_free(tmp_path)
        one.keep("0_0", ARRAYS)
        with pytest.raises(OutputError, match="Another run writes to"), store(tmp_path).open("s"):
            pass
        assert one.holds("0_0")
    with store(tmp_path).open("s") as again:
        assert again.holds("0_0")


@settings(max_examples=60)
@given(st.data())
def test_damage_is_noticed(tmp_path_factory, data):
    """Any byte of a tile that changes, any length that it is cut to: it is made again."""
    out = tmp_path_factory.mktemp("out")
    held = filled(out)
    path = out / FOLDER / "0_0.npz"
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[at] ^= data.draw(st.integers(1, 255))
    else:
        content = content[:at]
    path.write_bytes(content)
    assert not held.holds("0_0")
    assert held.load("0_0") is None
    assert held.holds("0_64")


@settings(max_examples=60)
@given(st.integers(0, 300), st.binary(max_size=40))
def test_lines_that_are_cut_off_count_for_nothing(tmp_path_factory, length, more):
    out = tmp_path_factory.mktemp("out")
    filled(out)
    done = out / FOLDER / DONE
    whole = done.read_bytes()
    done.write_bytes(whole[:length] + more)
    found = store(out)
    with found.open("s"):
        assert {name for name in found.finished if found.holds(name)} <= {"0_0", "0_64"}
        if length > whole.index(b"\n"):
            assert found.holds("0_0")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema": 99, "key": {}}', '{"schema": 1}'])
def test_a_damaged_manifest_is_said(tmp_path, content):
    filled(tmp_path)
    (tmp_path / FOLDER / MANIFEST).write_text(content)
    with pytest.raises(OutputError, match="its manifest is damaged, or of another version"):
        store(tmp_path)
    with store(tmp_path, overwrite=True).open("s"):
        assert json.loads((tmp_path / FOLDER / MANIFEST).read_text())["key"] == KEY


def test_a_full_disk_keeps_what_is_there(tmp_path, monkeypatch):
    held = store(tmp_path)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with held.open("s"):
        held.keep("0_0", ARRAYS)
        monkeypatch.setattr(store_module, "write_atomically", full)
        with pytest.raises(
            StoppedError, match=r"No space left on device\. The one finished tile is kept; make room"
        ) as caught:
            held.keep("0_64", ARRAYS)
    assert caught.value.exit_status == 3
    monkeypatch.undo()
    assert set(store(tmp_path).finished) == {"0_0"}


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / FOLDER).write_text("a file")
    with pytest.raises(OutputError, match="cannot be written"), store(tmp_path).open("s"):
        pass


def test_no_tile_holds_objects(tmp_path):
    """Tiles are read without pickle, whatever lies there."""
    held = filled(tmp_path)
    path = tmp_path / FOLDER / "0_0.npz"
    np.savez(path, height=np.array([{"a": 1}], dtype=object))
    held.finished["0_0"] = __import__("hashlib").sha256(path.read_bytes()).hexdigest()
    assert held.load("0_0") is None


def test_differences_by_hand():
    assert difference({"a": 1, "b": {"c": 2}}, {"a": 1, "b": {"c": 2}}) == ""
    assert difference({"b": {"c": 2}}, {"b": {"c": 2, "d": 3}}) == "b.d was not given there and is 3 now"
    assert "..." in difference({"a": "x" * 100}, {"a": ""})


def test_an_input_seen_from_another_folder_is_the_same():
    before = {"inputs": {"order/a.TIL": [10, 5], "order/b.TIL": [11, 6]}, "z": 1}
    now = {"inputs": {"../order/a.TIL": [10, 5], "../order/b.TIL": [11, 6]}, "z": 1}
    assert difference(before, now) == ""
    assert difference(before, now | {"z": 2}) == "z was 1 there and is 2 now"
    changed = now | {"inputs": {"../order/a.TIL": [10, 7], "../order/b.TIL": [11, 6]}}
    assert difference(before, changed) == "order/a.TIL is missing"
    assert difference(before, {"inputs": {}, "z": 1}) == "order/a.TIL is missing"


@pytest.mark.parametrize(
    ("n", "says"),
    [(0, "No tile was finished yet"), (1, "The one finished tile is kept"), (3, "The 3 finished tiles are kept")],
)
def test_the_number_of_tiles_that_are_kept_is_a_sentence(n, says):
    assert kept_tiles(n) == says


def test_processes_join_a_run_and_keep_tiles_side_by_side(tmp_path):
    """Each has a list of its own, a run that needs the folder for itself is kept out, and both see all tiles after."""
    filled(tmp_path)
    one, other = store(tmp_path), store(tmp_path)
    with one.joined("1"), other.joined("1"):
        one.keep("64_0", ARRAYS)
        other.keep("64_0", ARRAYS)
        other.keep("64_64", ARRAYS)
        with pytest.raises(OutputError, match="Another run writes to"), store(tmp_path).open("s"):
            pass
    everything = {"0_0", "0_64", "64_0", "64_64"}
    assert set(one.finished) == set(other.finished) == set(store(tmp_path).finished) == everything
    assert len(list((tmp_path / FOLDER).glob("done*.jsonl"))) == 3
    with store(tmp_path).open("s") as alone:
        assert all(alone.holds(name) for name in everything)
        with pytest.raises(OutputError, match=r"needs .* for itself"), one.joined("2"):
            pass


def test_a_process_that_has_joined_and_made_nothing_leaves_everything(tmp_path):
    with store(tmp_path).open("s"):
        pass
    with pytest.raises(ZeroDivisionError), store(tmp_path).joined("1"):
        raise ZeroDivisionError
    assert (tmp_path / FOLDER / MANIFEST).exists()


def test_of_two_different_files_of_a_tile_the_one_on_disk_counts(tmp_path):
    """As two kinds of processors may make them of the same task."""
    filled(tmp_path, names=())
    one, other = store(tmp_path), store(tmp_path)
    for first, second in ((one, other), (other, one)):
        with first.joined("1"), second.joined("1"):
            first.keep("0_0", ARRAYS)
            second.keep("0_0", {"height": np.float32([int(second is one)])})
        kept = store(tmp_path)
        assert kept.holds("0_0")
        np.testing.assert_array_equal(kept.load("0_0")["height"], [int(second is one)])
