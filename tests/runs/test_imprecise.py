"""Cells whose standard deviation exceeds checks.max_sigma_m stay empty and are marked IMPRECISE."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rendered_scenes import read, rendered, run
from zlocus.core.options import CheckOptions, RunConfig
from zlocus.matching.quality import Quality
from zlocus.matching.surface import max_sigma_m


@pytest.mark.parametrize("method", ["mvll-sgm", "gc3-sgm"])
def test_heights_above_the_largest_sigma_are_removed(tmp_path, method):
    images = rendered(tmp_path / "images", "step")
    whole = run(images, tmp_path / "whole", method=method)
    height, sigma = (read(whole.out / f"{name}.tif")[0] for name in ("dsm", "sigma"))
    limit = float(np.nanquantile(sigma, 0.8))
    config = replace(RunConfig(), checks=CheckOptions(max_sigma_m=limit))
    best = run(images, tmp_path / "best", config, method=method)
    kept, kept_sigma, quality, views = (read(best.out / f"{n}.tif")[0] for n in ("dsm", "sigma", "quality", "views"))
    left_out = (quality & Quality.IMPRECISE) != 0
    np.testing.assert_array_equal(left_out, sigma > limit)
    assert 0.1 < left_out.mean() < 0.25
    np.testing.assert_array_equal(kept, np.where(left_out, np.nan, height))
    assert np.nanmax(kept_sigma) <= limit
    assert not views[left_out].any()


def test_removed_heights_can_be_interpolated(tmp_path):
    images = rendered(tmp_path / "images", "step")
    config = replace(RunConfig(), checks=CheckOptions(max_sigma_m=0.3))
    out = run(images, tmp_path / "out", config, fill="interpolate").out
    height, quality = (read(out / f"{name}.tif")[0] for name in ("dsm", "quality"))
    both = (quality & (Quality.IMPRECISE | Quality.FILLED)) == Quality.IMPRECISE | Quality.FILLED
    assert both.any()
    assert np.isfinite(height[both]).all()


@pytest.mark.parametrize(
    ("given_m", "method", "limit_m"),
    [
        (None, "mvll-sgm", 20.0),
        (None, "mvll", None),
        (None, "gc3", None),
        (None, "gc3-sgm", None),
        (1.5, "mvll-sgm", 1.5),
        (1.5, "mvll", 1.5),
        (1.5, "gc3-sgm", 1.5),
    ],
)
def test_without_a_limit_heights_have_one_under_the_semiglobal_constraint(given_m, method, limit_m):
    assert max_sigma_m(CheckOptions(max_sigma_m=given_m), method, cell_m=0.5) == limit_m
