from __future__ import annotations

import pickle
import tracemalloc
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import from_origin

from rpc_fixtures import write_image
from zlocus.core.errors import InputError
from zlocus.io.images import check_content, open_image

RNG = np.random.default_rng(3)
GREY = RNG.integers(1, 4000, (37, 53)).astype(np.uint16)


def whole(image):
    return image.read(0, 0, *image.shape)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "float32", "float64"])
def test_window_of_each_type(tmp_path, dtype: str):
    pixels = (GREY % 200).astype(dtype)
    image = open_image(write_image(tmp_path / "a.tif", pixels))
    assert (image.shape, image.dtype, image.n_bands, image.nodata) == ((37, 53), dtype, 1, None)
    window = image.read(5, 7, 11, 13)
    assert window.pixels.dtype == np.float32
    np.testing.assert_array_equal(window.pixels, pixels[5:16, 7:20])
    assert window.valid.all()


def test_zero_is_a_grey_value_unless_the_file_says_otherwise(tmp_path):
    pixels = GREY.copy()
    pixels[3:9, 4:8] = 0
    assert whole(open_image(write_image(tmp_path / "a.tif", pixels))).valid.all()
    window = whole(open_image(write_image(tmp_path / "b.tif", pixels, nodata=0)))
    np.testing.assert_array_equal(window.valid, pixels > 0)


def test_nodata_nan_and_infinity_are_not_valid_and_read_as_zero(tmp_path):
    pixels = GREY.astype(np.float32)
    pixels[0, :3] = -9999, np.nan, np.inf
    window = whole(open_image(write_image(tmp_path / "a.tif", pixels, nodata=-9999)))
    assert np.flatnonzero(~window.valid).tolist() == [0, 1, 2]
    np.testing.assert_array_equal(window.pixels[0, :4], [0, 0, 0, pixels[0, 3]])
    not_declared = whole(open_image(write_image(tmp_path / "b.tif", pixels)))
    assert np.flatnonzero(~not_declared.valid).tolist() == [1, 2]


@pytest.mark.parametrize("internal", [True, False])
def test_masks_inside_and_beside_the_file(tmp_path, internal: bool):
    path, mask = write_image(tmp_path / "a.tif", GREY), RNG.random(GREY.shape) > 0.3
    with (
        warnings.catch_warnings(action="ignore"),
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal),
        rasterio.open(path, "r+") as file,
    ):
        file.write_mask(mask)
    assert (tmp_path / "a.tif.msk").exists() != internal
    window = whole(open_image(path))
    np.testing.assert_array_equal(window.valid, mask)
    np.testing.assert_array_equal(window.pixels, np.where(mask, GREY, 0))


def test_colour_becomes_luminance_and_alpha_a_mask(tmp_path):
    rgba = RNG.integers(0, 255, (4, 20, 30)).astype(np.uint8)
    rgba[3] = np.where(rgba[3] > 100, 255, 0)
    for n_bands in (3, 4):
        path = write_image(
            tmp_path / f"{n_bands}.tif", rgba[:n_bands], photometric="RGB", alpha="YES" if n_bands == 4 else "NO"
        )
        window = whole(open_image(path))
        valid = rgba[3] > 0 if n_bands == 4 else np.ones((20, 30), bool)
        luminance = 0.299 * rgba[0] + 0.587 * rgba[1] + 0.114 * rgba[2]
        np.testing.assert_array_equal(window.valid, valid)
        np.testing.assert_allclose(window.pixels, np.where(valid, luminance, 0), rtol=1e-6)


def test_colour_pixel_is_nodata_when_all_bands_are(tmp_path):
    rgb = RNG.integers(1, 255, (3, 9, 9)).astype(np.uint16)
    rgb[:, 2, 2] = 0
    rgb[0, 5, 5] = rgb[2, 6, 6] = 0
    window = whole(open_image(write_image(tmp_path / "a.tif", rgb, photometric="RGB", nodata=0)))
    assert np.argwhere(~window.valid).tolist() == [[2, 2]]


def test_infinities_of_either_sign_in_colours(tmp_path):
    rgb = np.ones((3, 9, 9), np.float32)
    rgb[:, 1, 1] = np.inf, -np.inf, np.nan
    window = whole(open_image(write_image(tmp_path / "a.tif", rgb, photometric="RGB")))
    assert np.argwhere(~window.valid).tolist() == [[1, 1]]


def test_bands_are_found_by_their_colour_not_their_number(tmp_path):
    bands = RNG.integers(1, 4000, (4, 9, 9)).astype(np.uint16)
    path = write_image(tmp_path / "bgrn.tif", bands, photometric="RGB")
    with warnings.catch_warnings(action="ignore"), rasterio.open(path, "r+") as file:
        file.colorinterp = [ColorInterp.blue, ColorInterp.green, ColorInterp.red, ColorInterp.undefined]
    luminance = 0.299 * bands[2] + 0.587 * bands[1] + 0.114 * bands[0]
    np.testing.assert_allclose(whole(open_image(path)).pixels, luminance, rtol=1e-6)


def test_bands_without_colour_give_the_first(tmp_path):
    bands = RNG.integers(1, 4000, (5, 9, 9)).astype(np.uint16)
    np.testing.assert_array_equal(whole(open_image(write_image(tmp_path / "a.tif", bands))).pixels, bands[0])


@pytest.mark.parametrize(
    "profile",
    [
        {}, {"compress": "deflate"}, {"tiled": True, "blockxsize": 16, "blockysize": 16}, {"compress": "lzw"},
        {"compress": "zstd"}, {"compress": "jpeg"}, {"compress": "deflate", "alpha": "YES"},
    ],
)  # fmt: skip
def test_truncated_at_any_length(tmp_path, profile):
    grey = GREY.astype(np.uint8) if profile.get("compress") == "jpeg" else GREY
    pixels = np.stack([grey, grey]) if "alpha" in profile else grey
    data = write_image(tmp_path / "whole.tif", pixels, **profile).read_bytes()
    cut = tmp_path / "cut.tif"
    for length in [*range(0, len(data) - 1, 97), len(data) - 1]:
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cut\.tif"):
            open_image(cut)


@pytest.mark.parametrize(
    ("driver", "name"), [("ENVI", "a.img"), ("EHdr", "a.bil"), ("PNM", "a.pgm"), ("SAGA", "a.sdat")]
)
def test_truncated_pixels_as_they_are(tmp_path, driver, name):
    """GDAL reads those behind the end as 0."""
    place = from_origin(500000, 4500000, 1, 1)
    grey = GREY.astype(np.float32 if driver == "SAGA" else np.uint8)
    with warnings.catch_warnings(action="ignore"), rasterio.open(
        tmp_path / name, "w", driver=driver, height=grey.shape[0], width=grey.shape[1], count=1, dtype=grey.dtype,
        transform=place,
    ) as file:  # fmt: skip
        file.write(grey, 1)
    path = tmp_path / name
    np.testing.assert_array_equal(whole(open_image(path)).pixels, grey)
    content = path.read_bytes()
    # The header of a PNM is not counted.
    for lost in (64 if driver == "PNM" else 1, len(content) // 3):
        path.write_bytes(content[:-lost])
        with pytest.raises(InputError, match="truncated"):
            open_image(path)


def test_truncated_mask(tmp_path):
    path = write_image(tmp_path / "a.tif", GREY)
    with warnings.catch_warnings(action="ignore"), rasterio.open(path, "r+") as file:
        file.write_mask(RNG.random(GREY.shape) > 0.5)
    data = path.read_bytes()
    path.write_bytes(data[:-20])
    with pytest.raises(InputError, match=r"a\.tif"):
        open_image(path)


def test_truncation_is_found_without_decoding_the_lost_block(tmp_path):
    path = write_image(tmp_path / "a.tif", np.tile(GREY, (40, 20)), tiled=True, blockxsize=256, blockysize=256)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match=r"a\.tif is truncated: it has \d+ bytes, and pixels of row \d+"):
        open_image(path)


def test_damage_inside_a_block_is_found_by_reading(tmp_path):
    path = write_image(tmp_path / "a.tif", RNG.integers(0, 9, (600, 600)).astype(np.uint8), compress="deflate")
    image, data = open_image(path), bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 400] = bytes(400)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.tif cannot be read.*damaged or truncated"):
        whole(image)


def pairs_of_integers(path):
    """An image of a kind that NumPy does not have."""
    with warnings.catch_warnings(action="ignore"), rasterio.open(
        path, "w", driver="GTiff", height=4, width=5, count=1, dtype="complex_int16"
    ) as file:  # fmt: skip
        file.write(np.ones((4, 5), np.complex64), 1)
    return path


def test_a_block_that_no_file_so_small_can_hold_is_not_read(tmp_path):
    """One gigabyte of pixels that are not there."""
    path, side = tmp_path / "block.tif", 32768
    with warnings.catch_warnings(action="ignore"), rasterio.open(
        path, "w", driver="GTiff", height=side, width=side, count=1, dtype="uint8", sparse_ok=True,
        tiled=True, blockxsize=side, blockysize=side, compress="deflate",
    ):  # fmt: skip
        pass
    assert path.stat().st_size < 10_000
    with pytest.raises(
        InputError, match=r"block\.tif is damaged: it says that it has blocks of 1\.1 GB of pixels, in \d+ "
    ):
        open_image(path)


def test_files_that_are_no_images(tmp_path):
    text = tmp_path / "notes.tif"
    text.write_text("not an image")
    for path, message in (
        (tmp_path / "none.tif", r"There is no image .*none\.tif"),
        (tmp_path, "is a folder"),
        (text, r"notes\.tif cannot be opened as a raster: its format is not known\. Check"),
        (write_image(tmp_path / "c.tif", GREY.astype(np.complex64)), "complex numbers"),
        (pairs_of_integers(tmp_path / "slc.tif"), r"slc\.tif holds complex numbers\. Convert it to intensity first"),
    ):
        with pytest.raises(InputError, match=message):
            open_image(path)


def test_palette_is_refused(tmp_path):
    path = write_image(tmp_path / "a.tif", (GREY % 4).astype(np.uint8), photometric="palette")
    with warnings.catch_warnings(action="ignore"), rasterio.open(path, "r+") as file:
        file.write_colormap(1, {i: (i, 255 - i, 7) for i in range(4)})
    with pytest.raises(InputError, match="palette"):
        open_image(path)


def test_content_of_an_image_that_can_be_matched(tmp_path):
    one_pixel = np.full((1200, 40), 7, np.uint16)
    one_pixel[1100, 20] = 8
    check_content(open_image(write_image(tmp_path / "a.tif", one_pixel)))
    two_plains = np.repeat(np.array([7, 8], np.uint8), 1024)[:, np.newaxis] * np.ones((1, 40), np.uint8)
    check_content(open_image(write_image(tmp_path / "b.tif", two_plains)))


def test_nothing_to_match(tmp_path):
    constant = np.full((1200, 40), 7, np.uint16)
    with pytest.raises(InputError, match=r"a\.tif has the value 7 everywhere"):
        check_content(open_image(write_image(tmp_path / "a.tif", constant)))
    constant[600:] = 0
    with pytest.raises(InputError, match=r"b\.tif has the value 7 everywhere"):
        check_content(open_image(write_image(tmp_path / "b.tif", constant, nodata=0)))
    with pytest.raises(InputError, match=r"c\.tif has no valid pixel \(nodata = 7"):
        check_content(open_image(write_image(tmp_path / "c.tif", np.full((9, 9), 7, np.uint16), nodata=7)))


def test_threads_and_processes_read_the_same(tmp_path):
    pixels = RNG.integers(0, 9999, (400, 300)).astype(np.uint16)
    image = open_image(write_image(tmp_path / "a.tif", pixels, compress="deflate"))
    image = pickle.loads(pickle.dumps(image))
    places = [(int(r), int(c)) for r, c in RNG.integers(0, 200, (60, 2))]
    with ThreadPoolExecutor(8) as pool:
        windows = list(pool.map(lambda place: image.read(*place, 90, 80).pixels, places))
    for (row, col), window in zip(places, windows, strict=True):
        np.testing.assert_array_equal(window, pixels[row : row + 90, col : col + 80])


def test_a_window_costs_the_memory_of_a_window(tmp_path):
    path = write_image(tmp_path / "a.tif", np.ones((4000, 4000), np.uint8), tiled=True, compress="deflate")
    tracemalloc.start()
    image = open_image(path)
    image.read(100, 100, 64, 64)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2e6  # bytes; the whole image as float32 is 64e6


def test_a_file_that_changed_its_size(tmp_path):
    image = open_image(write_image(tmp_path / "a.tif", GREY))
    write_image(tmp_path / "a.tif", GREY[:-1])
    with pytest.raises(InputError, match="changed its size"):
        image.read(0, 0, 2, 2)
