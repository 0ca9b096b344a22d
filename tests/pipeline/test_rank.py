from __future__ import annotations

import json
import shutil
import warnings

import numpy as np
import pyogrio
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from rendered_scenes import GSD_M, HEIGHTS, LOOKS
from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import RankRequest
from zlocus.matching.match_curve import FAIR, GOOD, POOR
from zlocus.matching.pair_labels import LabelledTies
from zlocus.pipeline.rank import label_counts, ranking_table, run_rank


def rank(inputs, out, **asked):
    asked = {"crs": "EPSG:32632", "resolution": GSD_M, "heights": HEIGHTS} | asked
    return run_rank(RankRequest(tuple(inputs), out, **asked), RunConfig(), SilentProgress())


@pytest.fixture(scope="module")
def with_noise(images, tmp_path_factory):
    """The three images of the sine, one of them mostly covered with noise, as by clouds: a rim with ties is left."""
    folder = tmp_path_factory.mktemp("noise")
    paths = [shutil.copy(path, folder / path.name) for path in images("sine").inputs]
    noisy = folder / "aft.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(noisy) as source:
            pixels, profile, rpcs = source.read(1), source.profile, source.rpcs
        part = np.s_[40:110, 40:110]
        pixels[part] = np.random.default_rng(1).integers(pixels.min(), pixels.max(), pixels[part].shape)
        with rasterio.open(noisy, "w", **profile, rpcs=rpcs) as file:
            file.write(pixels, 1)
    return paths


def test_good_images_are_good_at_all_points(images, tmp_path):
    said = rank(images("sine").inputs, tmp_path / "out")
    ranking = json.loads((tmp_path / "out" / "ranking.json").read_text())
    assert sorted(ranking["images"]) == sorted(LOOKS)
    assert len(ranking["pairs"]) == 3
    for pair in ranking["pairs"]:
        assert pair["good"] + pair["fair"] + pair["poor"] == pair["points"] > 20
        assert pair["poor"] < 0.1 * pair["points"] < pair["good"]
        assert said.count(pair["images"][0]) >= 3
    info = pyogrio.read_info(tmp_path / "out" / "ranking.gpkg", layer="ranking")
    assert info["features"] == 3 * ranking["pairs"][0]["points"]
    assert set(json.loads((tmp_path / "out" / "run.json").read_text())) >= {"config", "inputs", "stages", "versions"}


def test_a_covered_image_is_last(with_noise, tmp_path):
    said = rank(with_noise, tmp_path / "out")
    ranks, keep, direction = said.splitlines()[-3:]
    assert ranks.endswith(", aft.")
    assert keep.startswith("Keep ")
    assert direction.startswith("No direction is missing: the rays of 3 images differ by up to ")


def test_two_images_are_ranked_too(images, tmp_path):
    said = rank(images("sine").inputs[:2], tmp_path / "out")
    assert said.splitlines()[-1].startswith("Buy a third image")
    assert len(json.loads((tmp_path / "out" / "ranking.json").read_text())["pairs"]) == 1
    assert {path.name for path in (tmp_path / "out").glob("*.qml")} == {"ties.qml", "ranking.qml"}


def test_same_ranking_with_two_workers_and_any_order(images, tmp_path):
    rank(images("sine").inputs, tmp_path / "one")
    rank(images("sine").inputs[::-1], tmp_path / "two", workers=2)
    one, two = ((tmp_path / name / "ranking.json").read_text() for name in ("one", "two"))
    assert one == two


def test_counts_of_labels():
    """Tiles that see other images, and two that see the same; a pair that no tile compared has no figure."""
    labels = np.array([[[POOR, GOOD], [GOOD, POOR]], [[POOR, FAIR], [FAIR, POOR]]], np.int8)
    parts = [
        LabelledTies(np.zeros((2, 3)), labels, np.array([0, 2])),
        LabelledTies(np.zeros((1, 3)), np.full((1, 2, 2), POOR, np.int8), np.array([2, 1])),
        LabelledTies(np.zeros((1, 3)), labels[:1], np.array([0, 2])),
    ]
    counts = label_counts(parts, 3)
    assert counts[:, 0, 2].tolist() == counts[:, 2, 0].tolist() == [2, 1, 0]
    assert counts[:, 1, 2].tolist() == [0, 0, 1]
    assert counts[:, 0, 1].tolist() == counts[:, 1, 1].tolist() == [0, 0, 0]
    table = ranking_table(counts, ["a", "b", "c"]).splitlines()
    assert table[2].split() == ["a", "-", "-", "67"]
    assert table[3].split() == ["b", "-", "-", "0"]
    assert table[-1] == "From the most to the least useful: a, c, b."


def test_what_cannot_be_ranked(images, tmp_path):
    with pytest.raises(ConfigError, match="--workers"):
        rank(images("sine").inputs, tmp_path / "out", workers=0)
    with pytest.raises(GeometryError):
        rank(images("sine").inputs, tmp_path / "out", heights=(7000.0, 7100.0))
    assert not (tmp_path / "out").exists()
