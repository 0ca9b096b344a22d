"""What Ji et al. (2014) print: from its rho1 and rho2 our code finds its ratios, labels and order."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from zlocus.core.options import SelectionOptions
from zlocus.matching.match_curve import GOOD, peak_ratio, quality_labels
from zlocus.matching.stereo_selection import options_of_paper
from zlocus.matching.view_ranking import FeaturePoints, order_images
from zlocus.products.printed_values import FIGURE_6, PRINTED_GROUPS, SEARCH_IMAGES, TABLE_3, TABLE_4

OPTIONS = options_of_paper(SelectionOptions(radius_px=10.0))
POINTS = ("P1", "P2", "P3")
# rho1 and rho2 are printed with four digits.
ROUNDING = 5e-5


def ratio_and_label(printed):
    ratio = peak_ratio(np.array([printed.rho1]), np.array([printed.rho2]), OPTIONS)
    return float(ratio[0]), int(quality_labels(np.array([printed.rho1]), ratio, np.array([False]), OPTIONS)[0])


@pytest.mark.parametrize("printed", [*TABLE_3.values(), FIGURE_6])
def test_ratios_and_labels_are_those_printed(printed):
    ratio, label = ratio_and_label(printed)
    assert ratio == pytest.approx(printed.ratio, abs=ROUNDING * (1 + ratio) / abs(printed.rho2) + ROUNDING)
    assert label == printed.label


def test_figure_6_ends_the_matching():
    assert ratio_and_label(FIGURE_6)[1] == GOOD


def test_table_4_follows_from_table_3():
    labels = [[ratio_and_label(TABLE_3[point, name])[1] for name in SEARCH_IMAGES] for point in POINTS]
    # The paper does not print where the points are; any three within the radius do.
    feature_points = FeaturePoints(np.array([[-3.0, -2.0], [4.0, -1.0], [0.0, 5.0]]), np.array(labels, np.int8))
    found = order_images(feature_points, np.zeros((1, 2)), OPTIONS)
    assert dict(zip(SEARCH_IMAGES, found.accumulated[0].tolist(), strict=True)) == TABLE_4
    order, groups = [SEARCH_IMAGES[image] for image in found.images[0]], iter(range(len(SEARCH_IMAGES)))
    assert [{order[next(groups)] for _ in group} for group in PRINTED_GROUPS] == [set(g) for g in PRINTED_GROUPS]


def test_the_values_are_those_of_the_golden_files(shared_data):
    folder = shared_data.parent / "golden"
    if not folder.is_dir():
        pytest.skip("the golden files are not beside the shared data")
    with (folder / "table3_feature_point_curves.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    golden = {(row["feature_point"], row["search_image"].lower()): row for row in rows}
    assert set(golden) == set(TABLE_3)
    for key, printed in TABLE_3.items():
        assert [float(golden[key][name]) for name in printed._fields] == list(printed)
    with (folder / "table4_ranking.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["search_image"].lower(): int(row["accumulated_label"]) for row in rows} == TABLE_4
    groups = [[r["search_image"].lower() for r in rows if r["rank_group"] == str(n)] for n in (1, 2, 3)]
    assert [set(group) for group in groups] == [set(group) for group in PRINTED_GROUPS]
