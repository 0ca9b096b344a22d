"""Files of an export appear all at once, and replace those of an earlier export only."""

from __future__ import annotations

import json

import pytest

from zlocus.core.errors import OutputError
from zlocus.io.staged_export import earlier_files, staged_export, write_export_record


def export(out, **files):
    with staged_export(out) as stage:
        for name, text in files.items():
            path = stage / name.replace("__", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        write_export_record(stage, {"format": "test"})


def names(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_files_come_and_the_record_names_them(tmp_path):
    out = tmp_path / "deep" / "out"
    export(out, a="1", b__c="2")
    assert names(out) == ["a", "b", "b/c", "export.json"]
    assert json.loads((out / "export.json").read_text())["files"] == ["a", "b/c"]


def test_another_export_replaces_the_earlier_one_and_nothing_else(tmp_path):
    export(tmp_path, a="1", b__c__d="2")
    (tmp_path / "mine.txt").write_text("mine")
    export(tmp_path, a="3", d="4")
    assert names(tmp_path) == ["a", "d", "export.json", "mine.txt"]
    assert (tmp_path / "a").read_text() == "3"
    with (
        pytest.raises(OutputError, match=r"mine\.txt exists and is not of an export"),
        staged_export(tmp_path) as stage,
    ):
        (stage / "mine.txt").write_text("other")
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert names(tmp_path) == ["a", "d", "export.json", "mine.txt"]


def test_after_a_failure_nothing_is_left(tmp_path):
    out = tmp_path / "deep" / "out"

    def fail():
        with staged_export(out) as stage:
            (stage / "a").write_text("1")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert names(tmp_path) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), staged_export(tmp_path / "file"):
        pass


def test_a_damaged_record_removes_nothing_outside(tmp_path):
    assert earlier_files(tmp_path) == []
    for text in ("nothing", "[]", '{"files": 3}'):
        (tmp_path / "export.json").write_text(text)
        assert earlier_files(tmp_path) == []
    (tmp_path / "export.json").write_text('{"files": ["../other", "/etc/hosts", "a"]}')
    assert earlier_files(tmp_path) == [tmp_path / "a", tmp_path / "export.json"]
