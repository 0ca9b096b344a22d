"""`zlocus curves`: the match curves of one point of a rendered scene, its order and stop, figures, bad input."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from rendered_scenes import CENTRE, HEIGHTS, LOOKS, SIZE_PX, camera, rendered
from zlocus.cli.app import app
from zlocus.core.options import SelectionOptions
from zlocus.matching.pair_labels import PairLabels
from zlocus.matching.point_match import PointOrder, peak_of, point_curves, point_order
from zlocus.matching.view_ranking import OrderSource
from zlocus.synthetic.terrain import analytic_height

KIND = "sine"
FIGURES = ("match_curves.png", "selected.png", "all_images.png", "loci.png")
# Of a parabola through three samples.
EXACT = 1e-9
PIXEL_M = 0.6
TEXTURED = (CENTRE[0] + 3.0, CENTRE[1] - 4.0)
OPTIONS = SelectionOptions()


def zl(*arguments):
    return CliRunner().invoke(app, ["curves", *map(str, arguments)])


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return rendered(tmp_path_factory.mktemp("images"), KIND)


@pytest.fixture(scope="module")
def asked(images):
    """What every call of this page begins with."""
    return (*images.inputs, "--crs", "EPSG:32632", "--heights", *HEIGHTS)


@pytest.fixture(scope="module")
def found(asked, tmp_path_factory):
    """The folder and the text of one point."""
    out = tmp_path_factory.mktemp("found") / "curves"
    result = zl(*asked, "--at", *TEXTURED, "-o", out)
    assert result.exit_code == 0, result.output
    return out, result.stdout


def record(out: Path) -> dict:
    return json.loads((out / "point.json").read_text(encoding="utf-8"))


def true_height(middle) -> float:
    return float(analytic_height(KIND, np.array([middle[0] - CENTRE[0]]), np.array([middle[1] - CENTRE[1]]))[0])


def test_the_peak_is_at_the_true_height(found):
    point = record(found[0])
    assert abs(point["peak_m"] - true_height(point["cell"]["middle"])) < point["step_m"]
    assert abs(point["xyz"][2] - point["peak_m"]) < OPTIONS.reach_steps * point["step_m"]


def test_the_text_says_order_labels_and_stop(found):
    out, text = found
    point = record(out)
    assert point["reference"] == "nadir"
    assert {image["image"] for image in point["order"]["images"]} == {"fore", "aft"}
    for line in ("Reference  nadir", "Order, from the ", "Labels at ", "Mean of the images", "<- ends here"):
        assert line in text
    assert re.search(r"Stops after \d of 2 |Does not stop before 2 of 2 ", text)
    assert f"{point['peak_m']:.3f} m" in text


def test_the_table_holds_what_the_record_says(found):
    point = record(found[0])
    with (found[0] / "curves.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = [image["image"] for image in point["order"]["images"]]
    assert list(rows[0]) == ["height_m", *(f"ncc_{name}" for name in names), "sncc_1", "sncc_2"]
    assert len(rows) == 2 * OPTIONS.reach_steps + 1
    for image in point["curves"]:
        curve = np.array([float(row[f"ncc_{image['image']}"] or "nan") for row in rows])
        assert np.nanmax(curve) == pytest.approx(image["rho1"], abs=1e-6)
    ncc, sncc = ([[float(row[key] or "nan") for key in keys] for row in rows]
                 for keys in ([f"ncc_{name}" for name in names], ["sncc_2"]))  # fmt: skip
    both = np.isfinite(ncc).all(axis=1)
    np.testing.assert_allclose(np.mean(ncc, axis=1)[both], np.ravel(sncc)[both], atol=2e-6)


def test_the_figures_are_pictures(found):
    assert {p.name for p in found[0].iterdir()} == {*FIGURES, "curves.csv", "point.json"}
    for name in FIGURES:
        picture = cv2.imread(str(found[0] / name))
        assert picture.shape[0] > 200
        assert (picture < 250).mean() > 0.02


def test_a_pixel_is_put_on_the_ground(asked, tmp_path):
    row, col = 70.0, 82.0
    result = zl(*asked, "--pixel", "fore", row, col, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    point = record(tmp_path / "out")
    middle = point["cell"]["middle"]
    z = true_height(middle)
    assert abs(point["peak_m"] - z) < point["step_m"]
    # The first height is that of ties nearby, so the place is as far off as the view's slant makes of their error.
    slack = PIXEL_M + abs(point["xyz"][2] - z) * np.tan(np.deg2rad(LOOKS["fore"][0] + 2.0))
    seen = camera("fore").image_from_ground(np.array([[*middle, z]]))[0]
    assert np.hypot(*(seen - (col, row))) * 0.5 < slack


def test_a_point_without_ties_nearby_has_an_order(asked, tmp_path):
    (tmp_path / "c.toml").write_text("[selection]\nradius_px = 1.0\nmax_radii = 1.0\n", encoding="utf-8")
    result = zl(*asked, "--at", *TEXTURED, "--config", tmp_path / "c.toml", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    point = record(tmp_path / "out")
    assert point["order"]["rests_on"] == "scene"
    assert len(point["order"]["images"]) == 2
    assert "the scene as a whole" in result.stdout


def test_the_reference_and_the_height_asked_for_are_taken(asked, tmp_path):
    result = zl(*asked, "--at", *TEXTURED, "--reference", "aft", "--height", 51.5, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    point = record(tmp_path / "out")
    assert (point["reference"], point["xyz"][2], point["height_from"]) == ("aft", 51.5, "as asked for")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "none is given"),
        (["--at", 1, 2, "--pixel", "fore", 3, 4], "both are given"),
        (["--at", "nan", 2], "--at nan 2"),
        (["--pixel", "fore", "inf", 2], "--pixel inf 2"),
        (["--at", *TEXTURED, "--height", "nan"], "--height nan"),
        (["--pixel", "moon", 3, 4], "Choose one of aft, fore, nadir"),
        (["--at", *TEXTURED, "--reference", "moon"], "--reference moon"),
        (["--pixel", "nadir", SIZE_PX, 4], f"which has {SIZE_PX} rows"),
        (["--pixel", "nadir", 4, -1], "lies outside the image"),
        (["--at", CENTRE[0] + 900.0, CENTRE[1]], "lies outside all images"),
        (["--at", *TEXTURED, "--resolution", 0], "--resolution 0"),
    ],
)
def test_bad_input_is_one_sentence(asked, tmp_path, arguments, says):
    result = zl(*asked, *arguments, "-o", tmp_path / "out")
    assert result.exit_code == 2
    sentence = result.stderr.splitlines()[-1]
    assert sentence.startswith("zlocus: ")
    assert says in sentence
    assert not (tmp_path / "out").exists()


def test_a_point_that_one_image_shows(asked, tmp_path):
    """High above the ground the images, which look in different directions, show different places."""
    high = HEIGHTS[1]
    ground = [camera("fore").ground_from_image(np.array([[SIZE_PX / 2, row]]), np.array([high]))[0]
              for row in (2.0, SIZE_PX - 6.0)]  # fmt: skip
    rows = [[camera(name).image_from_ground(xyz[None])[0, 1] for name in ("nadir", "aft")] for xyz in ground]
    alone = [xyz for xyz, at in zip(ground, rows, strict=True) if max(at) < 0 or min(at) > SIZE_PX]
    result = zl(*asked, "--at", *alone[0][:2], "--height", high, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "by fore only, and two images" in result.stderr.splitlines()[-1]


def test_another_point_is_kept_without_overwrite(found, asked):
    result = zl(*asked, "--at", *TEXTURED, "-o", found[0])
    assert result.exit_code == 2
    assert "holds another run (point.json)" in result.stderr


def windows_of(ncc: np.ndarray) -> np.ndarray:
    """Windows whose products with the first one's are `ncc` (j, h): (1 + j, h, 2)."""
    first = np.broadcast_to([1.0, 0.0], (1, ncc.shape[1], 2))
    return np.concatenate([first, np.stack([ncc, np.sqrt(1 - ncc**2)], axis=2)]).astype(np.float32)


def order_of(n: int, worth: list[bool]) -> PointOrder:
    nothing = np.zeros(0, np.int64)
    return PointOrder(
        0, np.arange(1, n + 1), np.zeros(n, np.int64), np.array(worth), OrderSource.SCENE, nothing, np.zeros((0, 2)),
        np.zeros(0), np.zeros((0, n), np.int8),
    )  # fmt: skip


def bump(at: int, height: float, n: int = 81) -> np.ndarray:
    return height * np.exp(-(((np.arange(n) - at) / 3.0) ** 2)) + 0.02 * np.cos(np.arange(n))


@pytest.mark.parametrize(
    ("worth", "least", "n_used", "is_stopped"),
    [([True] * 3, 1, 2, True), ([True, False, False], 1, 1, False), ([True, False, False], 3, 3, False),
     ([False] * 3, 1, 1, False)],
)  # fmt: skip
def test_the_match_ends_where_the_mean_is_good(worth, least, n_used, is_stopped):
    ncc = np.stack([np.maximum(bump(30, 0.85), bump(60, 0.8)), bump(30, 0.9), bump(50, 0.4)])
    options = replace(OPTIONS, max_sigma_steps=1000.0, min_images=least)
    found = point_curves(windows_of(ncc), order_of(3, worth), np.full(3, 0.5), np.arange(81.0), options)
    assert found.single_curves.labels.tolist() == [0, 1, -1]
    assert found.mean_curves.labels[:2].tolist() == [0, 1]
    np.testing.assert_allclose(found.mean_curves.values[2], ncc.mean(axis=0), atol=1e-6)
    assert (found.n_used, found.is_stopped) == (n_used, is_stopped)
    assert abs(found.peak_index - 30) < 0.2


def test_an_imprecise_peak_does_not_stop():
    ncc = np.stack([bump(30, 0.9), bump(30, 0.9)])
    options = replace(OPTIONS, max_sigma_steps=1e-3)
    found = point_curves(windows_of(ncc), order_of(2, [True] * 2), np.full(2, 0.5), np.arange(81.0), options)
    assert (found.mean_curves.labels == 1).all()
    assert not found.is_stopped


def test_the_peak_lies_between_samples():
    index = np.arange(10.0, 20.0)
    assert peak_of(index, 1 - (index - 14.3) ** 2) == pytest.approx(14.3, abs=EXACT)
    assert peak_of(index, index) == 19.0
    assert np.isnan(peak_of(index, np.full(10, np.nan)))


def test_an_order_without_any_tie_point():
    ranking = PairLabels(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3, 3), np.int8), np.ones((3, 3)))
    order = point_order(ranking, np.array([0.0, 1.0, 0.0]), np.zeros(2), OPTIONS)
    assert (order.reference, order.search.tolist(), order.order_source) == (1, [0, 2], OrderSource.SCENE)
    assert order.is_helpful.all()


def test_labels_follow_the_order():
    labels = np.zeros((2, 3, 3), np.int8)
    labels[0, 0], labels[1, 0] = [-1, 0, 1], [-1, -1, 1]
    ranking = PairLabels(np.arange(2), np.array([[9.0, 0.0], [3.0, 0.0]]), labels, np.ones((3, 3)))
    order = point_order(ranking, np.ones(3), np.zeros(2), OPTIONS)
    assert (order.reference, order.search.tolist()) == (0, [2, 1])
    assert order.accumulated.tolist() == [2, -1]
    assert order.is_helpful.tolist() == [True, False]
    assert order.features.tolist() == [1, 0]
    assert order.distance.tolist() == [3.0, 9.0]
    assert order.labels.tolist() == [[1, -1], [1, 0]]
