from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from zlocus.core.errors import OutputError
from zlocus.core.options import RunConfig
from zlocus.core.requests import RankRequest
from zlocus.io.config import config_as_dict
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import (
    Stopwatch,
    inputs_record,
    peak_memory_mb,
    request_as_dict,
    result_record,
    versions_record,
    write_record,
)


def test_stages_are_timed():
    watch = Stopwatch()
    with watch.stage("sleep"):
        time.sleep(0.05)
    with watch.stage("work"):
        end = time.process_time() + 0.05
        while time.process_time() < end:
            pass
    asleep, busy = watch.stages
    assert [asleep["name"], busy["name"]] == ["sleep", "work"]
    assert asleep["wall_s"] >= 0.05 > asleep["cpu_s"]
    assert busy["cpu_s"] >= 0.05


def test_peak_memory_grows_with_an_array():
    before = peak_memory_mb()
    held = np.ones(60_000_000, np.uint8)
    assert peak_memory_mb() >= before
    assert peak_memory_mb() > held.nbytes / 1e6


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc, which Linux has")
def test_peak_memory_is_not_that_of_the_parent_process():
    held = np.ones(600_000_000, np.uint8)
    words = [sys.executable, "-c", "from zlocus.core.resources import peak_memory_mb; print(peak_memory_mb())"]
    found = float(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    assert 5.0 < found < held.nbytes / 1e6 / 2


def test_inputs_are_known_by_their_content(tmp_path):
    path = tmp_path / "a.tif"
    path.write_bytes(b"x" * 3_000_000)
    assert inputs_record([path]) == [{"path": str(path), "sha256": hashlib.sha256(b"x" * 3_000_000).hexdigest()}]


def test_versions_name_what_heights_depend_on():
    versions = versions_record()
    assert {"python", "zlocus", "numpy", "numba", "rasterio", "pyproj"} <= set(versions)
    assert versions["numpy"] == np.__version__


def test_numbers_that_are_not_finite_become_null(tmp_path):
    write_record(tmp_path / "run.json", {"pairs": [{"px": float("nan")}, (np.float64("inf"), 1.5)], "n": 3})
    assert json.loads((tmp_path / "run.json").read_text()) == {
        "schema": 2, "pairs": [{"px": None}, [None, 1.5]], "n": 3,
    }  # fmt: skip


def test_a_record_is_written_atomically(tmp_path):
    write_record(tmp_path / "run.json", {"coverage": 0.5})
    assert json.loads((tmp_path / "run.json").read_text()) == {"schema": 2, "coverage": 0.5}
    assert [p.name for p in tmp_path.iterdir()] == ["run.json"]
    (tmp_path / "taken.json").mkdir()
    with pytest.raises(OutputError, match=r"taken\.json cannot be written"):
        write_record(tmp_path / "taken.json", {})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.json", "taken.json"]


def test_a_request_is_converted_to_json_values():
    request = RankRequest((Path("a.tif"), Path("b.tif")), Path("out"), heights=(1.0, 2.0))
    record = request_as_dict(request)
    assert json.loads(json.dumps(record)) == {
        "inputs": ["a.tif", "b.tif"], "out": "out", "resolution": None, "crs": None, "heights": [1.0, 2.0],
        "workers": 1, "overwrite": False,
    }  # fmt: skip


def test_files_are_named_once_with_their_checksums(tmp_path):
    paths = [tmp_path / name for name in ("a.tif", "b.tif", "camera.txt")]
    for path in paths:
        path.write_text(path.name)
    watch = Stopwatch()
    with watch.stage("open"):
        pass
    inputs = InputFiles.of([*paths, paths[2]]).record()
    record = result_record(RankRequest(tuple(paths[:2]), tmp_path / "out"), RunConfig(), inputs, watch)
    assert [entry["path"] for entry in record["inputs"]] == [str(path) for path in paths]
    assert record["config"]["options"] == config_as_dict(RunConfig())
    assert (record["stages"], list(record)) == (watch.stages, ["config", "versions", "inputs", "stages"])
