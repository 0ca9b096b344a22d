"""Images in sparse files, which store few of their pixels: processed, or refused in a sentence, within seconds."""

from __future__ import annotations

import re
import time
import warnings
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window
from typer.testing import CliRunner

import zlocus.io.images as images_module
import zlocus.pipeline.required_space
from rendered_scenes import GSD_M, HEIGHTS, SIZE_PX, errors_of, read
from zlocus.cli.app import app
from zlocus.core.errors import InputError, OutputError
from zlocus.core.scene import HeldPixels, held_window
from zlocus.io.images import check_content, open_image
from zlocus.io.scene_file import open_scene
from zlocus.io.tiff_blocks import held_in_blocks
from zlocus.orientation.sift import parts
from zlocus.pipeline.required_space import check_room_before_ties, surface_bytes

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

# Of a command on images that are looked at by their headers alone. Before, the same took more than a minute each.
WITHIN_S = 15.0
Disk = namedtuple("Disk", "total used free")


def sparse(of: Path, path: Path, side: int, places: list[tuple[int, int]], block=256, scale=1.0) -> Path:
    """A sparse TIFF of `side` pixels a side that holds an image at some places (row, column), and its camera.

    scale : by how much larger the ground is that the camera sees, at the same ground pixel; the middle of the image is
    then the middle of the ground.
    """
    with rasterio.open(of) as source:
        rpcs, grey = source.rpcs, source.read(1)
    if scale == 1.0:
        rpcs.line_off, rpcs.samp_off = rpcs.line_off + places[0][0], rpcs.samp_off + places[0][1]
    else:
        rpcs.line_off = rpcs.samp_off = (side - 1) / 2
        for name in ("line", "samp", "lat", "long", "height"):
            setattr(rpcs, f"{name}_scale", getattr(rpcs, f"{name}_scale") * scale)
    with rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=1, dtype=grey.dtype, rpcs=rpcs, nodata=0,
        tiled=True, blockxsize=block, blockysize=block, SPARSE_OK="TRUE", BIGTIFF="YES",
    ) as file:  # fmt: skip
        for row, col in places:
            file.write(grey, 1, window=Window(col, row, *grey.shape[::-1]))
    return path


def pair(images, tmp_path, *how, **more):
    """Two images of the sine, each in a sparse file."""
    return [sparse(images("sine").paths[name], tmp_path / f"{name}.tif", *how, **more) for name in ("nadir", "fore")]


def command(*words):
    """What a command says, and its exit status; it ends within seconds."""
    start = time.monotonic()
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert time.monotonic() - start < WITHIN_S
    return result


ASKED = ("--crs", "EPSG:32632", "--resolution", GSD_M, "--heights", *HEIGHTS)


@pytest.mark.parametrize(("side", "block"), [(1_000_000, 4096), (200_000, 256)])
def test_a_sparse_file_that_holds_nothing_is_refused_at_once(images, tmp_path, side, block):
    inputs = pair(images, tmp_path, side, [], block, scale=side / SIZE_PX)
    says = f"nadir.tif holds no pixels: it is a sparse file of {side} x {side} px, and none of its blocks was ever"
    result = command("dsm", *inputs, "-o", tmp_path / "out", *ASKED)
    assert result.exit_code == 2
    assert says in result.stderr
    assert not (tmp_path / "out").exists()
    result = command("doctor", *inputs, *ASKED)
    assert result.exit_code == 2
    assert says in result.stdout


def test_the_part_that_a_sparse_file_holds_is_matched(images, tmp_path):
    """Far from the first pixel of an image of 200 000 x 200 000 px, as if the file held nothing else."""
    inputs = pair(images, tmp_path, 200_000, [(195 * 256, 160 * 256)])
    # The first surface of all compiles the kernels.
    whole = [str(word) for word in ("dsm", *images("sine").inputs[:2], "-o", tmp_path / "whole", *ASKED, "--no-report")]
    assert CliRunner().invoke(app, whole).exit_code == 0
    result = command("dsm", *inputs, "-o", tmp_path / "out", *ASKED, "--no-report")
    assert result.exit_code == 0, result.stderr
    assert max(read(tmp_path / "out" / "dsm.tif")[0].shape) < 600
    error, seen = errors_of(tmp_path / "out", "sine")
    assert np.mean(np.abs(error[seen]) < GSD_M) > 0.9
    result = command("doctor", *inputs, *ASKED)
    assert result.exit_code == 0
    assert "Nothing speaks against a run." in result.stdout


def test_a_surface_without_room_on_the_disk_is_refused_before_the_tie_points(images, tmp_path):
    """Two opposite corners of an image are there, and the ground between them has 10^12 cells."""
    side = 1_000_000
    inputs = pair(images, tmp_path, side, [(0, 0), (side - 4096, side - 4096)], 4096, scale=side / SIZE_PX)
    says = r"needs at least \d+ GB on disk while it is made, and the disk of .* has \d+ GB free\. Give smaller --bounds"
    result = command("dsm", *inputs, "-o", tmp_path / "out", *ASKED)
    assert result.exit_code == 2
    assert "Tie points" not in result.stderr
    assert not (tmp_path / "out").exists()
    assert re.search(says, result.stderr)
    result = command("doctor", *inputs, *ASKED)
    assert result.exit_code == 2
    assert re.search(says, result.stdout)


def test_pixels_without_room_in_memory_and_on_the_disk_are_refused(images, tmp_path):
    """In image space every pixel of an image gets a height, also where the file holds none."""
    inputs = pair(images, tmp_path, 200_000, [(195 * 256, 160 * 256)])
    # A cloud keeps its heights on disk, a surface in memory.
    surface, gb = ("dsm", "--method", "gc3-sgm", "--resolution", GSD_M), r"takes at least \d+ GB"
    for words, room in (
        (("cloud",), r"on disk, and the disk of .* has \d+ GB free"),
        (surface, r", and memory has \d+ GB"),
    ):
        result = command(*words, *inputs, "-o", tmp_path / "out", *ASKED[:2], *ASKED[4:])
        assert result.exit_code == 2
        assert re.search(rf"pixels of 2 images {gb} ?{room}", " ".join(result.stderr.split()))
        assert not (tmp_path / "out").exists()


def test_large_images_are_refused_only_where_the_disk_is_too_small(images, tmp_path, monkeypatch):
    """Images of 40 000 x 40 000 px at their own resolution."""
    side = 40_000
    inputs = pair(images, tmp_path, side, [(0, 0), (side - 256, side - 256)], scale=side / SIZE_PX)
    scene = open_scene(inputs)
    needed = surface_bytes(side**2, side**2, "uint16", has_colours=False)
    assert 30e9 < needed < 60e9

    def with_room(n_bytes):
        monkeypatch.setattr(
            zlocus.pipeline.required_space.shutil, "disk_usage", lambda _: Disk(1e12, 1e12 - n_bytes, n_bytes)
        )
        check_room_before_ties(tmp_path, scene, None, None, None)

    with_room(needed)
    with pytest.raises(OutputError, match="needs at least"):
        with_room(needed / 10)
    # Smaller ones are begun.
    check_room_before_ties(tmp_path, scene, 100 * GSD_M, None, None)


@pytest.mark.parametrize("profile", [
    {"tiled": True, "blockxsize": 16, "blockysize": 32},
    {"tiled": True, "blockxsize": 16, "blockysize": 16, "BIGTIFF": "YES", "compress": "deflate"},
    {"tiled": True, "blockxsize": 32, "blockysize": 16, "interleave": "band", "ENDIANNESS": "BIG"},
    {"blockysize": 7, "ENDIANNESS": "BIG", "BIGTIFF": "YES"},
    {"blockysize": 1, "interleave": "pixel"},
])  # fmt: skip
@pytest.mark.parametrize("at_once", [1 << 20, 5])
def test_the_list_of_blocks_agrees_with_gdal(tmp_path, profile, at_once, monkeypatch):
    """In each order of bytes and of bands, few values at a time or all."""
    monkeypatch.setattr("zlocus.io.tiff_blocks.VALUES_AT_ONCE", at_once)
    path, rng = tmp_path / "a.tif", np.random.default_rng(3)
    with rasterio.open(
        path, "w", driver="GTiff", width=150, height=130, count=2, dtype=np.uint16, SPARSE_OK="TRUE", **profile
    ) as file:
        for row, col in ((40, 100), (90, 20)):
            file.write(rng.integers(1, 99, (2, 10, 12)).astype(np.uint16), window=Window(col, row, 12, 10))
    with rasterio.open(path) as source:
        rows, cols = source.block_shapes[0]
        down, across = -(-130 // rows), -(-150 // cols)
        expected = np.array(
            [[source.get_tag_item(f"BLOCK_OFFSET_{x}_{y}", "TIFF", bidx=1) is not None for x in range(across)]
             for y in range(down)]
        )  # fmt: skip
        held = held_in_blocks(source, path)
    assert 0 < expected.sum() < expected.size
    assert held.cell_px == (rows, cols)
    np.testing.assert_array_equal(held.cells, expected)


def test_a_file_that_stores_all_blocks_is_not_sparse(images):
    for path in images("sine").inputs:
        image = open_image(path)
        assert image.held is None
        assert held_window(image) == (0, 0, *image.shape)


def test_many_blocks_are_grouped_into_cells(tmp_path, monkeypatch):
    monkeypatch.setattr("zlocus.io.tiff_blocks.MAX_CELLS_PER_AXIS", 4)
    path = tmp_path / "a.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=160, height=96, count=1, dtype=np.uint8, SPARSE_OK="TRUE", tiled=True,
        blockxsize=16, blockysize=16,
    ) as file:  # fmt: skip
        file.write(np.arange(1, 21, dtype=np.uint8).reshape(4, 5), 1, window=Window(50, 33, 5, 4))
    held = open_image(path).held
    assert held.cell_px == (32, 48)
    assert np.argwhere(held.cells).tolist() == [[1, 1]]
    assert held.window == (32, 48, 32, 48)


def test_what_a_sparse_file_does_not_hold_is_not_valid(images, tmp_path):
    """Without a declared nodata value too, where GDAL reads 0, a legal grey value."""
    path = sparse(images("sine").paths["nadir"], tmp_path / "a.tif", 1024, [(256, 512)])
    with rasterio.open(path, "r+") as file:
        file.nodata = None
        stored = file.read(1)
    image, there = open_image(path), np.zeros((1024, 1024), bool)
    there[256:512, 512:768] = True
    for row, col, rows, cols in ((0, 0, 1024, 1024), (250, 500, 300, 100), (300, 600, 40, 50), (700, 0, 9, 9)):
        window, part = image.read(row, col, rows, cols), np.s_[row : row + rows, col : col + cols]
        np.testing.assert_array_equal(window.valid, there[part])
        np.testing.assert_array_equal(window.pixels, stored[part])


def test_windows_that_hold_pixels_by_hand():
    rng = np.random.default_rng(8)
    held = HeldPixels((7, 5), (66, 48), rng.random((10, 10)) < 0.1)
    pixels = np.kron(held.cells, np.ones(held.cell_px, bool))[:66, :48]
    first = rng.integers(0, (60, 40), (200, 2))
    windows = np.column_stack([first, np.minimum(first + rng.integers(1, 12, (200, 2)), (66, 48))])
    expected = []
    for top, left, bottom, right in windows:
        # Whole cells, as far as they are told apart.
        cells = np.s_[top // 7 * 7 : -(-bottom // 7) * 7, left // 5 * 5 : -(-right // 5) * 5]
        expected.append(pixels[cells].any())
    np.testing.assert_array_equal(held.inside(windows), expected)
    rows, cols = np.nonzero(pixels)
    assert held.window == (rows.min(), cols.min(), np.ptp(rows) + 1, np.ptp(cols) + 1)


def test_features_are_searched_in_the_stored_parts_only(images, tmp_path):
    side = 100_000
    (path,) = [sparse(images("sine").paths["nadir"], tmp_path / "a.tif", side, [(512, 256), (99_000, 60_000)])]
    image = open_image(path)
    cores = [core for _, core in parts(image)]
    assert 2 <= len(cores) <= 8
    for row, col in ((512, 256), (99_000, 60_000)):
        assert any(top <= row < bottom and left <= col < right for top, left, bottom, right in cores)


def test_an_image_of_any_size_without_content_is_refused_after_some_windows(tmp_path, monkeypatch):
    """Most of them are not read; of an image that is not larger than those, all are."""
    monkeypatch.setattr(images_module, "CHECK_WINDOW_PX", 64 * 64)
    path = tmp_path / "a.tif"
    with warnings.catch_warnings(action="ignore"), rasterio.open(
        path, "w", driver="GTiff", width=1024, height=640, count=1, dtype=np.uint8, tiled=True, blockxsize=64,
        blockysize=64, compress="deflate",
    ) as file:  # fmt: skip
        file.write(np.full((640, 1024), 9, np.uint8), 1)
    image, read = open_image(path), []
    original = images_module.RasterImage.read
    monkeypatch.setattr(
        images_module.RasterImage, "read", lambda self, *window: read.append(window) or original(self, *window)
    )
    with pytest.raises(InputError, match=r"has the value 9 everywhere: nothing to match\. Leave it out"):
        check_content(image)
    seen = np.zeros(image.shape, int)
    for row, col, rows, cols in read:
        seen[row : row + rows, col : col + cols] += 1
    assert (seen == 1).all()
    read.clear()
    monkeypatch.setattr(images_module, "MAX_CHECKED_PX", 20 * 64 * 64)
    with pytest.raises(InputError, match=r"value 9 in all of 20 windows spread over its 640 x 1024 px: "):
        check_content(image)
    assert len(read) == 20
    # Spread: each quarter of the image has its share.
    assert np.histogram2d(*np.array(read)[:, :2].T, bins=2)[0].min() >= 3


def test_an_image_larger_than_any_can_be_matched_is_refused(tmp_path):
    path = tmp_path / "a.vrt"
    path.write_text('<VRTDataset rasterXSize="2000000000" rasterYSize="2000000000"><VRTRasterBand dataType="Byte" '
                    'band="1"/></VRTDataset>')  # fmt: skip
    with pytest.raises(InputError, match=r"is 2000000000 x 2000000000 px, more than can be matched\. Cut out the part"):
        open_image(path)
