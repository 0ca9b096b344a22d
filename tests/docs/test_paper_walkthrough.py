"""The commands of the lesson on the figures of the paper, on a small rendered town with images of the same names."""

from __future__ import annotations

import contextlib

import pytest
from typer.testing import CliRunner

from docs_commands import steps_of
from places import ROOT
from zlocus.cli.app import app
from zlocus.core.paper_request import PAPER_FILES
from zlocus.pipeline import paper

PAGE = ROOT / "docs" / "tutorials" / "paper_figures.md"
# The rendered block, as some commands name it.
BLOCK = "paper/scene/scene.yaml "
VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")


@pytest.fixture
def one_orientation(monkeypatch):
    """The tie points of the images are found once: the commands differ in what they show."""
    found, orient = [], paper.orient_views

    def once(*arguments, **options):
        found[:] = found or [orient(*arguments, **options)]
        return found[0]

    monkeypatch.setattr(paper, "orient_views", once)


def test_the_commands_make_all_tables_and_figures(small_town, tmp_path, one_orientation):
    """Images are named in place of the rendered block, and fewer points are compared."""
    images = [str(small_town / f"img_{view}.tif") for view in VIEWS]
    made = []
    for step in steps_of(PAGE):
        text = step.text.replace("--points 200", "--points 9").replace(BLOCK, "")
        program, command, what, *options = text.split()
        assert (program, command) == ("zlocus", "paper")
        with contextlib.chdir(tmp_path):
            done = CliRunner().invoke(app, ["paper", what, *images, *options], catch_exceptions=False)
        assert done.exit_code == 0, f"{step.text}\n{done.output}"
        made.append(what)
    assert set(made) == set(PAPER_FILES)
    for what, files in PAPER_FILES.items():
        assert all((tmp_path / "paper" / name).exists() for name in files), what
    said = (PAGE).read_text(encoding="utf-8")
    heading = (tmp_path / "paper" / "table3.csv").read_text(encoding="utf-8").splitlines()[0]
    for column in ("rho1", "rho2", "ratio", "label"):
        assert column in heading
        assert column in said
