"""The area that is redone, on its grid: cells, ramps, and blocks that fit together."""

import numpy as np
import pytest
import shapely
from affine import Affine
from odc.geo.geobox import GeoBox

from zlocus.products.redone_area import RedoneArea

GEOBOX = GeoBox((60, 80), Affine(0.5, 0, 1000, 0, -0.5, 2030), "EPSG:32632")
# 40 x 30 cells, from column 20 and row 15 on.
SQUARE = shapely.box(1010, 2007.5, 1030, 2022.5)


def area_of(polygons, margin_m=None):
    return RedoneArea.of(np.array(polygons, object), GEOBOX, margin_m)


def test_the_new_surface_counts_inside_and_passes_over_on_a_ramp():
    weight = area_of([SQUARE], 2.0).weights(0, 0, (60, 80))
    inside = np.zeros((60, 80), bool)
    inside[15:45, 20:60] = True
    assert (weight[~inside] == 0).all()
    assert (weight[inside] > 0).all()
    across = weight[30, 20:60]
    share = np.clip((np.arange(20) + 0.5) / 4, 0, 1)
    assert across[:20] == pytest.approx(share * share * (3 - 2 * share), abs=1e-6)
    assert across[20:] == pytest.approx(across[:20][::-1], abs=1e-6)
    assert (across[4:36] == 1).all()


def test_blocks_have_the_weights_of_the_whole():
    area = area_of([SQUARE, shapely.box(1032, 2002, 1036, 2028)], 2.0)
    whole = area.weights(0, 0, (60, 80))
    for row, col, shape in ((0, 0, (17, 23)), (15, 20, (9, 40)), (29, 50, (31, 30)), (58, 78, (2, 2))):
        assert (area.weights(row, col, shape) == whole[row : row + shape[0], col : col + shape[1]]).all()


def test_polygons_that_overlap_have_no_ramp_between_them():
    one, two = shapely.box(1010, 2007.5, 1022, 2022.5), shapely.box(1018, 2007.5, 1030, 2022.5)
    assert (area_of([one, two]).weights(0, 0, (60, 80)) == area_of([SQUARE]).weights(0, 0, (60, 80))).all()


def test_the_ramp_of_a_narrow_polygon_leaves_its_middle_to_the_new_surface():
    weight = area_of([shapely.box(1010, 2012, 1030, 2015)]).weights(0, 0, (60, 80))  # six cells wide
    assert weight[:, 40].max() == 1


def test_without_a_margin_all_cells_inside_are_new():
    weight = area_of([SQUARE], 0.0).weights(0, 0, (60, 80))
    assert set(np.unique(weight)) == {0, 1}


def test_the_edge_of_the_grid_is_no_border():
    weight = area_of([shapely.box(900, 1900, 1100, 2100)]).weights(0, 0, (60, 80))
    assert (weight == 1).all()


def test_blocks_without_cells_are_known():
    area = area_of([SQUARE])
    assert area.has_cells(15, 20, (1, 1))
    assert not area.has_cells(0, 0, (15, 80))
