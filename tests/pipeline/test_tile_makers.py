"""Surfaces with the selection of the paper, on the ground and in image space."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rendered_scenes import PART, errors_of, read, run
from zlocus.core.options import RunConfig
from zlocus.core.requests import DsmRequest
from zlocus.matching.quality import Quality, is_empty
from zlocus.orientation.triangulate import Observations
from zlocus.pipeline.run_plan import Plan
from zlocus.pipeline.tile_run import Polygons, tile_job

KIND = "sine"
# The height of a cell is that of a step, which is about 0.7 m here.
WITHIN_M, LEAST_WITHIN, LEAST_COVERED = 0.7, 0.93, 0.8


@pytest.fixture(scope="module", params=["mvll", "gc3"])
def surface(request, images, tmp_path_factory):
    out = tmp_path_factory.mktemp("surface") / request.param
    run(images(KIND), out, selection="paper", method=request.param, partial=True)
    return request.param, out


def test_heights_are_true(surface):
    error, seen = errors_of(surface[1], KIND)
    found = np.isfinite(error) & seen
    assert found.sum() > LEAST_COVERED * seen.sum()
    assert (np.abs(error[found]) < WITHIN_M).mean() > LEAST_WITHIN


def test_the_products_are_those_of_other_runs(surface):
    method, out = surface
    height, quality, views, ortho = (read(out / f"{name}.tif")[0] for name in ("dsm", "quality", "views", "ortho"))
    known = np.isfinite(height)
    assert np.array_equal(known, ~is_empty(quality))
    assert set(np.unique(views[known]).tolist()) <= {2, 3}
    assert (views[~known] == 0).all()
    assert (ortho[known] > 0).all()
    assert np.isnan(read(out / "sigma.tif")[0]).all()
    assert (~known & ((quality & np.uint16(Quality.UNSEEN)) == 0)).any(), "cells that two images show may be empty"
    assert (quality[known] & ~np.uint16(Quality.AMBIGUOUS | Quality.WEAK | Quality.JUMP) == 0).all()
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert record["config"]["request"]["selection"] == "paper"
    assert record["config"]["request"]["method"] == method
    evaluations = record["evaluations"]
    assert 0 < evaluations["done"] < evaluations["all_images"]


def test_a_part_has_the_heights_of_the_whole(images, surface, tmp_path):
    """Only the cells that are asked for are matched, and what they find does not depend on that."""
    method, out = surface
    run(images(KIND), tmp_path / "part", selection="paper", method=method, partial=True, bounds=PART)
    part, of_part = read(tmp_path / "part" / "dsm.tif")
    whole, of_whole = read(out / "dsm.tif")
    col, row = (round(v) for v in ~of_whole.transform * (of_part.bounds.left, of_part.bounds.top))
    np.testing.assert_array_equal(part, whole[row : row + part.shape[0], col : col + part.shape[1]])


@dataclass(frozen=True)
class Lattice:
    """As much of a match scene as a job looks at."""

    views: tuple[SimpleNamespace, ...]
    ties: np.ndarray


@pytest.mark.parametrize(("selection", "points"), [("paper", [0, 1, 3]), ("default", [0, 1, 2, 3])])
def test_the_feature_points_are_the_tie_points_of_the_reference_image(selection, points):
    a, b, c = (SimpleNamespace(name=name) for name in "abc")
    xyz = np.arange(12.0).reshape(4, 3)
    observations = Observations(np.array([0, 1, 1, 0, 2, 1]), np.array([0, 0, 1, 2, 1, 3]), np.zeros((6, 2)))
    setup = SimpleNamespace(
        orientation=SimpleNamespace(xyz=xyz, observations=observations), scene=SimpleNamespace(views=(a, b, c)),
        match_scene=Lattice((b, a, c), xyz), grid=None,
    )  # fmt: skip
    request = DsmRequest((Path("a.tif"), Path("b.tif")), Path("out"), method="mvll", selection=selection)
    plan = Plan(1, 1, False, 1e9, 1e8, 2e9, 12_000_000, 5.0)
    job = tile_job(request, setup, RunConfig(), Polygons(), plan)
    assert job.match_scene.ties.tolist() == xyz[points].tolist()
    assert job.method.selection == selection
    assert job.kept_bytes == plan.kept_bytes
