"""Options for scenes of two views apply to these and not to others."""

from __future__ import annotations

import numpy as np
import pytest

from rendered_scenes import PART, read, rendered, run
from zlocus.core.options import CostOptions, RunConfig, SemiGlobalOptions


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
    other = heights(images, 2, tmp_path / "other", semiglobal=SemiGlobalOptions(p1_two_images=0))
    lighter = heights(images, 2, tmp_path / "lighter", cost=CostOptions(grey_weight=0.3))
    assert not np.array_equal(plain, other, equal_nan=True)
    assert not np.array_equal(plain, lighter, equal_nan=True)
    same = heights(images, 2, tmp_path / "same", semiglobal=SemiGlobalOptions(p1=1))
    np.testing.assert_array_equal(plain, same)
    lone = heights(images, 2, tmp_path / "lone", cost=CostOptions(grey_weight_two_images=0.0))
    np.testing.assert_array_equal(plain, lone)


def test_options_for_two_views_do_not_change_three(images, tmp_path):
    plain = heights(images, 3, tmp_path / "plain")
    np.testing.assert_array_equal(
        plain, heights(images, 3, tmp_path / "pairs", semiglobal=SemiGlobalOptions(p1_two_images=1000))
    )
