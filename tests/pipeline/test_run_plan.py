"""What a plan says of the time of a run, and what it learns from earlier runs."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from rendered_scenes import HEIGHTS, SMALL_TILES
from zlocus.core.options import RunConfig
from zlocus.core.progress import LineProgress
from zlocus.core.requests import CloudRequest, DsmRequest
from zlocus.pipeline.cloud import run_cloud
from zlocus.pipeline.dsm import run_dsm
from zlocus.pipeline.execution import rates
from zlocus.pipeline.execution.rates import Rate, rate_of
from zlocus.pipeline.run_plan import ORIENTATION, Plan, matching_of, remember_run, timed_stages

PLAN = Plan(
    n_tiles=6, slots=2, processes=True, tile_bytes=5e8, own_bytes=3e8, allowed_bytes=4e9, kept_bytes=0, seconds=120.0,
    write_s=10.0,
)  # fmt: skip
INPUTS = (Path("a.tif"), Path("b.tif"))
VIEWS = [SimpleNamespace(sensor=3, image=SimpleNamespace(shape=(1000, 1000)))] * 2


def test_a_plan_says_how_long_each_part_takes_and_how_that_is_known():
    assert str(PLAN) == (
        "Plan: 6 tiles, 2 at a time in processes of their own, about 1.3 GB of memory (of 4 GB) and 1 min 10 s: "
        "matching about 1 min 0 s (typical rate), writing about 10.0 s (typical rate)."
    )
    learned = Plan(**vars(PLAN) | {"match_rate": Rate(2.0, 4), "write_rate": Rate(0.5, 1), "n_images": 3})
    assert str(learned) == (
        "Plan: 6 tiles of 3 images, 2 at a time in processes of their own, about 1.3 GB of memory (of 4 GB) and "
        "2 min 5 s: matching about 2 min 0 s (rate measured on 4 earlier runs of this machine), writing about 5.0 s "
        "(rate measured on 1 earlier run of this machine)."
    )


@pytest.fixture
def remembered(tmp_path, monkeypatch):
    """Rates of short runs are remembered in a file."""
    monkeypatch.setenv(rates.VARIABLE, str(tmp_path / "rates.json"))
    monkeypatch.setattr(rates, "MIN_MEASURED_S", 0.0)
    return tmp_path / "rates.json"


def test_a_run_is_remembered_part_by_part(remembered):
    request = DsmRequest(INPUTS, Path("out"))
    stages = [{"name": name, "wall_s": wall_s} for name, wall_s in (("orient", 12.0), ("match", 180.0), ("write", 5.0))]
    remember_run(PLAN, request, VIEWS, stages)
    assert rate_of(matching_of(request), "int") == Rate(3.0, 1)
    assert rate_of("writing", "int") == Rate(0.5, 1)
    assert rate_of(ORIENTATION, "int").n_runs == 1
    # Another method has a rate of its own, and so has a cloud.
    others = DsmRequest(INPUTS, Path("out"), method="mvll"), CloudRequest(INPUTS, Path("out"))
    assert [rate_of(matching_of(other), "int").n_runs for other in others] == [0, 0]


def test_compiling_and_clusters_tell_no_rate(remembered):
    stages = [{"name": "orient", "wall_s": 100.0}, {"name": "match", "wall_s": 180.0}]
    assert [stage["name"] for stage in timed_stages(stages, is_compiled=False)] == ["match"]
    assert timed_stages(stages, is_compiled=True) == stages
    remember_run(Plan(**vars(PLAN) | {"scheduler": "tcp://x"}), DsmRequest(INPUTS, Path("out")), VIEWS, stages)
    assert not remembered.exists()


def test_the_second_surface_says_what_the_first_one_took(images, remembered, tmp_path):
    said = []
    for _ in range(2):
        text = io.StringIO()
        request = DsmRequest(
            images("sine").inputs, tmp_path / "out", crs="EPSG:32632", resolution=0.5, heights=HEIGHTS, report=False,
            workers=1, overwrite=True,
        )  # fmt: skip
        run_dsm(request, SMALL_TILES, LineProgress(text))
        said.append(text.getvalue())
    check_second(said)
    events = (tmp_path / "out" / "events.jsonl").read_text().splitlines()
    (began,) = [event for event in map(json.loads, events) if event["event"] == "began"]
    assert began["match_rate"]["n_runs"] == 1


def test_the_second_cloud_says_what_the_first_one_took(images, remembered, tmp_path):
    said = []
    for _ in range(2):
        text = io.StringIO()
        request = CloudRequest(
            images("sine").inputs, tmp_path / "out", crs="EPSG:32632", heights=HEIGHTS, overwrite=True
        )  # fmt: skip
        run_cloud(request, RunConfig(), LineProgress(text))
        said.append(text.getvalue())
    check_second(said)


def check_second(said):
    """The first plan has typical rates, and the second one those of the first run: its matching took what it says."""
    for text, source in zip(said, ("typical rate", "rate measured on 1 earlier run of this machine"), strict=True):
        (plan,) = [line for line in text.splitlines() if line.startswith("Plan: ")]
        assert re.search(rf"matching about [\d.]+ s \({source}\), writing about [\d.]+ s \({source}\)\.$", plan), plan
        assert text.index("Reading the images and finding tie points takes about ") < text.index("Tie points: done")
    took = float(re.findall(r"Matching: done in ([\d.]+) s", said[0])[0])
    assert float(re.findall(r"matching about ([\d.]+) s", said[1])[0]) == pytest.approx(took, rel=0.4, abs=0.5)
