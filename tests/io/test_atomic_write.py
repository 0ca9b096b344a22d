"""Atomic writing: after any interruption a file is complete or missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from rpc_fixtures import satellite_rpc
from zlocus.cli.app import app
from zlocus.io.atomic_write import atomic_file
from zlocus.io.cameras.camera_kinds import RpcCamera
from zlocus.io.cameras.rpc_text import write_rpc_txt
from zlocus.io.number_table import write_number_table
from zlocus.io.run_record import write_record
from zlocus.io.scene_file import SceneFile, ViewEntry, write_scene_file

VIEWS = tuple(ViewEntry(name=name, image=f"{name}.tif", camera=RpcCamera()) for name in "ab")
SCENE = SceneFile.model_validate({"schema": 1, "frame": {"crs": "EPSG:32632"}, "views": VIEWS})
# What writes a file of text, by what it is.
WRITERS = {
    "table": lambda path: write_number_table(path, {"time": np.arange(9.0)}, "s"),
    "RPC": lambda path: write_rpc_txt(path, satellite_rpc()),
    "scene": lambda path: write_scene_file(path, SCENE),
    "record": lambda path: write_record(path, {"a": 1}),
    "options": lambda path: CliRunner().invoke(app, ["config", "-o", str(path)]),
}


@pytest.mark.parametrize("what", WRITERS)
def test_an_interrupt_leaves_nothing_half_written(tmp_path, monkeypatch, what):
    """Nor does it change what was there."""
    path, write = tmp_path / "file", Path.write_text

    def stopped(self, text, **given):
        write(self, text[: len(text) // 2], **given)
        raise KeyboardInterrupt

    if what != "options":  # never written twice
        path.write_text("before")
    monkeypatch.setattr(Path, "write_text", stopped)
    if what == "options":
        assert WRITERS[what](path).exit_code == 130
    else:
        with pytest.raises(KeyboardInterrupt):
            WRITERS[what](path)
    monkeypatch.undo()
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("file", "before")][: what != "options"]
    WRITERS[what](path)
    assert [one.name for one in tmp_path.iterdir()] == ["file"]
    assert path.read_text() != "before"


def test_a_folder_that_disappears_meanwhile_causes_no_second_error(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(FileNotFoundError), atomic_file(folder / "file"):
        folder.rmdir()
