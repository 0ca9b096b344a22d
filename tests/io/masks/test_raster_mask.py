from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rasterio.transform import from_origin

from mask_files import mask_of, whole, write_raster
from zlocus.core.errors import InputError

SHAPE = (37, 53)
RNG = np.random.default_rng(5)
CLASSES = RNG.integers(0, 4, SHAPE).astype(np.uint8)


@pytest.fixture(scope="module")
def classes(tmp_path_factory):
    return str(write_raster(tmp_path_factory.mktemp("raster") / "classes.tif", CLASSES, nodata=3))


def test_every_value_but_0_and_nodata_is_masked(classes):
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": classes})), (CLASSES == 1) | (CLASSES == 2))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"values": [2]}, CLASSES == 2),
        ({"values": [1, 3]}, (CLASSES == 1) | (CLASSES == 3)),
        ({"values": [1], "outside": True}, CLASSES != 1),
        ({"values": ["cloud", 3], "names": {"Clouds": 1, "snow": 2}}, (CLASSES == 1) | (CLASSES == 3)),
        ({"names": {1: "cloud", 2: "snow"}}, CLASSES == 1),
        ({"names": {"heavy haze": 1, "light_haze": 2, "defect": 3}}, (CLASSES == 1) | (CLASSES == 3)),
        ({"kind": "raster", "band": 1}, (CLASSES == 1) | (CLASSES == 2)),
    ],
)
def test_values_are_chosen_by_number_and_name(classes, options, expected):
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": classes} | options)), expected)


def test_masks_of_a_view_add_up(classes, tmp_path):
    other = write_raster(tmp_path / "other.tif", np.eye(*SHAPE, dtype=np.uint8))
    mask = mask_of(SHAPE, {"file": classes, "values": [1]}, {"file": str(other)})
    np.testing.assert_array_equal(whole(mask), (CLASSES == 1) | (np.eye(*SHAPE) > 0))


@given(st.data())
def test_any_window_is_that_part_of_the_mask(classes, data):
    row, col = (data.draw(st.integers(0, n - 1)) for n in SHAPE)
    rows, cols = data.draw(st.integers(1, SHAPE[0] - row)), data.draw(st.integers(1, SHAPE[1] - col))
    found = mask_of(SHAPE, {"file": classes, "values": [2]}).covers(row, col, rows, cols)
    np.testing.assert_array_equal(found, CLASSES[row : row + rows, col : col + cols] == 2)


@pytest.mark.parametrize(
    ("shape", "raster_shape"),
    [((60, 80), (15, 20)), ((61, 83), (16, 21)), ((61, 83), (15, 20)), ((50, 75), (20, 30)), ((40, 40), (1, 1))],
)
def test_the_pixel_of_a_smaller_raster_is_the_one_that_contains_the_centre(tmp_path, shape, raster_shape):
    """Whole ratios whose last pixels reach beyond the image, ratios that are cut off, and fractional ones."""
    small = RNG.integers(0, 2, raster_shape).astype(np.uint8)
    path = write_raster(tmp_path / "small.tif", small)
    factor = max(-(-n // m) for n, m in zip(shape, raster_shape, strict=True))
    is_whole = all(-(-n // factor) == m for n, m in zip(shape, raster_shape, strict=True))
    expected = np.zeros(shape, bool)
    for r in range(shape[0]):
        for c in range(shape[1]):
            if is_whole:
                at = r // factor, c // factor
            else:
                at = tuple(int((p + 0.5) * m / n) for p, m, n in zip((r, c), raster_shape, shape, strict=True))
            expected[r, c] = small[at] != 0
    mask = mask_of(shape, {"file": str(path)})
    np.testing.assert_array_equal(whole(mask), expected)
    np.testing.assert_array_equal(mask.covers(7, 11, 9, 5), expected[7:16, 11:16])


def test_nan_masks_nothing_and_png_is_read_too(tmp_path):
    floats = np.where(CLASSES == 1, np.nan, CLASSES).astype(np.float32)
    np.testing.assert_array_equal(
        whole(mask_of(SHAPE, {"file": str(write_raster(tmp_path / "f.tif", floats))})), CLASSES > 1
    )
    png = write_raster(tmp_path / "m.png", CLASSES, driver="PNG")
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(png)})), CLASSES > 0)


def test_masks_are_shared_by_threads_and_sent_to_processes(classes):
    mask = mask_of(SHAPE, {"file": classes, "values": [1]})
    sent = pickle.loads(pickle.dumps(mask))
    with ThreadPoolExecutor(4) as pool:
        for rows in pool.map(lambda row: (row, sent.covers(row, 0, 1, SHAPE[1])), range(SHAPE[0])):
            np.testing.assert_array_equal(rows[1][0], CLASSES[rows[0]] == 1)


def table(path, *rows):
    fields = "".join(f"<Row index='{i}'><F>{v}</F><F>{n}</F></Row>" for i, (v, n) in enumerate(rows))
    path.with_name(path.name + ".aux.xml").write_text(
        "<PAMDataset><PAMRasterBand band='1'><GDALRasterAttributeTable>"
        "<FieldDefn index='0'><Name>Value</Name><Type>0</Type><Usage>5</Usage></FieldDefn>"
        "<FieldDefn index='1'><Name>Class_Name</Name><Type>2</Type><Usage>2</Usage></FieldDefn>"
        f"{fields}</GDALRasterAttributeTable></PAMRasterBand></PAMDataset>"
    )


def test_names_of_a_raster_attribute_table(tmp_path):
    path = write_raster(tmp_path / "clm.tif", CLASSES)
    table(path, (0, "Clear"), (1, "Thick clouds"), (2, "Snow / ice"), (3, "Cloud shadow"))
    mask = mask_of(SHAPE, {"file": str(path)})
    np.testing.assert_array_equal(whole(mask), CLASSES == 1)
    assert mask.files == (path, tmp_path / "clm.tif.aux.xml")
    chosen = mask_of(SHAPE, {"file": str(path), "values": ["cloud_shadow", "thick_cloud"]})
    np.testing.assert_array_equal(whole(chosen), (CLASSES == 1) | (CLASSES == 3))


def test_names_of_categories(tmp_path):
    path = write_raster(tmp_path / "clm.tif", CLASSES)
    path.with_name("clm.tif.aux.xml").write_text(
        "<PAMDataset><PAMRasterBand band='1'><CategoryNames><Category>no cloud</Category><Category/>"
        "<Category>cloud</Category></CategoryNames></PAMRasterBand></PAMDataset>"
    )
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(path)})), CLASSES == 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"band": 2}, "has 1 bands, not a band 2"),
        ({"band": "cloud"}, "has no bands called 'cloud': it has bands without names"),
        ({"values": ["cloud"]}, "has no class called 'cloud'. It names none"),
        ({"values": ["cloud"], "names": {"snow": 2}}, "has no class called 'cloud'. It has snow"),
        ({"coordinates": "pixels"}, "coordinates and height are for polygons"),
    ],
)
def test_options_that_do_not_fit_are_refused_with_the_view_named(classes, options, message):
    with pytest.raises(InputError, match=f"The mask of the view a: (?!The mask).*{message}"):
        mask_of(SHAPE, {"file": classes} | options)


@pytest.mark.parametrize("shape", [(38, 53), (74, 106), (18, 40), (20, 53)])
def test_the_mask_of_another_image_is_refused(tmp_path, shape):
    path = write_raster(tmp_path / "other.tif", np.zeros(shape, np.uint8))
    with pytest.raises(InputError, match="does not cover the same extent"):
        mask_of(SHAPE, {"file": str(path)})


def test_a_raster_on_the_ground_is_refused_unless_it_has_the_size_of_the_image(tmp_path):
    on_ground = {"crs": "EPSG:32631", "transform": from_origin(5e5, 5e6, 2.0, 2.0)}
    small = write_raster(tmp_path / "small.tif", np.ones((18, 26), np.uint8), **on_ground)
    with pytest.raises(InputError, match="and a CRS: it is on the ground"):
        mask_of(SHAPE, {"file": str(small)})
    same = write_raster(tmp_path / "same.tif", np.ones(SHAPE, np.uint8), **on_ground)
    assert whole(mask_of(SHAPE, {"file": str(same)})).all()


def test_a_missing_a_damaged_and_a_replaced_mask(tmp_path):
    path = tmp_path / "m.tif"
    with pytest.raises(InputError, match=r"view a: There is no mask .*m\.tif"):
        mask_of(SHAPE, {"file": str(path)})
    path.write_bytes(b"II*\x00" + bytes(40))
    with pytest.raises(InputError, match=r"view a: .*m\.tif cannot be opened as a raster"):
        mask_of(SHAPE, {"file": str(path)})
    mask = mask_of(SHAPE, {"file": str(write_raster(path, CLASSES))})
    write_raster(path, np.ones((9, 9), np.uint8))
    with pytest.raises(InputError, match="has changed its size"):
        whole(mask)
