"""Counts and standard deviations of a surface."""

import numpy as np
import pytest

from zlocus.io.run_record import read_record
from zlocus.matching.quality import Quality
from zlocus.products.surface_statistics import SurfaceStatistics, surface_statistics

# Standard deviations are counted in steps of 0.4 %.
STEP = 0.004


def test_cells_are_counted_by_what_they_are():
    nan, statistics = np.nan, SurfaceStatistics()
    height = np.array([[1.0, 2.0, 3.0, nan], [nan, nan, 7.0, nan]], np.float32)
    quality = np.array(
        [[0, Quality.FILLED | Quality.NO_MATCH, Quality.WATER, Quality.OUTSIDE],
         [Quality.UNSEEN, Quality.OCCLUDED | Quality.IMPRECISE, Quality.WATER | Quality.UNSEEN, Quality.MASKED]],
        np.uint16,
    )  # fmt: skip
    sigma = np.array([[0.5, nan, nan, nan], [nan, nan, 0.1, nan]], np.float32)
    statistics.add(height, sigma, quality)
    assert statistics.as_dict()["cells"] == {
        "grid": 8, "asked": 7, "seen": 3, "heights": 4, "matched": 1, "filled": 1, "water": 2,
        "empty": {"OUTSIDE": 1, "UNSEEN": 2, "OCCLUDED": 1},
    }  # fmt: skip
    assert statistics.coverage == pytest.approx(1 / 3)
    assert statistics.as_dict()["surface_range_m"] == [1.0, 7.0]
    assert statistics.as_dict()["sigma"]["cells"] == 2


def test_standard_deviations_are_those_of_numpy():
    rng = np.random.default_rng(3)
    sigma = rng.gamma(2.0, 0.2, (100, 200)).astype(np.float32)
    statistics = SurfaceStatistics()
    for rows in (slice(0, 37), slice(37, 100)):
        statistics.add(np.ones_like(sigma[rows]), sigma[rows], np.zeros(sigma[rows].shape, np.uint16))
    found = statistics.as_dict()["sigma"]
    assert found["cells"] == sigma.size
    assert found["mean_m"] == pytest.approx(sigma.mean(), abs=1e-4)
    assert found["rms_m"] == pytest.approx(np.sqrt((sigma**2).mean()), abs=1e-4)
    assert found["median_m"] == pytest.approx(np.median(sigma), rel=STEP)
    assert found["percentile_95_m"] == pytest.approx(np.percentile(sigma, 95), rel=STEP)


def test_a_surface_without_heights_has_no_figures():
    statistics = SurfaceStatistics()
    empty = np.full((2, 2), np.nan, np.float32)
    statistics.add(empty, empty, np.full((2, 2), Quality.UNSEEN, np.uint16))
    assert statistics.as_dict()["sigma"] == {
        "cells": 0, "mean_m": None, "rms_m": None, "median_m": None, "percentile_95_m": None
    }  # fmt: skip
    assert statistics.as_dict()["surface_range_m"] == [None, None]


def test_the_coverage_of_a_run_is_that_of_its_rasters(small_surface):
    run = read_record(small_surface / "run.json")
    found = surface_statistics(small_surface)
    assert round(found.coverage, 6) == run["coverage"]
    assert {key: run[key] for key in found.as_dict()} == found.as_dict()
