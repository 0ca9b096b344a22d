"""Arrays and arguments that the stages on arrays refuse."""

from __future__ import annotations

import numpy as np
import pytest

import zlocus
from rendered_scenes import CENTRE, GSD_M, PART
from zlocus.core.errors import ConfigError


@pytest.fixture(scope="module")
def scene(images):
    return zlocus.open_scene(*images("sine").inputs, crs="EPSG:32632")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"scene": ["a.tif"]}, r"scene is a list of 1, not a Scene\. Give zlocus\.open_scene"),
        ({"bounds": (1.0, 2.0, 3.0)}, r"bounds has 3 values\. Give 4 numbers: \(xmin, ymin, xmax, ymax\)"),
        ({"bounds": None}, "bounds is None"),
        ({"resolution": 0.0}, "resolution is 0.0, which is no size"),
        ({"resolution": "0.5"}, r"resolution is a str \('0.5'\)"),
        ({"heights": 50.0}, r"heights has the shape \(\)\. Give one of \(heights\)"),
        ({"heights": [50.0, np.nan]}, "heights holds values that are not finite"),
        ({"heights": ["low"]}, r"heights holds values of type <U3\. Give real numbers"),
        ({"heights": []}, "at 0 heights hold nothing"),
    ],
)
def test_loci_of_nothing_are_refused(scene, more, said):
    asked = {"scene": scene, "bounds": PART, "resolution": GSD_M, "heights": [50.0]} | more
    with pytest.raises(ConfigError, match=said):
        zlocus.locus_stack(**asked)


@pytest.mark.parametrize(
    ("grey", "more", "said"),
    [
        ([[1.0, 2.0], [3.0]], {}, r"grey is a list of 2 that is no array\. Give one of \(images, heights"),
        (np.zeros((2, 3, 4)), {}, r"grey has the shape \(2, 3, 4\)\. Give one of \(images, heights, rows, columns\)"),
        (np.zeros((2, 1, 9, 9), complex), {}, "grey holds values of type complex128"),
        (np.zeros((2, 1, 9, 9), "U1"), {}, "grey holds values of type <U1"),
        (np.zeros((2, 1, 9, 9)), {"window": 5.0}, r"window is a float \(5.0\)\. Give a whole number"),
        (np.zeros((2, 1, 9, 9)), {"window": None}, "window is None"),
        (np.zeros((2, 1, 9, 9)), {"reference": "nadir"}, r"reference is a str \('nadir'\)"),
        (np.zeros((2, 0, 9, 9)), {}, "Give .images, heights, rows, columns. of two images or more"),
    ],
)
def test_costs_of_no_arrays_are_refused(grey, more, said):
    with pytest.raises(ConfigError, match=said):
        zlocus.ncc_cost(grey, **more)


def test_a_cost_takes_whole_numbers_and_lists():
    grey = np.random.default_rng(1).integers(0, 4000, (2, 1, 9, 9))
    expected = zlocus.ncc_cost(grey.astype(float))
    np.testing.assert_array_equal(zlocus.ncc_cost(grey.astype(np.uint16)), expected)
    np.testing.assert_array_equal(zlocus.ncc_cost(grey.tolist()), expected)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"cost": np.zeros((3, 4, 5), bool)}, "cost holds values of type bool"),
        ({"cost": np.zeros((3, 4, 0))}, r"cost has the shape \(3, 4, 0\)"),
        ({"ortho": np.zeros((3, 4, 1))}, r"ortho has the shape \(3, 4, 1\)\. Give one of \(rows, columns\)"),
        ({"options": zlocus.RunConfig()}, "options is a RunConfig, not a SemiGlobalOptions"),
        ({"step_cells": 0}, "step_cells is 0, which is no size"),
        ({"n_images": 1}, "n_images is 1, and a cost compares 2 or more"),
        ({"n_images": 2.5}, r"n_images is a float \(2.5\)"),
    ],
)
def test_heights_of_no_cost_are_refused(more, said):
    with pytest.raises(ConfigError, match=said):
        zlocus.semiglobal(**{"cost": np.zeros((3, 4, 5))} | more)


def test_an_ortho_image_of_whole_numbers_is_taken():
    cost = np.random.default_rng(0).random((12, 14, 6))
    ortho = np.arange(12 * 14).reshape(12, 14)
    expected = zlocus.semiglobal(cost, ortho=ortho.astype(np.float32))
    np.testing.assert_array_equal(zlocus.semiglobal(cost, ortho=ortho).best, expected.best)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"scene": None}, r"scene is None, not a Scene"),
        ({"height": "dsm.tif"}, "height holds values of type"),
        ({"y": CENTRE[1] + np.arange(4.0)}, "no centres of square cells from west to east and from north to south"),
        ({"x": CENTRE[0] + np.array([0.0, 1.0, 2.0, 4.0, 5.0])}, "their steps range from 1 to 2 m"),
        ({"x": CENTRE[0] + 2 * np.arange(5.0)}, "no centres of square cells"),
        ({"y": np.zeros((4, 1))}, r"y has the shape \(4, 1\)\. Give one of \(rows\)"),
    ],
)
def test_ortho_images_on_no_grid_are_refused(scene, more, said):
    asked = {
        "scene": scene, "height": np.full((4, 5), 50.0), "x": CENTRE[0] + np.arange(5.0),
        "y": CENTRE[1] - np.arange(4.0),
    }  # fmt: skip
    with pytest.raises(ConfigError, match=said):
        zlocus.true_ortho(**asked | more)
