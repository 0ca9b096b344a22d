"""What a run says of the polygons that it is given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from affine import Affine
from odc.geo.geobox import GeoBox

from zlocus.core.progress import KeptNotes
from zlocus.pipeline.open_run import note_mask_beside

# 10 x 20 cells of 1 m, from (0, 0) to (20, 10).
GRID = GeoBox((10, 20), Affine(1.0, 0.0, 0.0, 0.0, -1.0, 10.0), "EPSG:32632")


@pytest.mark.parametrize(
    ("polygons", "is_said"),
    [
        ([shapely.box(30, 0, 40, 10)], True),
        ([shapely.box(30, 0, 40, 10), shapely.box(15, 5, 40, 6)], False),
        ([shapely.box(-5, -5, 50, 50)], False),
    ],
)
def test_a_mask_that_lies_outside_the_grid_is_said(polygons, is_said):
    progress = KeptNotes()
    note_mask_beside(Path("m.gpkg"), np.array(polygons, object), GRID, progress)
    assert len(progress.sentences) == is_said
    assert all(said.startswith("--mask m.gpkg leaves nothing out") for said in progress.sentences)


def test_without_a_mask_nothing_is_said():
    progress = KeptNotes()
    note_mask_beside(None, None, GRID, progress)
    assert progress.sentences == []
