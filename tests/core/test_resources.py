"""What a run says that it needs, and what its processes hold."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import rasterio

from zlocus.core.jit import CACHE
from zlocus.core.resources import TILE_CODE_BYTES, WORKER_BYTES, held_bytes


def n_kernels():
    """Number of the kernels that are compiled."""
    return 0 if CACHE.folder is None else sum(1 for _ in CACHE.folder.rglob("*.nbc"))


def measured(words, out, folder, tile):
    """A run whose kernels are compiled already: compiling needs memory of its own, once. What it said, and its
    records."""
    options = folder / "options.toml"
    options.write_text(f"[pyramid]\ntile = {tile}\n")
    words = [
        sys.executable, "-m", "zlocus", "dsm", *map(str, words), "-o", str(out), "--config", str(options), "--no-report"
    ]  # fmt: skip
    for _ in range(2):
        before = n_kernels()
        run = subprocess.run([*words, "--overwrite"], capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        if n_kernels() == before > 0:
            break
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    return run.stderr, json.loads((out / "run.json").read_text()), events


def assert_under_the_plan(said, record, events):
    (plan,) = (event for event in events if event["event"] == "began")
    tiles = [event for event in events if event["event"] == "tile"]
    assert tiles
    match = next(stage for stage in record["stages"] if stage["name"] == "match")
    if plan["processes"]:
        assert max(tile["peak_mb"] for tile in tiles) <= plan["tile_bytes"] / 1e6
    else:
        assert match["peak_mb"] <= (plan["own_bytes"] + plan["tile_bytes"]) / 1e6
    assert plan["own_bytes"] + plan["slots"] * plan["tile_bytes"] <= plan["allowed_bytes"]
    told = re.search(r"about ([\d.]+) GB of memory \(of ([\d.]+) GB\)", said)
    assert told is not None
    assert float(told[1]) == pytest.approx((plan["own_bytes"] + plan["slots"] * plan["tile_bytes"]) / 1e9, rel=0.05)
    # No plan that holds whatever happens: it is not far from what is needed.
    assert plan["tile_bytes"] / 1e6 < 2.5 * max(tile["peak_mb"] for tile in tiles)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_stays_under_its_plan(images, tmp_path, workers):
    words = [*images("sine").inputs, "--crs", "EPSG:32632", "--resolution", 0.5, "--workers", workers, "--memory", 4]
    assert_under_the_plan(*measured(words, tmp_path / "out", tmp_path, 80))


@pytest.mark.parametrize(("scene", "resolution"), [("rendered-city", 0.5), ("rendered-hills-biased", 1.0)])
def test_runs_of_many_images_stay_under_their_plans(shared_data, tmp_path, scene, resolution):
    """Eight images in two tiles, and cells of several pixels."""
    inputs = sorted((shared_data / scene).glob("img_*.tif"))
    with rasterio.open(shared_data / scene / "truth_dsm.tif") as truth:
        west, south, east, north = truth.bounds
        middle, above = (south + share * (north - south) for share in (0.5, 0.65))
        area = ["--crs", truth.crs.to_string(), "--bounds", west, middle, east, above]
    words = [*inputs, *area, "--resolution", resolution, "--workers", 2, "--memory", 6]
    assert_under_the_plan(*measured(words, tmp_path / "out", tmp_path, 350))


def test_as_many_workers_as_memory_allows(images, tmp_path):
    words = [*images("sine").inputs, "--crs", "EPSG:32632", "--resolution", 0.5, "--workers", 3]
    slots = {}
    for memory_gb in (0.7, 0.95, 5):
        said, _, events = measured([*words, "--memory", memory_gb], tmp_path / "out", tmp_path, 80)
        (plan,) = (event for event in events if event["event"] == "began")
        assert plan["own_bytes"] + plan["slots"] * plan["tile_bytes"] <= memory_gb * 1e9, said
        slots[memory_gb] = plan["slots"]
    assert slots[0.7] < slots[0.95] < slots[5] == 3


def test_too_little_memory_is_said_before_the_first_tile(images, tmp_path):
    words = [sys.executable, "-m", "zlocus", "dsm", *map(str, images("sine").inputs), "-o", str(tmp_path / "out")]
    run = subprocess.run(
        [*words, "--crs", "EPSG:32632", "--memory", "0.1"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 2
    assert "--memory 0.1 GB is too little for one tile" in run.stderr
    assert not Path(tmp_path / "out").exists()


def test_a_process_holds_more_than_nothing():
    assert 20e6 < held_bytes() < 50e9
    assert TILE_CODE_BYTES < WORKER_BYTES
