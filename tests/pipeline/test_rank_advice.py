from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from zlocus.core.options import SelectionOptions
from zlocus.matching.match_curve import FAIR, GOOD, POOR
from zlocus.matching.pair_labels import LabelledTies
from zlocus.pipeline.rank_advice import SharedPoints, advice, missing_image

OPTIONS = SelectionOptions()


def rates(*degrees):
    """Parallax rates of images that look so many degrees to the east of the vertical."""
    return np.column_stack([np.tan(np.radians(degrees)), np.zeros(len(degrees))])


def view(first_col, cols):
    """An image of a strip of flat ground, one pixel a metre."""
    sensor = SimpleNamespace(image_from_ground=lambda xyz: xyz[:, :2] - [first_col, 0.0])
    return SimpleNamespace(sensor=sensor, image=SimpleNamespace(shape=(10, cols)))


def test_points_that_one_image_does_not_show_say_nothing_of_it():
    """The second image shows the left half of the ground; beyond it its labels are poor, as they must be."""
    xyz = np.column_stack([np.arange(10.0), np.full(10, 5.0), np.zeros(10)])
    labels = np.full((10, 2, 2), POOR, np.int8)
    labels[:5, 0, 1] = labels[:5, 1, 0] = GOOD
    points = SharedPoints.of([LabelledTies(xyz, labels, np.array([0, 1]))], [view(0, 10), view(0, 5)])
    np.testing.assert_array_equal(points.n_shared, [[0, 5], [5, 0]])
    np.testing.assert_array_equal(points.n_poor, np.zeros((2, 2)))
    np.testing.assert_array_equal(points.least_poor_share, [0.0, 0.0])


def test_tiles_are_added_up_for_the_images_that_they_see():
    xyz = np.column_stack([np.arange(4.0), np.full(4, 5.0), np.zeros(4)])
    labels = np.full((4, 2, 2), FAIR, np.int8)
    labels[0, 0, 1] = labels[0, 1, 0] = POOR
    parts = [LabelledTies(xyz, labels, np.array(numbers)) for numbers in ([0, 2], [2, 0])]
    points = SharedPoints.of(parts, [view(0, 10)] * 3)
    assert points.n_shared[0, 2] == points.n_shared[2, 0] == 8
    assert points.n_poor[0, 2] == points.n_poor[2, 0] == 2
    np.testing.assert_array_equal(points.least_poor_share, [0.25, np.nan, 0.25])


def test_an_image_is_kept_that_goes_well_with_one_other():
    """c misleads a but not b; d misleads all; e shares no point with any."""
    shared, poor = np.full((5, 5), 100), np.full((5, 5), 90)
    shared[4], shared[:, 4] = 0, 0
    for i, j in ((0, 1), (1, 2)):
        poor[i, j] = poor[j, i] = 10
    said = advice(SharedPoints(shared, poor), rates(0, 12, 20, 15, 18), list("abcde"), OPTIONS)
    assert said[0] == "Keep a, b, c."
    assert said[1].startswith("Drop d (90 %): ")
    assert said[2].startswith("Nothing can be said of e: ")
    assert said[3] == "No direction is missing: the rays of 3 images differ by up to 20.0 degrees."


@pytest.mark.parametrize(
    ("degrees", "said"),
    [
        ((0.0,), "Buy images that match: two or more"),
        (
            (0.0, 1.0, 2.0),
            "Buy an image that looks from about 20 degrees away: the rays of these differ by 2.0",
        ),
        ((-40.0, 40.0), "Buy an image between these: their rays differ by"),
        ((0.0, 15.0), "Buy a third image from the other side"),
        ((0.0, 15.0, -15.0), "No direction is missing"),
    ],
)
def test_the_image_that_is_missing(degrees, said):
    angles = [abs(a - b) for a, b in combinations(degrees, 2)]
    assert missing_image(len(degrees), np.array(angles), OPTIONS).startswith(said)
