"""The finest level is matched a second time, with occlusions by its own surface, if there are more than two views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rendered_scenes import SMALL_TILES, read, run
from zlocus.core.options import RunConfig
from zlocus.matching import tile

TWO_ROUNDS, SMALL_TWICE = (
    replace(config, pyramid=replace(config.pyramid, finest_level_rounds=2)) for config in (RunConfig(), SMALL_TILES)
)


@pytest.fixture
def levels_matched(monkeypatch):
    """(level, whether occlusions are found, cells by which the occluding surface is eroded) of every matched level."""
    calls, one = [], tile.match_level

    def counted(inputs, level, prior, pair_labels, earlier_result=None):
        calls.append((level.number, inputs.handles_occlusion, len(prior.erosion) // 2))
        return one(inputs, level, prior, pair_labels, earlier_result)

    monkeypatch.setattr(tile, "match_level", counted)
    return calls


def test_three_views_have_two_rounds_on_request(images, tmp_path, levels_matched):
    run(images("step"), tmp_path / "out", TWO_ROUNDS)
    assert [call for call in levels_matched if call[0] == 0] == [(0, True, 2), (0, True, 1)]


def test_two_views_have_one_round_without_occlusions(images, tmp_path, levels_matched):
    run(images("step").inputs[:2], tmp_path / "out", TWO_ROUNDS)
    assert [call for call in levels_matched if call[0] == 0] == [(0, False, 2)]


def test_one_round_by_default(images, tmp_path, levels_matched):
    run(images("step"), tmp_path / "out")
    assert [call for call in levels_matched if call[0] == 0] == [(0, True, 2)]


def test_occlusions_are_found_without_a_choice_of_images_too(images, tmp_path, levels_matched):
    run(images("step"), tmp_path / "out", TWO_ROUNDS, views="all")
    assert [call for call in levels_matched if call[0] == 0] == [(0, True, 2), (0, True, 1)]


def test_of_many_images_none_is_excluded_where_a_surface_occludes_it(images, tmp_path, monkeypatch):
    calls, mark = [], tile.mark_occlusions
    monkeypatch.setattr(tile, "mark_occlusions", lambda *given: calls.append(given) or mark(*given))
    run(images("step"), tmp_path / "few")
    assert calls
    calls.clear()
    monkeypatch.setattr(tile, "MANY_VIEWS", 3)
    run(images("step"), tmp_path / "many")
    assert calls == []


def test_workers_change_nothing(images, tmp_path):
    one, two = (run(images("step"), tmp_path / str(n), SMALL_TWICE, workers=n) for n in (1, 2))
    np.testing.assert_array_equal(*(read(r.out / "dsm.tif")[0] for r in (one, two)))
