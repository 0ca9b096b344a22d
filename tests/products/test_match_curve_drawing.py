from __future__ import annotations

import re
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from zlocus.products.match_curve_drawing import MOST_TICKS, SVG_PX, Axes, mean_svg, ticks

HEIGHTS = np.linspace(40.0, 60.0, 21)


def report(names, n_used=2):
    """Curves of images with these names; the mean of one, two and so on peaks at 45, 46 and so on metres."""
    means = np.exp(-((HEIGHTS - 45.0 - np.arange(len(names))[:, None]) ** 2))
    peaks = SimpleNamespace(peak=means.argmax(axis=1), rho1=means.max(axis=1))
    single = means - 0.2
    single[0, 10] = np.nan
    curves = SimpleNamespace(
        single_curves=SimpleNamespace(values=single), mean_curves=SimpleNamespace(values=means, peaks=peaks),
        n_used=n_used,
    )  # fmt: skip
    return SimpleNamespace(heights_m=HEIGHTS, search=names, curves=curves, xyz=np.array([0.0, 0.0, 52.0]))


def drawn(names, n_images, n_used=2):
    """The drawing as a tree, and the paths of its curves and of their samples in the legend, by stroke colour."""
    tree = ElementTree.fromstring(mean_svg(report(names, n_used), n_images))
    paths = {}
    for path in tree.iter("{http://www.w3.org/2000/svg}path"):
        paths.setdefault(path.get("stroke"), []).append(path.get("d"))
    return tree, paths


def test_curves_lie_at_their_heights_and_correlations():
    tree, paths = drawn(["a", "b", "c"], 3)
    (frame,) = [each for each in tree.iter("{http://www.w3.org/2000/svg}rect") if each.get("fill") == "none"]
    left, top, width, height = (float(frame.get(key)) for key in ("x", "y", "width", "height"))
    # The mean is the longest path in black.
    mean = max(paths["#000000"], key=len)
    xy = np.array(re.findall(r"[ML]([\d.]+) ([\d.]+)", mean), float)
    np.testing.assert_allclose(xy[:, 0], left + (HEIGHTS - 40.0) / 20.0 * width, atol=0.06)
    correlation = np.exp(-((HEIGHTS - 47.0) ** 2))
    np.testing.assert_allclose(xy[:, 1], top + (1.05 - correlation) / 2.05 * height, atol=0.06)


def test_a_curve_is_interrupted_where_it_has_no_value():
    _, paths = drawn(["a", "b"], 2)
    first, second = max(paths["#0072B2"], key=len), max(paths["#D55E00"], key=len)
    assert (first.count("M"), first.count("L")) == (2, 18)
    assert (second.count("M"), second.count("L")) == (1, 20)


@pytest.mark.parametrize(("n_used", "named"), [(4, ["mean of the first 2", "mean of the first 3"]), (2, [])])
def test_the_legend_names_every_curve(n_used, named):
    names = ["a", "<b>&", "c", "d"]
    n_images = 4 if n_used == 4 else 2
    tree, _ = drawn(names, n_images, n_used)
    texts = list(tree.itertext())
    assert [text for text in texts if text in names] == names[:n_images]
    assert [text for text in texts if text.startswith("mean of the first")] == named
    assert f"mean of {n_images}" in texts


def test_the_mean_that_was_used_is_beside_that_of_all():
    texts = list(drawn(["a", "b", "c"], 3, n_used=2)[0].itertext())
    assert "mean of the first 2" in texts


def test_the_legend_of_many_images_has_room_below_the_axes():
    few, many = (drawn([f"view {i}" for i in range(n)], n, n)[0] for n in (2, 12))
    assert int(few.get("height")) == SVG_PX[1]
    rows = [float(each.get("y")) for each in many.iter("{http://www.w3.org/2000/svg}text") if each.get("y")]
    assert max(rows) < int(many.get("height"))
    assert int(many.get("height")) > SVG_PX[1]


@pytest.mark.parametrize(
    ("low", "high"), [(22.3, 80.1), (0.0, 1.0), (-3.0, 3.0), (812.2, 814.9), (0.0, 6.0), (0.0, 3999.0)]
)
def test_ticks_are_round_and_neither_few_nor_many(low, high):
    found = ticks(low, high)
    assert 3 <= len(found) <= MOST_TICKS
    assert low <= found[0] < found[-1] <= high
    step = found[1] - found[0]
    np.testing.assert_allclose(np.diff(found), step)
    assert f"{step:.0e}"[0] in "125"


def test_one_height_alone_is_drawn():
    assert ticks(5.0, 5.0) == [5.0]
    assert Axes(5.0, 5.0, 200.0).x(5.0) == Axes(5.0, 9.0, 200.0).x(5.0)
