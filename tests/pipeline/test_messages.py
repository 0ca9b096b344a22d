"""What is said about a self-calibration, in notes and in orientation.json."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calibration_scenes import block_ground, calibrated, crossing_block, flat_block, options_with
from zlocus.core.progress import SilentProgress
from zlocus.orientation import bundle_adjustment
from zlocus.orientation.plausibility import ExcludedImage
from zlocus.pipeline.messages import note_orientation, self_calibration_sentences, what_was_applied
from zlocus.products.orientation import corrections_record


@pytest.fixture(autouse=True)
def one_round(monkeypatch):
    monkeypatch.setattr(bundle_adjustment, "ROUNDS", 1)


def adjusted(exact, *parameters):
    delivered = [replace(camera, focal=camera.focal + 15.0) for camera in exact]
    return calibrated(exact, delivered, block_ground(120), options_with(*parameters))


def named(found):
    """An orientation as far as the sentences read it."""
    views = [SimpleNamespace(name=f"photo{i}") for i in range(len(found.sensors))]
    return SimpleNamespace(bundle_adjustment=found, views=views)


def test_a_held_parameter_is_named_with_the_reason():
    found = adjusted(flat_block(), "focal")
    (sentence,) = self_calibration_sentences(named(found))
    assert sentence.startswith("The focal length of 12 images (photo0 to photo11) is held: the tie points")
    assert "do not tell it from the flying height above the ground (correlation 0.9" in sentence
    record = corrections_record(found, [f"photo{i}" for i in range(12)])
    assert [entry["held_because"] for entry in record if entry["kind"] == "focal length"] == [{"focal_px": sentence}]
    assert not any("held_because" in entry for entry in record[:-1])


def test_what_was_found_is_said_with_its_standard_deviation():
    found = adjusted(crossing_block(), "focal")
    (sentence,) = self_calibration_sentences(named(found))
    assert sentence.startswith("Self-calibration of 24 images (photo0 to photo23): focal length -15")
    assert " px (standard deviation 0.0" in sentence


def test_without_a_bundle_adjustment_nothing_is_said():
    assert self_calibration_sentences(SimpleNamespace(bundle_adjustment=None, views=[])) == []


class Notes(SilentProgress):
    def __init__(self):
        self.said = []

    def note(self, sentence):
        self.said.append(sentence)


def oriented(model="shift", shift=(2.3, 0.6), n_refined=211, n=236, excluded=()):
    views = [SimpleNamespace(name=name, shift_px=shift) for name in ("a", "b")]
    return SimpleNamespace(
        views=views, model=model, xyz=np.zeros((n, 3)), n_refined=n_refined, refined_xyz=np.zeros((n_refined, 3)),
        bundle_adjustment=None, excluded_images=tuple(ExcludedImage(name, "no ties.") for name in excluded), doubts=(),
    )  # fmt: skip


def test_the_pointing_is_corrected_from_the_ties_that_were_refined():
    said = what_was_applied(oriented())
    assert said.startswith("Pointing corrected from 211 tie points (25 more, less exact ones, tell heights only), px")
    assert "from 211 tie points, px" in what_was_applied(oriented(n=211))


def test_without_a_request_no_correction_is_said_to_be_missing():
    nothing = (0.0, 0.0)
    assert what_was_applied(oriented("none", nothing)) == "Cameras used as delivered: no correction was asked for."
    assert what_was_applied(oriented("shift", nothing)).startswith("Pointing not corrected: ")


def test_nothing_is_said_of_images_where_none_are_left_to_match():
    for has_heights, n in ((True, 0), (False, 3)):
        notes = Notes()
        note_orientation(oriented(excluded=("a", "b")), notes, has_heights)
        assert len(notes.said) == n
    notes = Notes()
    note_orientation(oriented(), notes, has_heights=True)
    assert len(notes.said) == 1
