"""The comparison with other programs, run on small scenes, with stand-ins for what only its own environments have."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml

import judging
import peers.__main__ as command
from benchmark_scripts import BENCHMARKS, run_script, write_photographs
from peers import cars, environments, own, running, scenes
from peers import middlebury as photographs
from peers.results import Results

CORE = min(os.sched_getaffinity(0))
SIDE = 96
# Of a town of 48 m that two images see: a surface that is anything like it.
LEAST_WITHIN = 0.7


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(text).lstrip(), encoding="utf-8")
    path.chmod(0o755)
    return path


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> environments.Environment:
    """What stands for an environment of the comparison: a folder whose programs are those of this one."""
    folder = tmp_path_factory.mktemp("environment")
    for name in ("python", "zlocus"):
        program = sys.executable if name == "python" else Path(sys.executable).with_name(name)
        executable(folder / "bin" / name, f'#!/bin/sh\nexec "{program}" "$@"\n')
    (folder / environments.STAMP).write_text("0123456789ab", encoding="utf-8")
    return environments.Environment(folder)


def test_zlocus_alone_is_compared_with_the_truth(here, tmp_path, monkeypatch, capsys):
    """The command from its options to its page, with this environment in place of one that is installed."""
    monkeypatch.setattr(command, "this_checkout", lambda folder: here)
    monkeypatch.setattr(judging, "JUDGE", tmp_path / "none")
    # The small scene that fills caches is the scene that is measured, and is rendered once.
    town = scenes.Rendered("city", 211, 640, views=(2,))
    monkeypatch.setattr(running, "WARM_UP", town)
    monkeypatch.setattr(running, "RENDERED", {"town": replace(town, side=1024)})
    out = tmp_path / "peers"
    asked = ["--scenes", "town", "--programs", "zlocus", "s2p", "MicMac", "--micmac", tmp_path / "mm3d"]
    asked += ["--side", SIDE, "--runs", 1, "--cores", CORE, "--out", out]
    run_script(monkeypatch, command, *asked)
    told = capsys.readouterr()
    assert told.out == f"{out}/peers.md\n"
    assert f"MicMac is left out: {tmp_path}/mm3d is no program that can be run" in told.err
    found = json.loads((out / "results.json").read_text())
    assert list(found["programs"]) == ["zlocus"]
    assert found["programs"]["zlocus"]["code"] == "0123456789ab"
    scene = f"town of {SIDE} cells, 2 views"
    assert found["scenes"][scene] == {
        "kind": "city", "views": 2, "million_cells": SIDE**2 / 1e6, "pairs": 1, "truth": True,
    }  # fmt: skip
    (row,) = found["surfaces"]
    assert (row["scene"], row["program"], row["cores"]) == (scene, "zlocus", [CORE])
    assert row["surface"] == f"surfaces/town-of-{SIDE}-cells-2-views/zlocus/zlocus/dsm.tif"
    assert LEAST_WITHIN < row["classes"]["all"]["within"] <= 1
    assert 0.3 < row["cpu_s"] < 60
    assert 0.05 < row["peak_gb"] < 4
    page = (out / "peers.md").read_text(encoding="utf-8")
    assert f"## Town of {SIDE} cells, 2 views: 0.01 M cells, 1 pair" in page
    assert f"| zlocus | {row['cpu_s'] / (SIDE**2 / 1e6):.1f} |" in page
    # What was measured is not measured again, and corrections that zlocus found are handed to others.
    run_script(monkeypatch, command, *asked)
    assert json.loads((out / "results.json").read_text())["surfaces"] == found["surfaces"]
    (measured,) = running.scenes(running.PeerComparison(["town"], side=SIDE), out)
    shifts = own.shifts(out / "surfaces" / measured.slug / "zlocus", measured)
    assert shifts.keys() == {"n1", "f1"}
    assert np.abs(list(shifts.values())).max() < 0.5
    assert own.shifts(tmp_path, measured) == {}


def test_the_command_writes_the_page_of_results(tmp_path):
    """As a user starts it; the page is that of the documents."""
    script = [sys.executable, BENCHMARKS / "peers", "--page", tmp_path]
    done = subprocess.run(script, check=True, capture_output=True, text=True)
    assert done.stdout == f"{tmp_path}/peers.md\n"
    written = (tmp_path / "peers.md").read_bytes()
    assert written == (BENCHMARKS.parent / "docs" / "reference" / "peers.md").read_bytes()


def test_scenes_asked_for_are_rendered(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "RENDERED", {"town": scenes.Rendered("city", 5, 1024, views=(2, 3))})
    monkeypatch.setattr(
        scenes.Rendered, "scenes", lambda self, name, folder: [(name, self.side, n) for n in self.views]
    )
    sides = running.scenes(running.PeerComparison(["town"], side=64), tmp_path)
    assert list(sides) == [("town of 64 cells", 64, 2), ("town of 64 cells", 64, 3)]
    assert list(running.scenes(running.PeerComparison(["town"]), tmp_path)) == [("town", 1024, 2), ("town", 1024, 3)]
    assert list(running.scenes(running.PeerComparison(["hills"]), tmp_path)) == []


def test_aggregation_is_timed_beside_other_programs(here, tmp_path, monkeypatch, capsys):
    """OpenCV is here too; programs that are not installed are told, and the others' figures stay."""
    results = Results(tmp_path / "results.json", (CORE,))
    running.speeds(results, {"matchers": here}, CORE, side=64, all_heights=(16,), turns=1)
    rows = {(row["program"], row["form"]): row for row in results.found["kernels"]}
    forms = {"zlocus": ["one predecessor (sgm)", "two predecessors (mgm, the default)"],
             "opencv": ["StereoSGBM, MODE_HH, costs and minima included"]}  # fmt: skip
    for program, names in forms.items():
        assert [form for name, form in rows if name == program] == names
    for row in rows.values():
        assert row["heights"] == 16
        assert 0.5 < row["million_cell_steps_per_s"] < 20_000
    told = capsys.readouterr().err
    for program, package in (("libsgm", "c_libsgm"), ("pandora", "pandora")):
        is_here = any(name == program for name, _ in rows)
        assert is_here or f"No module named '{package}'" in told, program
    # Nothing is timed again while the programs are the same.
    monkeypatch.setattr(running, "measured", None)
    known = {"matchers": here} if {name for name, _ in rows} == {"zlocus", "opencv", "libsgm", "pandora"} else {}
    running.speeds(results, known, CORE, side=64, all_heights=(16,), turns=1)


def test_photographs_are_matched_by_all(here, tmp_path, monkeypatch, capsys):
    """Of the cases that are at hand, here one: zlocus and OpenCV, and what became of Pandora."""
    monkeypatch.setenv("ZLOCUS_TEST_DATA", str(tmp_path))
    write_photographs(tmp_path / "middlebury_multiview" / "teddy")
    results = Results(tmp_path / "results.json", (CORE,))
    photographs.middlebury(results, tmp_path / "out", {"matchers": here}, (CORE,))
    rows = {row["program"]: row for row in results.found["middlebury"]}
    assert {row["case"] for row in rows.values()} == {"teddy, 2 views"}
    assert 0 <= rows["zlocus"]["bad_percent"] < 8
    assert 0 <= rows["OpenCV SGBM"]["bad_percent"] < 20
    assert "Pandora" in rows or "No module named 'pandora'" in capsys.readouterr().err


# Of Pandora: what a job asks of it, and what its files mean.
PANDORA = """
#!/usr/bin/env python
import json, pathlib, sys
import numpy as np, rasterio
config, out = json.loads(pathlib.Path(sys.argv[1]).read_text()), pathlib.Path(sys.argv[2])
assert config["input"]["left"]["disp"] == [-15, 0], config
assert config["pipeline"] == {"step": "by its documents"}
disparity, mask = np.full((2, 3), -9.0, np.float32), np.zeros((2, 3), np.uint16)
disparity[0, 0], mask[0, 1], mask[1, 2] = -4.5, 1, 2
for name, values in (("left_disparity", disparity), ("left_validity_mask", mask)):
    profile = {"driver": "GTiff", "height": 2, "width": 3, "count": 1, "dtype": values.dtype}
    with rasterio.open(out / f"{name}.tif", "w", **profile) as file:
        file.write(values, 1)
"""


def test_disparities_of_pandora_point_to_the_left(tmp_path):
    """It counts to the right, and marks what is invalid in a mask of many bits, of which the odd ones matter here."""
    folder = tmp_path / "environment"
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "python").symlink_to(sys.executable)
    executable(folder / "bin" / "pandora", PANDORA.replace("/usr/bin/env python", str(folder / "bin" / "python")))
    executable(tmp_path / "stand-in" / "pandora" / "__init__.py", "")
    executable(
        tmp_path / "stand-in" / "pandora" / "constants.py", "class Criteria:\n    PANDORA_MSK_PIXEL_INVALID = 0b101\n"
    )
    pair = {"left": "l.tif", "right": "r.tif", "first": 0, "count": 16, "disparity": str(tmp_path / "0.npy")}
    job = tmp_path / "job.json"
    job.write_text(json.dumps({"pairs": [pair], "options": {"pipeline": {"step": "by its documents"}}}))
    packages = os.pathsep.join([str(tmp_path / "stand-in"), str(Path(np.__file__).parents[1])])
    subprocess.run([folder / "bin" / "python", BENCHMARKS / "peers" / "match_pandora.py", job], check=True,
                   env=os.environ | {"PYTHONPATH": packages})  # fmt: skip
    np.testing.assert_array_equal(np.load(tmp_path / "0.npy"), [[4.5, np.nan, 9.0], [9.0, 9.0, 9.0]])


def test_cars_is_run_with_its_configuration(small_town, tmp_path):
    """Its command gets a file with all of the scene; its surface is where its documents say."""
    program = executable(
        tmp_path / "environment" / "bin" / "cars",
        f"""
        #!{sys.executable}
        import pathlib, shutil, sys, yaml
        config = yaml.safe_load(pathlib.Path(sys.argv[1]).read_text())
        out = pathlib.Path(config["output"]["directory"]) / "dsm"
        out.mkdir(parents=True)
        shutil.copy(config["input"]["initial_elevation"]["dem"], out / "dsm.tif")
        """,
    )
    with rasterio.open(small_town / "truth_dsm.tif") as file:
        bounds, crs = tuple(file.bounds), file.crs.to_string()
    images = {name: small_town / f"img_{name}.tif" for name in ("n1", "f1", "b1")}
    scene = scenes.Scene("town", "city", images, crs, bounds, (420.0, 460.0), small_town / "truth_dsm.tif")
    dsm, used = cars.Cars(environments.Environment(program.parents[1])).run(scene, tmp_path / "run", (CORE,))
    assert dsm.read_bytes() == (small_town / "truth_dsm.tif").read_bytes()
    assert used.cpu_s > 0
    config = yaml.safe_load((tmp_path / "run" / "cars.yaml").read_text(encoding="utf-8"))
    assert sorted(config["input"]["sensors"]) == ["b1", "f1", "n1"]
    assert config["output"]["resolution"] == 0.5


# A Python that makes environments in no time, and says what was asked of it.
MAKER = """
#!/bin/sh
echo "$@" >> {log}
case "$*" in
    *missing*) echo "no matching distribution" >&2; exit 1;;
    "-m venv"*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python";;
esac
"""


def test_an_environment_is_made_once_for_what_is_wanted(tmp_path):
    log = tmp_path / "log"
    python = executable(tmp_path / "python", MAKER.format(log=log))
    place = environments.Environment(tmp_path / "made")

    def make(wanted, *what):
        environments.made(place, wanted, lambda: python, [*what])
        return (place.folder / environments.STAMP).read_text()

    assert make("one", "a", "b") == make("one", "a", "b") == "one"
    lines = log.read_text().splitlines()
    assert lines == [
        f"-m venv {place.folder}",
        "-m pip install --quiet --disable-pip-version-check --prefer-binary a b",
    ]
    (place.folder / "left-over").touch()
    assert make("another", "c") == "another"
    assert not (place.folder / "left-over").exists()
    assert len(log.read_text().splitlines()) == 4
    # What cannot be installed is told, and is tried again next time.
    with pytest.raises(environments.Missing, match="missing` failed: no matching distribution"):
        make("third", "missing")
    assert not (place.folder / environments.STAMP).exists()


def test_what_is_installed_of_this_checkout_is_its_code(tmp_path, monkeypatch):
    """A copy without what runs have left in it; another state of the code is another environment."""
    seen = []

    def made(environment, wanted, python, what):
        copy = Path(what[0])
        seen.append((environment.folder, wanted, {path.relative_to(copy).as_posix() for path in copy.rglob("*.*")}))
        return environment

    monkeypatch.setattr(environments, "made", made)
    root = tmp_path / "checkout"
    for name in ("pyproject.toml", "README.md", "LICENSE", "src/zlocus/cli.py", "src/zlocus/__pycache__/cli.pyc"):
        executable(root / name, name)
    monkeypatch.setattr(environments, "ROOT", root)
    environments.this_checkout(tmp_path / "environments")
    executable(root / "src" / "zlocus" / "cli.py", "changed")
    environments.this_checkout(tmp_path / "environments")
    (folder, before, files), (_, after, _) = seen
    assert folder == tmp_path / "environments" / "zlocus"
    assert files == {"pyproject.toml", "README.md", "src/zlocus/cli.py"}
    assert before != after


def test_versions_of_an_environment_are_read(here):
    assert here.versions("numpy", "rasterio") == {"numpy": np.__version__, "rasterio": rasterio.__version__}
    assert own.Own(here).versions().keys() == {"zlocus", "numba", "numpy", "opencv-python-headless", "code"}


def test_satellite_scenes_are_those_of_the_shared_data(shared_data, tmp_path, monkeypatch):
    """Their area is what two images see, and the terrain model reaches beyond it."""
    triplet, pair = scenes.shared(tmp_path / "scenes")
    assert (triplet.name, len(triplet.images), len(triplet.pairs)) == ("Pleiades triplet", 3, 3)
    assert (pair.name, len(pair.images), len(pair.pairs)) == ("Pleiades pair", 2, 1)
    for scene in (triplet, pair):
        assert 0.05 < scene.million_cells < 20
        assert scene.heights[0] < scene.heights[1]
        with rasterio.open(scene.terrain) as file:
            west, south, east, north = rasterio.warp.transform_bounds(scene.crs, file.crs, *scene.bounds)
            assert file.bounds.left < west < east < file.bounds.right
            assert file.bounds.bottom < south < north < file.bounds.top
            assert np.isfinite(file.read(1)).all()
    monkeypatch.delenv("ZLOCUS_TEST_DATA")
    assert scenes.shared(tmp_path / "scenes") == []
