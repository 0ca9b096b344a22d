"""The acceptance row `align` on one small scene."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from rows import alignment
from workplace import Workplace
from zlocus.cli.app import app


def in_this_process(words):
    """Runs a command without starting Python anew."""
    done = CliRunner().invoke(app, [str(word) for word in words[1:]])
    assert done.exit_code == 0, done.output


def test_planted_offsets_are_judged(tmp_path, monkeypatch):
    monkeypatch.setattr(alignment, "fresh_seeds", lambda n: [7])
    monkeypatch.setattr(alignment, "N_CELLS", 240)
    monkeypatch.setattr(alignment, "N_POINTS", 4000)
    monkeypatch.setattr(alignment, "run", in_this_process)
    figures = {figure.what: figure for figure in alignment.align(Workplace(None, tmp_path))}
    # A smaller scene than that of the row: shifts are known to some centimetres.
    assert figures["points: shift, largest"].value < 0.05
    assert figures["points with tilt: tilt, largest"].value < 0.05
    assert figures["flat ground: horizontal shifts that were taken"].value == 0
    assert all(figure.fails_when for figure in figures.values() if figure.bar)
    wrong = dict.fromkeys(("east", "north", "up"), 9.0)
    record = {"offset_m": wrong, "sigma_m": dict.fromkeys(wrong, 1.0), "tilt": None}
    monkeypatch.setattr(alignment, "aligned", lambda *_: record)
    off = alignment._of_scene(tmp_path / "wrong", 7)["points: shift"]
    assert off == pytest.approx(9.0 * 2**0.5, abs=2**0.5 * alignment.SHIFT_M)
