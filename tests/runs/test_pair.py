"""Scenes of two views are matched with all of the grey differences and with a penalty of one step of their own."""

from __future__ import annotations

import numpy as np
import pytest

from rendered_scenes import PART, read, rendered, run
from zlocus.core.options import CostOptions, RunConfig, SemiGlobalOptions
from zlocus.matching import semiglobal


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return rendered(tmp_path_factory.mktemp("images"), "sine")


def heights(images, number: int, out, **options) -> np.ndarray:
    config = RunConfig(
        semiglobal=options.get("semiglobal", SemiGlobalOptions()), cost=options.get("cost", CostOptions())
    )
    run(images.inputs[:number], out, config, bounds=PART)
    return read(out / "dsm.tif")[0]


def test_a_pair_is_matched_with_the_penalty_of_pairs_and_all_grey_differences(images, tmp_path):
    plain = heights(images, 2, tmp_path / "plain")
    for name, options in (
        ("other", {"semiglobal": SemiGlobalOptions(p1=0)}), ("lighter", {"cost": CostOptions(grey_weight=0.3)})
    ):  # fmt: skip
        assert not np.array_equal(plain, heights(images, 2, tmp_path / name, **options), equal_nan=True)
    same = heights(images, 2, tmp_path / "same", semiglobal=SemiGlobalOptions(p1=100))
    np.testing.assert_array_equal(plain, same)


def test_the_penalty_of_one_step_follows_the_images_that_see_the_ground(images, tmp_path, monkeypatch):
    found, of_images = set(), semiglobal.penalty_of_one_step
    monkeypatch.setattr(
        semiglobal, "penalty_of_one_step", lambda p1, n, step: found.add((p1, n)) or of_images(p1, n, step)
    )
    heights(images, 2, tmp_path / "two")
    assert found == {(100, 2.0)}
    heights(images, 3, tmp_path / "three")
    assert (100, 3.0) in found
