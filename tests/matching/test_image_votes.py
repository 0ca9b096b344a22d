"""Votes of images on a height, against plain loops over pairs of windows."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.matching.image_votes import MIN_GAIN, Vote, votes_of_images

N_HEIGHTS, N_CELLS, HERE, ELSEWHERE = 15, 49, 6, 11
ALL = np.ones(5, bool)


def unit(windows):
    windows = windows - windows.mean(axis=-1, keepdims=True)
    return windows / np.linalg.norm(windows, axis=-1, keepdims=True)


@pytest.fixture
def windows():
    """Five images that are alike at one height and at no other."""
    rng = np.random.default_rng(3)
    found = rng.normal(size=(5, N_HEIGHTS, N_CELLS))
    found[:, HERE] = rng.normal(size=N_CELLS) + 0.2 * rng.normal(size=(5, N_CELLS))
    return unit(found)


def falsified(windows, i=3):
    """Image i shows at the height of the others something else, and is like them at another height."""
    changed = windows.copy()
    changed[i, HERE] = unit(np.random.default_rng(8).normal(size=N_CELLS))
    changed[i, ELSEWHERE] = unit(np.delete(windows[:, ELSEWHERE], i, axis=0).sum(axis=0))
    return changed


def mean(values):
    """The mean of the numbers among some values; NaN without any."""
    known = [value for value in values if np.isfinite(value)]
    return sum(known) / len(known) if known else np.nan


def test_images_that_are_alike_agree(windows):
    assert [vote.vote for vote in votes_of_images(windows, ALL, HERE)] == [Vote.AGREES] * 5


def test_a_falsified_image_is_out_voted_by_the_others(windows):
    votes = votes_of_images(falsified(windows), ALL, HERE)
    assert [vote.vote for vote in votes] == [Vote.AGREES] * 3 + [Vote.OUT_VOTED, Vote.AGREES]
    vote = votes[3]
    assert vote.peak == ELSEWHERE
    assert vote.n_others == 4
    assert vote.others > 0.9 > 0.2 > vote.others_at_peak


def test_the_numbers_are_those_of_plain_loops(windows):
    windows = falsified(windows)
    windows[1, :4] = np.nan  # it does not show those heights
    votes = votes_of_images(windows, ALL, HERE)
    for i, vote in enumerate(votes):
        others = [j for j in range(5) if j != i]
        own = [mean([windows[i, h] @ windows[j, h] for j in others]) for h in range(N_HEIGHTS)]
        of_others = [
            mean([windows[j, h] @ windows[k, h] for j in others for k in others if j < k]) for h in range(N_HEIGHTS)
        ]
        assert vote.correlation == pytest.approx(own[HERE])
        assert vote.peak == np.nanargmax(own)
        assert vote.at_peak == pytest.approx(np.nanmax(own))
        assert vote.others == pytest.approx(of_others[HERE])
        assert vote.others_at_peak == pytest.approx(of_others[vote.peak])


def test_where_all_match_better_elsewhere_none_is_out_voted(windows):
    elsewhere = np.roll(windows, ELSEWHERE - HERE, axis=1)
    assert {vote.vote for vote in votes_of_images(elsewhere, ALL, HERE)} == {Vote.OVERRULED}


def test_of_two_images_none_out_votes_the_other(windows):
    votes = votes_of_images(falsified(windows)[2:4], np.ones(2, bool), HERE)
    assert [vote.vote for vote in votes] == [Vote.OVERRULED] * 2
    assert np.isnan(votes[0].others)


def test_plain_ground_says_nothing_of_a_height(windows):
    flat = unit(windows[:, HERE][:, None] + 2.0 * np.random.default_rng(1).normal(size=(5, N_HEIGHTS, N_CELLS)))
    votes = [vote for vote in votes_of_images(flat, ALL, HERE) if vote.at_peak - vote.correlation < MIN_GAIN]
    assert votes
    assert {vote.vote for vote in votes} <= {Vote.UNDECIDED, Vote.AGREES}


def test_occluded_images_and_those_without_a_window_do_not_vote(windows):
    windows[0, HERE] = np.nan
    votes = votes_of_images(windows, np.array([True, False, True, True, True]), HERE)
    assert votes[:2] == [None, None]
    assert [vote.n_others for vote in votes[2:]] == [2, 2, 2]
    alone = votes_of_images(windows, np.array([False, False, True, False, False]), HERE)
    assert alone == [None] * 5
