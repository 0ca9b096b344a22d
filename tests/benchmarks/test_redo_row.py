"""The row on parts that are redone: cells that change are counted, and a mixture of two surfaces is noticed."""

import json
import shutil
from pathlib import Path

import numpy as np
import rasterio
import shapely
from pyogrio.raw import write as write_vector

from rows import redo as redo_row
from zlocus.pipeline.finished_record import read_finished


def test_changed_cells_and_mixtures_are_noticed(small_surface, tmp_path):
    copy = Path(shutil.copytree(small_surface, tmp_path / "copy"))
    assert not redo_row.changed_cells(small_surface, copy).any()
    assert not redo_row.is_whole(copy)  # no part was redone
    run = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps(run | {"redone": [{}]}))
    finished = json.loads((copy / "finished.json").read_text())
    finished["products"]["run.json"] = redo_row.checksums(copy)["run.json"]
    (copy / "finished.json").write_text(json.dumps(finished))
    assert read_finished(copy) is not None
    assert redo_row.is_whole(copy)
    with rasterio.open(copy / "views.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as file:
        views = file.read(1)
        views[3, 4] += 1
        file.write(views, 1)
    assert np.argwhere(redo_row.changed_cells(small_surface, copy)).tolist() == [[3, 4]]
    assert not redo_row.is_whole(copy)


def test_areas_and_outlines_lie_on_the_surface(small_town, small_surface, tmp_path):
    scene = Path(shutil.copytree(small_town, tmp_path / "town"))
    surface = Path(shutil.copytree(small_surface, tmp_path / "surface"))
    inside = redo_row.cells_of(redo_row.write_area(surface, 5), surface)
    assert 0.05 < inside.mean() < 0.8
    redo_row.write_outlines(scene)
    everything = tmp_path / "everything.gpkg"
    with rasterio.open(surface / "dsm.tif") as file:
        box = shapely.box(*file.bounds)
        assert np.nanmin(file.read(1)) <= redo_row.level_of(surface) <= np.nanmax(file.read(1))
    write_vector(
        everything, shapely.to_wkb(np.array([box], object)), [], [], geometry_type="Polygon", crs="EPSG:32632"
    )  # fmt: skip
    near = redo_row.near_outlines(surface, scene, everything)
    assert 0.02 < near.mean() < 0.8
    # Beside walls, a part of the heights is right and another part is not.
    assert 0.2 < redo_row.right_near_outlines(surface, scene, everything) < 1.0
