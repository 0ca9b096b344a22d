"""Differences of two surfaces: on one grid, on others, in other CRS and datums, and where there is nothing."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
import rasterio.warp
from affine import Affine

from geoids import write_geoid
from zlocus.core.errors import InputError
from zlocus.evaluation import differences as module
from zlocus.evaluation.differences import surface_differences

WEST, NORTH, CELL_M = 462_000.0, 5_247_000.0, 0.5
SHAPE = (40, 60)


def ground(x, y):
    return 50 + 3 * np.sin((x - WEST) / 7) * np.cos((NORTH - y) / 5)


def written(path, change=None, shape=SHAPE, cell_m=CELL_M, corner=(WEST, NORTH), crs="EPSG:32632"):
    """The ground on a grid. change : of its heights (r, c), in place."""
    where = Affine(cell_m, 0, corner[0], 0, -cell_m, corner[1])
    col, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    z = ground(*(where * (col, row)))
    if change is not None:
        change(z)
    with rasterio.open(
        path, "w", driver="GTiff", width=shape[1], height=shape[0], count=1, dtype="float32", crs=crs,
        transform=where, nodata=np.nan,
    ) as file:  # fmt: skip
        file.write(z.astype(np.float32), 1)
    return path


def raised(z):
    z += 0.25
    z[:5] += 2.0
    z[10:12, 20:30] = np.nan


def holed(z):
    z[20, :7] = np.nan


def test_two_surfaces_of_one_grid(tmp_path):
    found = surface_differences(written(tmp_path / "a.tif", holed), written(tmp_path / "b.tif", raised))
    assert found.same_cells
    assert found.n_both == SHAPE[0] * SHAPE[1] - 20 - 7
    assert (found.only_first.sum(), found.only_second.sum(), found.n_elsewhere) == (20, 7, 0)
    assert found.only_first[10:12, 20:30].all()
    assert found.only_second[20, :7].all()
    known = found.difference[np.isfinite(found.difference)]
    np.testing.assert_allclose(known[:300], 2.25, atol=1e-5)
    np.testing.assert_allclose(known[300:], 0.25, atol=1e-5)
    statistics = found.statistics
    assert statistics.median == pytest.approx(0.25, abs=1e-5)
    assert statistics.rmse == pytest.approx(np.sqrt(np.mean(known.astype(float) ** 2)), abs=1e-6)
    assert dict(statistics.shares)[1.0] == pytest.approx(1 - 300 / known.size)
    assert found.highest_m == pytest.approx(2.25, abs=1e-5)
    assert found.geobox.crs.epsg == 32632


def test_the_grid_is_that_of_the_first(tmp_path):
    """Another extent, finer and coarser cells: looked up, or averaged, as `zlocus evaluate` does."""
    first = written(tmp_path / "a.tif")
    moved = surface_differences(first, written(tmp_path / "b.tif", corner=(WEST + 5, NORTH), shape=(40, 60)))
    assert moved.same_cells
    assert moved.difference.shape == SHAPE
    assert moved.only_first[:, :10].all()
    assert moved.n_elsewhere == 10 * 40
    assert np.nanmax(np.abs(moved.difference)) < 1e-4
    fine = surface_differences(first, written(tmp_path / "c.tif", shape=(200, 300), cell_m=0.1))
    assert (fine.same_cells, fine.places_per_cell) == (False, 25)
    assert np.abs(fine.difference).max() < 0.01
    coarse = surface_differences(first, written(tmp_path / "d.tif", shape=(20, 30), cell_m=1.0))
    assert coarse.places_per_cell == 1
    assert 0.05 < np.abs(coarse.difference).max() < 0.5
    offset = surface_differences(first, written(tmp_path / "e.tif", corner=(WEST + 0.2, NORTH)))
    assert not offset.same_cells


def test_strips_change_nothing(tmp_path, monkeypatch):
    first, second = written(tmp_path / "a.tif", holed), written(tmp_path / "b.tif", raised, corner=(WEST + 3, NORTH))
    whole = surface_differences(first, second)
    monkeypatch.setattr(module, "CELLS_AT_A_TIME", 100)
    parts = surface_differences(first, second)
    np.testing.assert_array_equal(parts.difference, whole.difference)
    assert (parts.n_elsewhere, parts.statistics) == (whole.n_elsewhere, whole.statistics)


def test_another_crs_is_brought_onto_the_grid(tmp_path):
    """The neighbouring UTM zone, where the same ground has other coordinates."""
    first, second = written(tmp_path / "a.tif"), written(tmp_path / "b.tif", raised)
    other = tmp_path / "other.tif"
    with rasterio.open(second) as source:
        transform, width, height = rasterio.warp.calculate_default_transform(
            source.crs, "EPSG:32633", source.width, source.height, *source.bounds, resolution=0.1
        )
        z = np.full((height, width), np.nan, np.float32)
        rasterio.warp.reproject(
            source.read(1), z, src_transform=source.transform, src_crs=source.crs, dst_transform=transform,
            dst_crs="EPSG:32633", src_nodata=np.nan, dst_nodata=np.nan,
        )  # fmt: skip
        profile = source.profile | {"crs": "EPSG:32633", "transform": transform, "width": width, "height": height}
    with rasterio.open(other, "w", **profile) as file:
        file.write(z, 1)
    found = surface_differences(first, other)
    assert not found.same_cells
    assert found.statistics.median == pytest.approx(0.25, abs=0.02)
    assert found.geobox.crs.epsg == 32632


def test_other_vertical_datums_are_refused_or_converted(tmp_path):
    first, second = written(tmp_path / "a.tif", crs="EPSG:32632+5773"), written(tmp_path / "b.tif", raised)
    with rasterio.open(second, "r+") as file:
        file.set_band_description(1, "height above the ellipsoid")
    with pytest.raises(InputError, match=r"b\.tif are above the ellipsoid and those of .*a\.tif above EGM96"):
        surface_differences(first, second)
    geoid = write_geoid(tmp_path / "geoid.tif", np.full((8, 8), 40.0, np.float32), Affine(1, 0, 5, 0, -1, 50))
    found = surface_differences(first, second, geoid)
    assert found.statistics.median == pytest.approx(0.25 - 40.0, abs=0.01)
    assert found.datums == ("EGM96 height", "ellipsoid")
    assert any("the geoid's heights were added" in sentence for sentence in found.assumed)


def test_what_was_assumed_is_said(tmp_path):
    found = surface_differences(written(tmp_path / "a.tif"), written(tmp_path / "b.tif", crs=None))
    assert found.assumed == (f"no CRS is known of {tmp_path / 'b.tif'}: coordinates were compared as they are",)


def test_surfaces_without_a_common_cell_are_refused(tmp_path):
    first = written(tmp_path / "a.tif")
    with pytest.raises(InputError, match=r"a\.tif \(EPSG:32632\) and .*b\.tif \(EPSG:32632\) do not overlap\. Give"):
        surface_differences(first, written(tmp_path / "b.tif", corner=(WEST + 500, NORTH)))

    def nothing(z):
        z[:] = np.nan

    with pytest.raises(InputError, match="overlap, but no cell has a height in both"):
        surface_differences(first, written(tmp_path / "c.tif", nothing))
