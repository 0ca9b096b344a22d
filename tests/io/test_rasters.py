from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import tracemalloc
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox
from rasterio.enums import MaskFlags
from rio_cogeo.cogeo import cog_validate

from zlocus.core.errors import OutputError
from zlocus.io.block_buffer import BlockBuffer
from zlocus.io.rasters import RasterBands, RasterSink, compression_threads, write_cog

RNG = np.random.default_rng(5)
GRID = GeoBox.from_bbox((500000, 4500000, 500350.5, 4500400), crs="EPSG:32631", resolution=0.5)
HEIGHTS = np.where(RNG.random(GRID.shape) > 0.1, RNG.normal(100, 9, GRID.shape), np.nan).astype(np.float32)


def assert_is_cog(path):
    valid, errors, warnings = cog_validate(path, strict=True)
    assert (valid, errors, warnings) == (True, [], [])


def test_surface(tmp_path):
    path = tmp_path / "dsm.tif"
    write_cog(path, HEIGHTS, GRID, nodata=np.nan, descriptions=("height",), units="m")
    assert_is_cog(path)
    assert os.listdir(tmp_path) == ["dsm.tif"]
    with rasterio.open(path) as file:
        np.testing.assert_array_equal(file.read(1), HEIGHTS)
        assert (file.dtypes, file.descriptions, file.units) == (("float32",), ("height",), ("m",))
        assert np.isnan(file.nodata)
        assert (file.transform, file.crs, file.shape) == (GRID.transform, "EPSG:32631", tuple(GRID.shape))
        assert file.overviews(1) == [2]
        block = HEIGHTS[:2, :2]
        mean = file.read(1, out_shape=(400, 351))[0, 0]
        assert np.nanmin(block) < mean < np.nanmax(block)
        assert mean not in block


def test_flags_are_not_averaged_in_the_overviews(tmp_path):
    flags = RNG.choice(np.array([1, 256], np.uint16), GRID.shape)
    write_cog(tmp_path / "quality.tif", flags, GRID)
    assert_is_cog(tmp_path / "quality.tif")
    with rasterio.open(tmp_path / "quality.tif") as file:
        assert file.nodata is None
        np.testing.assert_array_equal(file.read(1), flags)
        assert set(np.unique(file.read(1, out_shape=(400, 351)))) == {1, 256}


def test_colour_with_an_internal_mask(tmp_path):
    ortho = RNG.integers(0, 4000, (3, *GRID.shape)).astype(np.uint16)
    mask = np.isfinite(HEIGHTS)
    write_cog(tmp_path / "ortho.tif", ortho, GRID, mask=mask)
    assert_is_cog(tmp_path / "ortho.tif")
    assert os.listdir(tmp_path) == ["ortho.tif"]
    with rasterio.open(tmp_path / "ortho.tif") as file:
        assert file.mask_flag_enums == ([MaskFlags.per_dataset],) * 3
        np.testing.assert_array_equal(file.dataset_mask() > 0, mask)
        np.testing.assert_array_equal(file.read(masked=True).filled(0), np.where(mask, ortho, 0))


def test_same_cells_same_bytes_however_they_come(tmp_path):
    write_cog(tmp_path / "whole.tif", HEIGHTS, GRID, nodata=np.nan)
    write_cog(tmp_path / "again.tif", HEIGHTS, GRID, nodata=np.nan)
    expected = (tmp_path / "whole.tif").read_bytes()
    assert (tmp_path / "again.tif").read_bytes() == expected
    starts = [(row, col) for row in range(0, GRID.shape[0], 130) for col in range(0, GRID.shape[1], 170)]
    RNG.shuffle(starts)
    with RasterSink(tmp_path / "blocks.tif", GRID, RasterBands("float32", nodata=np.nan)) as sink:
        for row, col in starts:
            sink.write(row, col, HEIGHTS[row : row + 130, col : col + 170])
    assert (tmp_path / "blocks.tif").read_bytes() == expected


def test_blocks_from_threads(tmp_path):
    with RasterSink(tmp_path / "a.tif", GRID, RasterBands("float32", nodata=np.nan)) as sink:
        threads = [
            threading.Thread(target=sink.write, args=(row, 0, HEIGHTS[row : row + 50])) for row in range(0, 800, 50)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with rasterio.open(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal(file.read(1), HEIGHTS)


@pytest.mark.parametrize("threads", [2, 7])
def test_threads_that_compress_change_no_byte(tmp_path, threads):
    """More blocks and overviews than threads, some blocks of noise and some of one value, which take other times."""
    grid = GeoBox.from_bbox((500000, 4500000, 501000, 4500750), crs="EPSG:32631", resolution=0.5)
    cells = RNG.normal(100, 9, grid.shape).astype(np.float32)
    cells[:600, 350:1250] = 7.0
    write_cog(tmp_path / "one.tif", cells, grid, nodata=np.nan)
    for time in range(3):
        with compression_threads(threads):
            write_cog(tmp_path / f"{time}.tif", cells, grid, nodata=np.nan)
        assert (tmp_path / f"{time}.tif").read_bytes() == (tmp_path / "one.tif").read_bytes()


def test_gdal_sees_no_cell_before_the_end(tmp_path, monkeypatch):
    """Its cache loses cells of blocks that are changed while other threads read; see `zlocus.io.block_buffer`."""
    opened = []
    monkeypatch.setattr(
        rasterio, "open", lambda *args, open=rasterio.open, **kw: opened.append(args) or open(*args, **kw)
    )
    with RasterSink(tmp_path / "a.tif", GRID, RasterBands("uint8", has_mask=True)) as sink:
        sink.write(0, 0, np.ones((5, 6), np.uint8))
        assert not opened
    assert opened


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_a_block_buffer_is_an_array_on_disk(data):
    shape = tuple(data.draw(st.integers(1, most)) for most in (3, 23, 23))
    expected, came = np.full(shape, np.nan), np.zeros(shape[1:], bool)
    side = data.draw(st.integers(1, 9))
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(BlockBuffer(Path(folder) / "cells", shape, np.dtype(float), np.nan, side)) as waiting,
    ):
        for number in range(data.draw(st.integers(0, 6))):
            row, col = (data.draw(st.integers(0, n - 1)) for n in shape[1:])
            rows, cols = (data.draw(st.integers(1, n - first)) for n, first in zip(shape[1:], (row, col), strict=True))
            cells = number + RNG.random((shape[0], rows, cols))
            waiting.put(row, col, cells)
            expected[:, row : row + rows, col : col + cols] = cells
            came[row : row + rows, col : col + cols] = True
        found = np.full(shape, np.nan)
        for (rows, cols), cells in waiting:
            assert came[rows, cols].any()
            found[:, rows, cols] = cells
    np.testing.assert_array_equal(found, expected)


DIGITS = 1e-12  # relative, of statistics written with 14 digits


def statistics_of(path):
    with rasterio.open(path) as file:
        tags = [file.tags(band) for band in file.indexes]
    names = ("MINIMUM", "MAXIMUM", "MEAN", "STDDEV", "VALID_PERCENT")
    return [[float(band[f"STATISTICS_{name}"]) for name in names] for band in tags]


def expected_statistics(valid, n):
    return [valid.min(), valid.max(), valid.mean(), valid.std(), float(f"{100 * valid.size / n:.4g}")]


def test_statistics_of_heights(tmp_path):
    # A mean far above the spread is where sums of squares lose their digits.
    high = (HEIGHTS + np.float32(60000)).astype(np.float32)
    write_cog(tmp_path / "dsm.tif", high, GRID, nodata=np.nan)
    expected = expected_statistics(high[np.isfinite(high)].astype(float), high.size)
    np.testing.assert_allclose(statistics_of(tmp_path / "dsm.tif"), [expected], rtol=DIGITS)
    assert_is_cog(tmp_path / "dsm.tif")
    assert os.listdir(tmp_path) == ["dsm.tif"]


def test_statistics_count_cells_that_were_never_written(tmp_path):
    block = RNG.integers(1, 200, (300, 400)).astype(np.uint8)
    whole = np.zeros(GRID.shape, np.uint8)
    whole[20:320, 90:490] = block
    for nodata, valid in ((None, whole.astype(float)), (0, block.astype(float))):
        with RasterSink(tmp_path / "a.tif", GRID, RasterBands("uint8", nodata=nodata)) as sink:
            sink.write(20, 90, block)
        expected = expected_statistics(valid, whole.size)
        np.testing.assert_allclose(statistics_of(tmp_path / "a.tif"), [expected], rtol=DIGITS)


def test_statistics_under_a_mask_band_by_band(tmp_path):
    ortho = RNG.integers(0, 4000, (3, *GRID.shape)).astype(np.uint16)
    mask = np.isfinite(HEIGHTS)
    write_cog(tmp_path / "ortho.tif", ortho, GRID, mask=mask)
    expected = [expected_statistics(band[mask].astype(float), mask.size) for band in ortho]
    np.testing.assert_allclose(statistics_of(tmp_path / "ortho.tif"), expected, rtol=DIGITS)


def test_a_band_without_valid_cells_has_no_statistics(tmp_path):
    write_cog(tmp_path / "a.tif", np.full(GRID.shape, np.nan, np.float32), GRID, nodata=np.nan)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert not [name for name in file.tags(1) if name.startswith("STATISTICS")]


@pytest.mark.parametrize(("nodata", "dtype"), [(np.nan, "float32"), (0, "uint8"), (None, "uint16")])
def test_cells_never_written_are_nodata(tmp_path, nodata, dtype: str):
    with RasterSink(tmp_path / "a.tif", GRID, RasterBands(dtype, nodata=nodata)) as sink:
        sink.write(10, 20, np.ones((5, 6), dtype))
    with rasterio.open(tmp_path / "a.tif") as file:
        cells = file.read(1)
    assert (cells == 1).sum() == 30
    assert (cells[10:15, 20:26] == 1).all()
    empty = np.isnan(cells) if dtype == "float32" else cells == 0
    assert empty.sum() == cells.size - 30


def test_nothing_is_there_before_the_end_or_after_a_failure(tmp_path):
    def fail():
        with RasterSink(tmp_path / "a.tif", GRID, RasterBands("uint8")) as sink:
            sink.write(0, 0, np.ones((5, 6), np.uint8))
            assert not (tmp_path / "a.tif").exists()
            raise KeyError("a fault in the middle")

    with pytest.raises(KeyError):
        fail()
    assert os.listdir(tmp_path) == []


def test_an_older_product_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "a.tif"
    write_cog(path, HEIGHTS, GRID)
    older = path.read_bytes()
    sink = RasterSink(path, GRID, RasterBands("float32"))
    sink.write(0, 0, HEIGHTS * 2)
    assert path.read_bytes() == older
    sink.close()
    assert path.read_bytes() != older


def test_the_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "none" / "a.tif", tmp_path / "file" / "a.tif"):
        with pytest.raises(OutputError, match=r"a\.tif cannot be written: .*Check the folder"):
            write_cog(path, HEIGHTS, GRID)


FULL_DISK = """
import os, resource, signal, sys
import numpy as np
from odc.geo.geobox import GeoBox
from pathlib import Path
from zlocus.core.errors import OutputError
from zlocus.io.rasters import compression_threads, write_cog
grid = GeoBox.from_bbox((0, 0, 1024, 1024), crs="EPSG:32631", resolution=1)
cells = np.random.default_rng(0).normal(size=(1024, 1024)).astype(np.float32)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
try:
    with compression_threads(int(sys.argv[3])):
        write_cog(Path(sys.argv[1]) / "a.tif", cells, grid)
except OutputError as error:
    print(error)
"""


# The waiting file of 1024 x 1024 float32 has 4 195 000 bytes, the COG of noise more: each step runs out of space once.
@pytest.mark.skipif(sys.platform == "win32", reason="no file size limit")
@pytest.mark.parametrize(
    ("limit", "threads"), [(100, 1), (1_000_000, 1), (4_000_000, 1), (4_300_000, 1), (4_300_000, 3)]
)
def test_full_disk(tmp_path, limit: int, threads: int):
    words = [sys.executable, "-c", FULL_DISK, str(tmp_path), str(limit), str(threads)]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert "a.tif cannot be written" in run.stdout, run.stderr
    assert os.listdir(tmp_path) == []


def test_large_rasters_are_not_held_in_memory(tmp_path):
    grid = GeoBox.from_bbox((0, 0, 3000, 3000), crs="EPSG:32631", resolution=1)
    tracemalloc.start()
    with RasterSink(tmp_path / "a.tif", grid, RasterBands("float32", nodata=np.nan)) as sink:
        for row in range(0, 3000, 300):
            sink.write(row, 0, np.full((300, 3000), row, np.float32))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12e6  # bytes; the raster has 36e6


def test_cells_are_read_before_the_raster_is_finished(tmp_path):
    """Across blocks, and where nothing has been written yet; a part that is written again is the new one."""
    cells = np.arange(600 * 700, dtype=np.float32).reshape(600, 700)
    grid = GeoBox((600, 700), GRID.transform, GRID.crs)
    with RasterSink(tmp_path / "a.tif", grid, RasterBands("float32", nodata=np.nan)) as sink:
        sink.write(0, 0, cells[:550])
        np.testing.assert_array_equal(sink.read(500, 480, (40, 60)), cells[500:540, 480:540])
        assert np.isnan(sink.read(560, 0, (40, 700))).all()
        sink.write(500, 480, -cells[500:540, 480:540])
        np.testing.assert_array_equal(sink.read(500, 480, (40, 60)), -cells[500:540, 480:540])
