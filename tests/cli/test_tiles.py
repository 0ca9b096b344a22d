"""`zlocus tiles`: its options are those of `zlocus dsm` that say what surface is made."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
from typer.testing import CliRunner

from zlocus.cli.app import app
from zlocus.cli.dsm import DsmOptions
from zlocus.cli.tiles import TilesPlanOptions
from zlocus.core.requests import DsmRequest
from zlocus.pipeline.array_jobs import TaskResult
from zlocus.pipeline.array_plan import FinishedTasks


@pytest.fixture
def zl():
    """Run the command line in this process."""
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def test_a_plan_has_the_options_of_a_surface():
    """All but who does the work, which is said task by task, and --dry-run, which a plan does not need."""
    shared = [f.name for f in fields(DsmOptions) if f.name not in ("inputs", "out", "workers", "scheduler", "dry_run")]
    assert [f.name for f in fields(TilesPlanOptions)] == ["out", "inputs", "tasks", *shared]
    assert {f.name: f.default for f in fields(TilesPlanOptions)}["maps"] == "hillshade"
    with pytest.raises(TypeError):
        TilesPlanOptions(out=Path("out"), scheduler="tcp://a:1")


def test_options_reach_the_pipeline(zl, monkeypatch, tmp_path):
    asked = []
    planned = FinishedTasks(tmp_path / "out", 7)
    monkeypatch.setattr("zlocus.pipeline.array_jobs.plan_tasks", lambda *given: asked.append(given) or planned)
    done = zl(
        "tiles", "plan", tmp_path / "out", "a.tif", "b.tif", "--tasks", 7, "--resolution", 0.5, "--heights", 1, 2,
        "--products", "dtm", "--no-report", "--memory", 2, "--overwrite",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert done.stdout == f"{planned}\n"
    request, config, n_tasks, _ = asked[0]
    assert request == DsmRequest(
        inputs=(Path("a.tif"), Path("b.tif")), out=tmp_path / "out", resolution=0.5, heights=(1, 2),
        products=("hillshade", "dtm"), report=False, memory_gb=2, overwrite=True,
    )  # fmt: skip
    assert config.pyramid.tile > 0
    assert n_tasks == 7


def test_what_a_task_says(zl, monkeypatch):
    monkeypatch.setattr("zlocus.pipeline.array_jobs.run_task", lambda out, number, *_: TaskResult(number, 4, 3))
    done = zl("tiles", "run", "out", 5)
    assert done.stdout == "out: task 5 is finished, 3 of its 4 tiles made. 1 was there already.\n"
    assert zl("tiles", "run", "out", "five").exit_code == 2


def test_the_group_says_its_commands(zl):
    said = zl("tiles", "--help").stdout
    assert all(f"  {name} " in said for name in ("plan", "run", "assemble"))
    assert "from 1 to K" in zl("tiles", "run", "--help").stdout
    assert "  tiles " in zl("--help").stdout
