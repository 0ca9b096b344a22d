"""Folders that are exchanged: in one step where the system can, and undone after a kill where it cannot."""

import os

import pytest

from zlocus.io import exchanged_folders
from zlocus.io.exchanged_folders import before_of, exchange_folders, restored_folder


@pytest.fixture
def folders(tmp_path):
    """Two folders, each with a file that names it."""
    made = tmp_path / "one", tmp_path / "work" / "other"
    for folder in made:
        folder.mkdir(parents=True)
        (folder / "name").write_text(folder.name)
    return made


@pytest.mark.parametrize("can_exchange", [True, False])
def test_both_have_changed_their_places(folders, monkeypatch, can_exchange):
    if not can_exchange:
        monkeypatch.setattr(exchanged_folders, "_exchanged", lambda one, other: False)
    one, other = folders
    exchange_folders(one, other)
    assert ((one / "name").read_text(), (other / "name").read_text()) == ("other", "one")
    assert sorted(path.name for path in other.parent.iterdir()) == ["other"]


def test_a_rename_that_fails_is_undone(folders, monkeypatch):
    monkeypatch.setattr(exchanged_folders, "_exchanged", lambda one, other: False)
    one, other = folders

    def refused(source, to):
        if source == other:
            raise PermissionError
        rename(source, to)

    rename = os.rename
    monkeypatch.setattr(exchanged_folders.os, "rename", refused)
    with pytest.raises(PermissionError):
        exchange_folders(one, other)
    assert ((one / "name").read_text(), (other / "name").read_text()) == ("one", "other")


def test_what_a_kill_left_is_put_back(folders):
    one, other = folders
    assert not restored_folder(one, other)
    os.rename(one, before_of(other))
    assert restored_folder(one, other)
    assert (one / "name").read_text() == "one"


def test_a_folder_that_is_missing_is_an_error(folders):
    one, _ = folders
    with pytest.raises(FileNotFoundError):
        exchange_folders(one, one.with_name("missing"))
    assert (one / "name").read_text() == "one"
