"""The part of the plugin of QGIS that needs no QGIS: command lines, progress, processes, and its archive.

`make test-qgis` tests the rest in QGIS.
"""

from __future__ import annotations

import ast
import configparser
import importlib.util
import json
import os
import subprocess
import sys
import time
import zipfile

import pytest
from typer.main import get_command

import zlocus
from places import ROOT
from zlocus.cli.app import app
from zlocus.core.requests import COMPARISON_FILES, EVALUATION_FILES, FILLS, METHODS, PRODUCTS
from zlocus.io.styles.file_names import OF_SURFACE, REASONS
from zlocus.products.derived import FILES

QGIS = ROOT / "qgis"
PLUGIN = QGIS / "zlocus_processing"
MODULES = sorted(PLUGIN.glob("*.py"))
PLAIN = ("process", "progress", "results", "words")
WAIT_S = 10.0


@pytest.fixture(scope="module")
def plugin():
    """The package of the plugin, whose plain modules can be imported."""
    spec = importlib.util.spec_from_file_location(
        PLUGIN.name, PLUGIN / "__init__.py", submodule_search_locations=[str(PLUGIN)]
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[PLUGIN.name] = module
    spec.loader.exec_module(module)
    for name in PLAIN:
        setattr(module, name, importlib.import_module(f"{PLUGIN.name}.{name}"))
    yield module
    for name in [name for name in sys.modules if name.partition(".")[0] == PLUGIN.name]:
        del sys.modules[name]


@pytest.fixture
def watcher(plugin):
    class Watched(plugin.process.Watcher):
        def __init__(self):
            self.lines, self.warnings, self.percents, self.cancel_at = [], [], [], None

        def is_canceled(self):
            return self.cancel_at is not None and any(self.cancel_at in line for line in self.lines)

        def say(self, line):
            self.lines.append(line)

        def warn(self, line):
            self.warnings.append(line)

        def set_percent(self, percent):
            self.percents.append(percent)

    return Watched()


def imported(module):
    found = set()
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.name)
def test_the_plugin_imports_only_qgis_and_the_standard_library(module):
    others = {"qgis", "processing"} if module.stem not in PLAIN else set()
    assert imported(module) <= set(sys.stdlib_module_names) | others
    # QGIS 3.22 is also built with Python 3.8.
    ast.parse(module.read_text(encoding="utf-8"), feature_version=(3, 8))


def test_metadata_has_what_qgis_asks_for():
    metadata = configparser.ConfigParser()
    metadata.read(PLUGIN / "metadata.txt", encoding="utf-8")
    general = metadata["general"]
    assert {"name", "description", "about", "author"} <= set(general)
    assert general["version"] == zlocus.__version__
    assert general["qgisMinimumVersion"] == "3.22"
    assert general.getboolean("hasProcessingProvider")
    assert (PLUGIN / general["icon"]).is_file()


def test_the_archive_holds_the_plugin_in_one_folder(tmp_path):
    for name in ("one.zip", "two.zip"):
        subprocess.run([sys.executable, QGIS / "package.py", tmp_path / name], check=True, capture_output=True)
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.zip") as archive:
        names = set(archive.namelist())
        assert archive.read("zlocus_processing/LICENSE") == (ROOT / "LICENSE").read_bytes()
    assert {name.split("/")[0] for name in names} == {"zlocus_processing"}
    assert {f"zlocus_processing/{path.name}" for path in MODULES} < names
    assert {"zlocus_processing/metadata.txt", "zlocus_processing/icon.svg"} < names
    assert not any("__pycache__" in name for name in names)


def test_a_command_line(plugin):
    words = plugin.words
    options = {
        "out": "o", "resolution": 0.5, "bounds": (1.0, -2.25, 3.0, 4.0), "crs": None, "water": "", "partial": False,
        "overwrite": True, "workers": 2,
    }  # fmt: skip
    assert words.command_line("zlocus", "dsm", ["a b.tif", "c.tif"], options, "--set x.y='1 2' --no-report") == [
        "zlocus", "dsm", "a b.tif", "c.tif", "--out", "o", "--resolution", "0.5", "--bounds", "1", "-2.25", "3", "4",
        "--overwrite", "--workers", "2", "--set", "x.y=1 2", "--no-report", "--json",
    ]  # fmt: skip
    with pytest.raises(words.WrongValue, match="Correct the quotation marks"):
        words.additional("'")


def test_all_options_and_values_are_those_of_the_commands():
    """Names of options and choices in the modules that need QGIS, read from their source."""
    commands = get_command(app).commands
    for module, command in (("make_surface", "dsm"), ("evaluate",) * 2, ("products",) * 2, ("compare",) * 2):
        known = {name.lstrip("-") for option in commands[command].params for name in option.opts}
        tree = ast.parse((PLUGIN / f"{module}.py").read_text(encoding="utf-8"))
        (words,) = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "words")
        keys = [key.value for n in ast.walk(words) if isinstance(n, ast.Dict) for key in n.keys]
        assert keys
        assert set(keys) <= known, command
    source = ast.parse((PLUGIN / "make_surface.py").read_text(encoding="utf-8"))
    values = {
        n.targets[0].id: ast.literal_eval(n.value)
        for n in source.body
        if isinstance(n, ast.Assign) and n.targets[0].id in ("METHODS", "FILLS", "MAPS")
    }
    assert values["METHODS"][0] == METHODS[0]
    assert set(values["METHODS"]) <= set(METHODS)
    assert values["FILLS"] == FILLS
    assert set(values["MAPS"]) <= set(PRODUCTS)


def test_layers_are_products_with_styles(plugin):
    results = plugin.results
    assert {shown.name for shown in results.SURFACE} - {REASONS} <= set(OF_SURFACE)
    assert results.EVALUATION[0].name in EVALUATION_FILES
    assert results.COMPARISON[0].name in COMPARISON_FILES
    assert results.MAPS == FILES
    order = [shown.name for shown in results.SURFACE]
    assert order.index("dsm.tif") + 1 == order.index("hillshade.tif"), "its colours darken the hillshade"


def test_inputs(plugin, tmp_path):
    words = plugin.words
    assert words.inputs_of(["a", "b"], "") == ["a", "b"]
    assert words.inputs_of([], "folder") == ["folder"]
    for files, folder in ((["a"], "folder"), ([], "")):
        with pytest.raises(words.WrongValue, match="Give"):
            words.inputs_of(files, folder)
    assert words.pair_of(None, None, "heights") is None
    assert words.pair_of(-5.0, 0.0, "heights") == (-5.0, 0.0)
    with pytest.raises(words.WrongValue, match="Only one end of the heights"):
        words.pair_of(None, 3.0, "heights")
    (tmp_path / "run.json").touch()
    assert words.surface_of(str(tmp_path / "dsm.tif")) == str(tmp_path)
    assert words.surface_of(str(tmp_path / "dtm.tif")) == str(tmp_path / "dtm.tif")


def test_figures_in_words(plugin):
    figures = {"rmse": 1.23456, "median": -0.5, "nmad": None, "completeness": 0.9876}
    assert plugin.words.figures_in_words(figures) == (
        "Surface less reference: median -0.500 m, RMSE 1.235 m, completeness 98.8 %."
    )


@pytest.mark.parametrize(
    ("longitude", "latitude", "code"),
    [(8.5, 47.4, 32632), (-180.0, 0.0, 32601), (180.0, 10.0, 32660), (151.2, -33.9, 32756)],
)
def test_utm_zones(plugin, longitude, latitude, code):
    assert plugin.words.utm_zone(longitude, latitude) == f"EPSG:{code}"


def test_the_program_is_that_of_the_setting_or_on_path(plugin, tmp_path):
    words = plugin.words
    program = tmp_path / "zlocus"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    assert words.found_command("", str(tmp_path)) == str(program)
    assert words.found_command(str(program), "") == str(program)
    with pytest.raises(words.WrongValue, match=r"is not on PATH\. Install it"):
        words.found_command("", str(tmp_path / "none"))
    with pytest.raises(words.WrongValue, match=r"/none is no program\. Correct"):
        words.found_command("/none", str(tmp_path))


def test_the_command_does_not_get_the_libraries_of_qgis(plugin):
    given = {"PYTHONHOME": "/qgis", "GDAL_DATA": "/qgis", "PROJ_LIB": "/qgis", "PATH": "/bin", "ZLOCUS_RATES": "x"}
    assert plugin.words.own_environment(given) == {"PATH": "/bin", "ZLOCUS_RATES": "x", "PYTHONIOENCODING": "utf-8"}


def test_progress_follows_lines_and_tiles_and_never_goes_back(plugin, tmp_path):
    log = tmp_path / "events.jsonl"
    log.write_text('{"event": "began", "n_tiles": 9, "tiles_there": 9}\n')  # of an earlier run
    progress = plugin.progress.CommandProgress(str(tmp_path))
    seen = []

    def line(text):
        progress.read_line(text)
        seen.append(progress.percent)

    def events(text):
        with log.open("a") as file:
            file.write(text)
        progress.read_events()
        seen.append(progress.percent)

    line("Opening images: done in 1.0 s")
    line("Pointing corrected from 3 tie points: img (0.1, 0.2)")
    line("Tie points: done in 2 min 3 s")
    events('{"event": "began", "n_tiles": 4, "tiles_there": 1}\n')
    events('{"event": "tile"}\n{"event": "ti')
    events('le"}\nno JSON\n')
    line("Matching: 1 of 4, 25 %, time left 3.0 s")
    line("Writing: 1 of 2, 50 %, time left 1.0 s")
    line("Products: done in 1.0 s")
    assert seen == [3.0, 3.0, 15.0, 32.5, 50.0, 67.5, 67.5, 87.5, 97.0]
    other = plugin.progress.CommandProgress("", is_surface=False)
    other.read_line("Comparing: 1 of 2, 50 %, time left 1 s")
    assert other.percent == 49.5


def command(tmp_path, code):
    """A program that says what a command would say."""
    path = tmp_path / "said.py"
    path.write_text("import json, signal, sys, time\ndef say(line): print(line, file=sys.stderr, flush=True)\n" + code)
    return [sys.executable, str(path)]


def run(plugin, watcher, words):
    return plugin.process.run_command(words, os.environ, watcher, plugin.progress.CommandProgress())


def test_a_command_that_succeeds(plugin, watcher, tmp_path):
    code = (
        'say("Matching: done in 1 s"); say("zlocus: Beware."); say("Writing: done in 1 s"); print(json.dumps({"a": 1}))'
    )
    ended = run(plugin, watcher, command(tmp_path, code))
    assert (ended.status, ended.answer, ended.error, ended.was_stopped) == (0, {"a": 1}, "", False)
    assert watcher.lines == ["Matching: done in 1 s", "Writing: done in 1 s"]
    assert watcher.warnings == ["zlocus: Beware."]


@pytest.mark.parametrize(
    ("code", "error"),
    [
        ('say("zlocus: No."); print(json.dumps({"error": "No."})); sys.exit(2)', "No."),
        ('say("zlocus: No JSON."); sys.exit(2)', "No JSON."),
        ("sys.exit(3)", "ended with status 3, and said nothing"),
    ],
)
def test_a_command_that_fails_has_one_sentence(plugin, watcher, tmp_path, code, error):
    ended = run(plugin, watcher, command(tmp_path, code))
    assert ended.status in (2, 3)
    assert error in ended.error
    assert not ended.error.startswith("zlocus: ")
    assert watcher.warnings == []


def test_a_program_that_cannot_be_run(plugin, watcher, tmp_path):
    ended = run(plugin, watcher, [str(tmp_path / "none")])
    assert "none cannot be run: No such file or directory. Correct its path" in ended.error


def test_a_command_that_is_stopped_can_tidy_up(plugin, watcher, tmp_path):
    """It gets SIGTERM, and what it says then is read."""
    code = (
        "def ended(*_):\n    say('kept'); print(json.dumps({'error': 'Ended by SIGTERM.'})); sys.exit(143)\n"
        "signal.signal(signal.SIGTERM, ended); say('ready'); time.sleep(60)"
    )
    watcher.cancel_at = "ready"
    begun = time.monotonic()
    ended = run(plugin, watcher, command(tmp_path, code))
    assert ended.was_stopped
    assert ended.error == "Ended by SIGTERM."
    assert watcher.lines == ["ready", "kept"]
    assert time.monotonic() - begun < WAIT_S


def test_a_command_that_does_not_stop_is_killed(plugin, watcher, tmp_path, monkeypatch):
    monkeypatch.setattr(plugin.process, "TIDYING_S", 0.3)
    code = "signal.signal(signal.SIGTERM, signal.SIG_IGN); say('ready'); time.sleep(60)"
    watcher.cancel_at = "ready"
    ended = run(plugin, watcher, command(tmp_path, code))
    assert ended.was_stopped
    assert ended.status == -9


def test_the_answer_of_a_real_command_is_read(plugin, watcher):
    words = plugin.words.command_line(sys.executable, "-m", ["zlocus", "evaluate", "none.tif", "other.tif"], {})
    ended = run(plugin, watcher, words)
    assert ended.status == 2
    assert ended.answer["command"] == "evaluate"
    assert "none.tif" in ended.error
    assert json.dumps(ended.answer)
