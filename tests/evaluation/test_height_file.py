"""Rasters of heights that are read by windows: the same heights as of the whole raster."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation_rasters import CELL_M, NORTH, WEST, moved, write
from zlocus.core.errors import InputError
from zlocus.evaluation import height_file
from zlocus.evaluation.height_file import HeightFile
from zlocus.evaluation.heights import read_heights


def test_heights_by_windows_are_those_of_the_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(height_file, "BLOCK", 32)

    def spoiled(z):
        z[20:50, 30:35] = np.nan
        return z

    path = moved(tmp_path / "d.tif", 101, (0, 0, 0), change=spoiled)
    xy = np.column_stack([np.random.default_rng(0).uniform(-3, 101 * CELL_M + 3, 3000) for _ in range(2)]) * (1, -1)
    xy += (WEST, NORTH)
    xy[5] = np.nan
    file = HeightFile.open(path)
    np.testing.assert_array_equal(file.bilinear(xy), read_heights(path).bilinear(xy))
    assert file.bounds == (WEST, NORTH - 50.5, WEST + 50.5, NORTH)
    assert file.cell == CELL_M


def test_what_is_no_surface_is_refused(tmp_path):
    with pytest.raises(InputError, match="1 x 5 cells, too few"):
        HeightFile.open(write(tmp_path / "d.tif", np.zeros((1, 5), np.float32)))
    path = moved(tmp_path / "cut.tif", 101, (0, 0, 0))
    path.write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(InputError, match=r"cut.tif"):
        HeightFile.open(path).bilinear(np.array([[WEST + 20, NORTH - 50]]))
