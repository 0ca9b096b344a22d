"""Rates of earlier runs: remembered robustly, never worth a failure."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from zlocus.core.jit import CACHE
from zlocus.pipeline.execution import rates
from zlocus.pipeline.execution.rates import MAX_RUNS, TYPICAL, Rate, kind_of, rate_of, rates_file, remember


@pytest.fixture
def file(tmp_path, monkeypatch):
    path = tmp_path / "rates.json"
    monkeypatch.setenv(rates.VARIABLE, str(path))
    return path


def test_nothing_is_known_at_first(file):
    assert rate_of("matching", "RpcModel") == TYPICAL
    assert str(TYPICAL) == "typical rate"
    assert not file.exists()


def test_the_rate_is_the_median_of_earlier_runs(file):
    for seconds in (20.0, 30.0, 900.0):
        remember("matching", "RpcModel", 10.0, seconds)
    found = rate_of("matching", "RpcModel")
    assert found == Rate(3.0, 3)
    assert found.said("matching", 20.0) == "matching about 1 min 0 s (rate measured on 3 earlier runs of this machine)"
    # Of each part and kind of sensor by itself.
    assert rate_of("matching", "FrameModel") == rate_of("writing", "RpcModel") == TYPICAL
    assert str(Rate(2.0, 1)) == "rate measured on 1 earlier run of this machine"


def test_the_latest_runs_count(file):
    for k in range(3 * MAX_RUNS):
        remember("matching", "RpcModel", 10.0, 20.0 if k < 2 * MAX_RUNS else 40.0)
    assert rate_of("matching", "RpcModel") == Rate(4.0, MAX_RUNS)
    assert len(json.loads(file.read_text())["factors"]["matching, RpcModel"]) == MAX_RUNS


@pytest.mark.parametrize(("typical_s", "measured_s"), [(1.0, 4.0), (0.0, 10.0), (1.0, 1e6), (1e6, 10.0)])
def test_what_tells_no_rate_is_not_remembered(file, typical_s, measured_s):
    remember("matching", "RpcModel", typical_s, measured_s)
    assert not file.exists()


DAMAGED = [
    "", "{", "[]", "null", '{"schema": 1}', '{"schema": 1, "typical_s": 3, "factors": []}', "[" * 100_000,
    '{"schema": 1, "typical_s": TYPICAL, "factors": {"matching, RpcModel": "x"}}',
    '{"schema": 1, "typical_s": TYPICAL, "factors": {"matching, RpcModel": [NaN]}}',
    '{"schema": 1, "typical_s": TYPICAL, "factors": {"matching, RpcModel": [-1, 1e300]}}',
    '{"schema": 1, "typical_s": [1, 2, 3, 4, 5], "factors": {"matching, RpcModel": [2.0]}}',
    '{"schema": 2, "typical_s": TYPICAL, "factors": {"matching, RpcModel": [2.0]}}',
]  # fmt: skip


@pytest.mark.parametrize("text", DAMAGED, ids=range(len(DAMAGED)))
def test_a_damaged_or_outdated_file_is_ignored_and_replaced(file, text):
    file.write_text(text.replace("TYPICAL", json.dumps(rates._typical())))
    assert rate_of("matching", "RpcModel") == TYPICAL
    remember("matching", "RpcModel", 10.0, 20.0)
    assert rate_of("matching", "RpcModel") == Rate(2.0, 1)
    assert [path.name for path in file.parent.iterdir()] == ["rates.json"], "written whole or not at all"


def test_a_file_that_cannot_be_written_stops_no_run(tmp_path, monkeypatch):
    monkeypatch.setenv(rates.VARIABLE, str(tmp_path / "not" / "there" / "rates.json"))
    remember("matching", "RpcModel", 10.0, 20.0)
    assert rate_of("matching", "RpcModel") == TYPICAL


def test_rates_lie_beside_the_kernels(monkeypatch):
    assert rates_file() is None, "tests remember nothing"
    monkeypatch.delenv(rates.VARIABLE)
    assert CACHE.temporary is not None or rates_file() == CACHE.folder / "rates.json"
    monkeypatch.setattr(rates, "CACHE", SimpleNamespace(folder=Path("kernels"), temporary=Path("kernels")))
    assert rates_file() is None, "what does not last is of no use"
    monkeypatch.setattr(rates, "CACHE", SimpleNamespace(folder=None, temporary=None))
    assert rates_file() is None


class Plain:
    """A sensor model."""


class Corrected:
    """A corrected sensor model."""

    def __init__(self, base_sensor):
        self.base_sensor = base_sensor


def test_corrections_make_no_other_kind():
    views = [SimpleNamespace(sensor=Corrected(Corrected(Plain()))), SimpleNamespace(sensor=Plain())]
    assert kind_of(views) == "Plain"
    assert kind_of([*views, SimpleNamespace(sensor=3)]) == "Plain and int"
