"""Images that are decoded as a whole: once, as long as they fit into the memory for them."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from zlocus.io import decoded_images, images
from zlocus.io.decoded_images import DecodedImages
from zlocus.io.images import open_image
from zlocus.io.open_raster import cached_raster

SHAPE, WINDOW = (60, 80), Window(0, 0, 5, 5)


class Counted:
    """A raster that counts how often it is read."""

    def __init__(self, source):
        self.source, self.n_reads = source, 0

    def __getattr__(self, name):
        return getattr(self.source, name)

    def read(self, *given, **named):
        self.n_reads += 1
        return self.source.read(*given, **named)


def write(path, seed=0, driver="JPEG"):
    pixels = np.random.default_rng(seed).integers(0, 255, (3, *SHAPE)).astype(np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver=driver, width=SHAPE[1], height=SHAPE[0], count=3, dtype="uint8") as file:
            file.write(pixels)
            file.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    return path


@pytest.mark.parametrize("driver", ["JPEG", "PNG"])
def test_windows_are_those_of_the_file_which_is_decoded_once(tmp_path, driver):
    path, decoded = write(tmp_path / f"a.{driver.lower()}", driver=driver), DecodedImages(1 << 20)
    with cached_raster(path) as source:
        counted, whole = Counted(source), source.read()
        for band, (row, col) in ((1, (0, 0)), (3, (17, 30)), (2, (50, 70))):
            found = decoded.window(counted, path, band, Window(col, row, 10, 9))
            np.testing.assert_array_equal(found, whole[band - 1, row : row + 9, col : col + 10])
    assert counted.n_reads == 1


def test_formats_with_random_access_and_images_that_do_not_fit_are_read_by_window(tmp_path):
    for path, n_bytes in ((write(tmp_path / "a.tif", driver="GTiff"), 1 << 20), (write(tmp_path / "a.jpg"), 1000)):
        with cached_raster(path) as source:
            counted, decoded = Counted(source), DecodedImages(n_bytes)
            for _ in range(2):
                found = decoded.window(counted, path, 2, Window(5, 6, 10, 9))
                np.testing.assert_array_equal(found, source.read(2)[6:15, 5:15])
        assert counted.n_reads == 2


def test_the_least_recently_used_image_is_forgotten(tmp_path):
    paths, decoded, window = [write(tmp_path / f"{k}.jpg", k) for k in range(3)], DecodedImages(30_000), WINDOW
    n_reads = []
    for number in (0, 1, 0, 2, 0, 1):
        with cached_raster(paths[number]) as source:
            counted = Counted(source)
            decoded.window(counted, paths[number], 1, window)
            n_reads.append(counted.n_reads)
    assert n_reads == [1, 1, 0, 1, 0, 1]


def test_a_smaller_limit_forgets_images_at_once(tmp_path):
    paths, decoded, window = (
        [write(tmp_path / f"{k}.jpg", k) for k in range(3)],
        DecodedImages(1 << 20),
        Window(0, 0, 5, 5),
    )
    for path in paths:
        with cached_raster(path) as source:
            decoded.window(source, path, 1, window)
    one = 3 * SHAPE[0] * SHAPE[1]
    assert decoded.held_bytes == 3 * one
    decoded.limit(2 * one)
    assert decoded.held_bytes == 2 * one
    decoded.limit(one - 1)
    assert decoded.held_bytes == 0
    with cached_raster(paths[0]) as source:
        np.testing.assert_array_equal(decoded.window(source, paths[0], 1, window), source.read(1)[:5, :5])
    assert decoded.held_bytes == 0


def test_a_file_that_has_changed_is_decoded_again(tmp_path, monkeypatch):
    monkeypatch.setattr(images, "DECODED", DecodedImages(1 << 20))
    path = write(tmp_path / "a.jpg", 1)
    before = open_image(path).read(0, 0, *SHAPE).pixels
    path.unlink()
    write(path, 2)
    after = open_image(path).read(0, 0, *SHAPE).pixels
    assert np.abs(after - before).mean() > 10


def test_there_is_one_memory_for_a_process():
    assert images.DECODED is decoded_images.DECODED
