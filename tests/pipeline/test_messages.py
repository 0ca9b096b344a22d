"""What is said about a self-calibration, in notes and in orientation.json."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from calibration_scenes import block_ground, calibrated, crossing_block, flat_block, options_with
from zlocus.orientation import bundle_adjustment
from zlocus.pipeline.messages import self_calibration_sentences
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
