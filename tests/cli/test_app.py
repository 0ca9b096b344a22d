"""The command line: what reaches the pipeline, and what a user sees when something is wrong."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

import zlocus
from zlocus.cli.app import app
from zlocus.core import errors
from zlocus.core.options import RunConfig
from zlocus.core.requests import DsmRequest
from zlocus.evaluation.accuracy import Accuracy
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.statistics import ErrorStatistics
from zlocus.io.config import config_as_dict
from zlocus.products.report.command_line import command_line

HEAVY = ("numpy", "numba", "scipy", "rasterio", "pyproj", "cv2", "pydantic", "rich.progress", "matplotlib", "odc")


@pytest.fixture
def zl():
    """Run the command line in this process."""
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture
def pipeline(monkeypatch):
    """A pipeline that records what it is asked, and does what `behave` says."""

    class Pipeline:
        request: DsmRequest
        config: RunConfig

        def behave(self) -> Any:
            return SimpleNamespace(
                sentence="OUT: 98.7 % of the cells have a height.", as_dict=lambda: {"coverage": 0.987}
            )

        def run_dsm(self, request, config, progress):
            self.request, self.config = request, config
            return self.behave()

        def run_demo(self, out, progress):
            out.mkdir(exist_ok=True)
            figures = ErrorStatistics(1000, 0.99, 0.98, 0.01, 0.123, 0.2, 0.3)
            accuracy = Accuracy(figures, {"ground": figures})
            evaluations = tuple(Evaluation(accuracy, limit) for limit in (0.42, 1.0))
            return SimpleNamespace(out=out, evaluations=evaluations)

    fake = Pipeline()
    for name in ("zlocus.pipeline.dsm", "zlocus.pipeline.demo"):
        monkeypatch.setitem(sys.modules, name, fake)
    return fake


def one_sentence(result) -> str:
    """What stands on stderr: one line that starts with the program's name, no trace."""
    assert result.stderr.startswith("zlocus: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def test_help_imports_nothing_heavy():
    code = f"import sys, zlocus.cli.app; print([m for m in {HEAVY} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_version(zl):
    assert zl("--version").stdout == f"zlocus {zlocus.__version__}\n"
    assert json.loads(zl("--json", "--version").stdout) == {
        "command": "", "version": zlocus.__version__, "exit_status": 0,
    }  # fmt: skip
    refused = zl("--json", "dsm", "a.tif")
    assert refused.exit_code == 2
    assert "it goes with --version, or after the name of a command" in refused.stderr


@pytest.mark.parametrize(
    "command",
    [
        [],
        ["demo"],
        ["dsm"],
        ["cloud"],
        ["curves"],
        ["paper"],
        ["doctor"],
        ["evaluate"],
        ["config"],
        ["tiles"],
        ["tiles", "plan"],
        ["tiles", "run"],
        ["tiles", "assemble"],
    ],
)
def test_every_command_has_help(zl, command):
    result = zl(*command, "--help")
    assert result.exit_code == 0
    assert "Usage: " in result.stdout


def test_dsm_options_reach_the_pipeline(zl, pipeline, tmp_path):
    result = zl(
        "dsm", "a.tif", "b.tif", "-o", tmp_path / "out", "--resolution", 0.5, "--crs", "EPSG:32631",
        "--bounds", 1, 2, 3, 4, "--area", "area.gpkg", "--mask", "mask.gpkg", "--heights", -10, 50,
        "--reference", "a", "--views", "all", "--method", "mvll", "--vertical", "ellipsoid", "--fill", "interpolate",
        "--partial", "--workers", 2, "--memory", 3, "--overwrite",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert pipeline.config == RunConfig()
    assert pipeline.request == DsmRequest(
        inputs=(Path("a.tif"), Path("b.tif")), out=tmp_path / "out", resolution=0.5, crs="EPSG:32631",
        bounds=(1, 2, 3, 4), area=Path("area.gpkg"), mask=Path("mask.gpkg"), heights=(-10, 50), reference="a",
        views="all", method="mvll", vertical="ellipsoid", fill="interpolate", partial=True, workers=2, memory_gb=3,
        overwrite=True,
    )  # fmt: skip
    assert "98.7 %" in result.stdout


def test_the_command_of_the_report_asks_for_the_same_surface(zl, pipeline, tmp_path):
    config = RunConfig()
    config = replace(
        config, pyramid=replace(config.pyramid, tile=300), products=replace(config.products, contours_of="dtm")
    )
    request = DsmRequest(
        inputs=(Path("a b.tif"), Path("it's.tif")), out=tmp_path / "out", resolution=0.1, bounds=(1, 2, 3.25, 4),
        heights=(-10.5, 50), partial=True, memory_gb=3, vertical="egm96", fill="interpolate",
        products=("hillshade", "dtm"), report=False, water=Path("w.gpkg"), level_water=True,
    )  # fmt: skip
    asked = {field.name: getattr(request, field.name) for field in fields(request)}
    run = {"config": {"request": json.loads(json.dumps(asked, default=str)), "options": config_as_dict(config)}}
    program, *words = shlex.split(command_line(run))
    assert program == "zlocus"
    result = zl(*words)
    assert result.exit_code == 0, result.output
    assert pipeline.request == request
    assert pipeline.config == config


@pytest.mark.parametrize(
    ("arguments", "method"),
    [([], "mvll-sgm"), (["--selection", "paper"], "mvll"), (["--selection", "paper", "--method", "gc3"], "gc3")],
)
def test_each_selection_has_its_own_method(zl, pipeline, tmp_path, arguments, method):
    result = zl("dsm", "a.tif", "b.tif", "-o", tmp_path / "out", *arguments)
    assert result.exit_code == 0, result.output
    assert pipeline.request.method == method
    assert pipeline.request.selection == ("paper" if arguments else "default")


def test_like_and_dem_reach_the_pipeline(zl, pipeline, tmp_path):
    result = zl("dsm", "scene.yaml", "-o", tmp_path / "out", "--like", "like.tif", "--dem", "dem.tif")
    assert result.exit_code == 0, result.output
    assert (pipeline.request.like, pipeline.request.dem) == (Path("like.tif"), Path("dem.tif"))


def test_dsm_reads_its_configuration(zl, pipeline, tmp_path):
    (tmp_path / "mine.toml").write_text("[orientation]\ninlier_px = 0.5\n")
    assert zl("dsm", "scene.yaml", "-o", tmp_path / "out", "--config", tmp_path / "mine.toml").exit_code == 0
    assert pipeline.config.orientation.inlier_px == 0.5


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["a.tif"], "There is no file a.tif"),
        ([__file__], "two images or more"),
        (["a.tif", "?.tif"], "No file matches ?.tif"),
        (["a.tif", "a.tif"], "given twice"),
        (["a.tif", "scene.yaml"], "must be the only input"),
        (["a.tif", "b.tif", "--resolution", "0"], "--resolution 0"),
        (["a.tif", "b.tif", "--resolution", "-1"], "--resolution -1"),
        (["a.tif", "b.tif", "--resolution", "nan"], "--resolution nan"),
        (["a.tif", "b.tif", "--resolution", "inf"], "--resolution inf"),
        (["a.tif", "b.tif", "--heights", "50", "10"], "--heights 50 10"),
        (["a.tif", "b.tif", "--heights", "10", "10"], "--heights 10 10"),
        (["a.tif", "b.tif", "--heights", "nan", "10"], "--heights nan 10"),
        (["a.tif", "b.tif", "--bounds", "3", "0", "1", "5"], "--bounds 3 0 1 5"),
        (["a.tif", "b.tif", "--bounds", "0", "5", "1", "5"], "--bounds 0 5 1 5"),
        (["a.tif", "b.tif", "--bounds", "0", "0", "1", "inf"], "--bounds 0 0 1 inf"),
        (["a.tif", "b.tif", "--heights", "1", "2", "--dem", "d.tif"], "exclude each other"),
        (["a.tif", "b.tif", "--like", "l.tif", "--crs", "EPSG:32631"], "Leave out --crs"),
        (["a.tif", "b.tif", "--method", "magic"], "--method magic"),
        (["a.tif", "b.tif", "--views", "some"], "--views some"),
        (["a.tif", "b.tif", "--selection", "some"], "--selection some is not known"),
        (["a.tif", "b.tif", "--selection", "paper", "--method", "mvll-sgm"], "which takes mvll or gc3. Give one of"),
        (["a.tif", "b.tif", "--selection", "paper", "--method", "gc3-sgm"], "--method gc3-sgm does not go with"),
        (["a.tif", "b.tif", "--method", "gc3"], "--selection default, which takes mvll-sgm or mvll or gc3-sgm"),
        (["a.tif", "b.tif", "--selection", "paper", "--views", "all"], "--views all contradicts that"),
        (["a.tif", "b.tif", "--selection", "paper", "--dem", "d.tif"], "--dem d.tif contradicts that"),
        (["a.tif", "b.tif", "--selection", "guided", "--views", "all"], "--views all contradicts that"),
        (["a.tif", "b.tif", "--selection", "guided", "--method", "gc3-sgm"], "does not go with --selection guided"),
        (["a.tif", "b.tif", "--fill", "dreams"], "--fill dreams"),
        (["a.tif", "b.tif", "--vertical", "moon"], "--vertical moon"),
        (["a.tif", "b.tif", "--workers", "0"], "--workers 0"),
        (["a.tif", "b.tif", "--memory", "0"], "--memory 0"),
        (["a.tif", "b.tif", "--config", "missing.toml"], "missing.toml cannot be read"),
    ],
)
def test_bad_request_is_one_sentence_and_writes_nothing(zl, pipeline, tmp_path, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    result = zl("dsm", *arguments, "-o", "out")
    assert result.exit_code == 2
    assert says in one_sentence(result)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [["dsm"], ["dsm", "a", "b"], ["fly"], ["dsm", "a", "b", "-o", "o", "--fast"]])
def test_bad_usage_exits_2(zl, arguments):
    assert zl(*arguments).exit_code == 2


def test_output_that_is_a_file(zl, pipeline, tmp_path):
    (tmp_path / "out").write_text("mine")
    result = zl("dsm", "a.tif", "b.tif", "-o", tmp_path / "out", "--overwrite")
    assert result.exit_code == 2
    assert "is a file" in one_sentence(result)
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("out", ["file/out", "/proc/zlocus-out"])
def test_output_that_cannot_be_written(zl, pipeline, tmp_path, monkeypatch, out):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    result = zl("dsm", "a.tif", "b.tif", "-o", out)
    assert result.exit_code == 2
    assert "cannot be written" in one_sentence(result)


def test_another_run_is_kept_without_overwrite(zl, pipeline, tmp_path):
    (tmp_path / "run.json").write_text("{}")
    refused = zl("dsm", "a.tif", "b.tif", "-o", tmp_path)
    assert refused.exit_code == 2
    assert "holds another run" in one_sentence(refused)
    assert zl("dsm", "a.tif", "b.tif", "-o", tmp_path, "--overwrite").exit_code == 0


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (errors.InputError, 2),
        (errors.ConfigError, 2),
        (errors.GeometryError, 2),
        (errors.OutputError, 2),
        (errors.CoverageError, 3),
        (KeyboardInterrupt, 130),
        (ZeroDivisionError, 1),
    ],
)
def test_every_error_has_its_exit_status(zl, pipeline, tmp_path, error, status):
    def fail() -> None:
        raise error("what, where, what to do.")

    pipeline.behave = fail
    result = zl("dsm", "a.tif", "b.tif", "-o", tmp_path / "out")
    assert result.exit_code == status
    sentence = one_sentence(result)
    assert ("what, where, what to do." in sentence) == (error is not KeyboardInterrupt)
    assert ("--verbose" in sentence) == (status == 1)


def test_verbose_shows_the_trace(zl, pipeline, tmp_path):
    pipeline.behave = lambda: 1 / 0
    assert "Traceback" in zl("dsm", "a.tif", "b.tif", "-o", tmp_path / "out", "--verbose").stderr


def test_demo_prints_accuracy_and_may_be_repeated(zl, pipeline, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = zl("demo")
    assert result.exit_code == 0, result.output
    assert "99.00 %" in result.stdout
    assert "0.123" in result.stdout
    assert "less than 0.42 m" in result.stdout
    accuracy = json.loads(Path("demo/accuracy.json").read_text())
    assert list(accuracy) == ["within_0.42_m", "within_1_m"]
    assert accuracy["within_0.42_m"]["all"]["nmad"] == 0.123
    Path("demo/dsm.tif").touch()
    assert zl("demo").exit_code == 0


def test_demo_keeps_other_runs(zl, pipeline, tmp_path):
    (tmp_path / "dsm.tif").touch()
    assert zl("demo", "-o", tmp_path).exit_code == 2


def test_config_is_printed_or_written_once(zl, tmp_path):
    printed = zl("config").stdout
    assert "[orientation]" in printed
    assert zl("config", "-o", "-").stdout == printed
    assert zl("config", "-o", tmp_path / "all.toml").exit_code == 0
    assert (tmp_path / "all.toml").read_text() == printed
    again = zl("config", "-o", tmp_path / "all.toml")
    assert again.exit_code == 2
    assert "exists already" in one_sentence(again)


def test_warnings_of_ours_are_sentences(tmp_path):
    code = (
        "import warnings, zlocus.cli.app as cli, zlocus.io.config as c; from zlocus.core.errors import ZlocusWarning; "
        "c.write_config = lambda _: warnings.warn('mind this.', ZlocusWarning) or ''; cli.main(['config'])"
    )
    environment = {**os.environ, "PYTHONWARNINGS": "default"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert run.stderr == "zlocus: mind this.\n"
