"""Copies with another RPC keep pixels to the bit, and bands, types, nodata, masks and meanings."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import NotGeoreferencedWarning

from rpc_fixtures import satellite_rpc
from zlocus.core.errors import InputError
from zlocus.io.cameras.rpc import read_rpc
from zlocus.products import rpc_copies
from zlocus.products.rpc_copies import gdal_rpc, write_rpc_copy

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SHAPE = (700, 530)
DIGITS = 2e-14
CORRECTED = satellite_rpc().moved(3.25, -7.5)


def written(path, bands, mask=None, describe=None, **profile):
    options = {"driver": "GTiff", "count": len(bands), "height": SHAPE[0], "width": SHAPE[1], "dtype": bands.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(path, "w", **options | profile, rpcs=gdal_rpc(satellite_rpc())) as file,
        ):
            file.write(bands)
            if mask is not None:
                file.write_mask(mask)
            if describe is not None:
                describe(file)
    return path


def numbers(count, dtype, high):
    return np.random.default_rng(1).integers(0, high, (count, *SHAPE)).astype(dtype)


def described(file):
    file.descriptions = ("near infrared",)
    file.update_tags(TIFFTAG_DATETIME="2026:05:17 10:00:00", satId="WV03")
    file.update_tags(1, wavelength="850")
    file.update_tags(ns="VENDOR", firstLineTime="2026-05-17T10:00:00Z")
    file.scales, file.offsets, file.units = (0.5,), (10.0,), ("W",)


def painted(file):
    file.write_colormap(1, {k: (k, 255 - k, 7, 255) for k in range(256)})


def assert_same_rpc(path):
    """The tag of GeoTIFF holds the numbers, which GDAL passes on with fifteen digits."""
    found = read_rpc(path)
    for name, value in vars(CORRECTED).items():
        if not name.startswith("_") and name in CORRECTED.__dataclass_fields__:
            np.testing.assert_allclose(getattr(found, name), value, rtol=DIGITS, err_msg=name)


CASES = {
    "16 bits, nodata, tags": (numbers(1, "uint16", 2047), {"nodata": 0, "describe": described}),
    "colours with a mask": (numbers(3, "uint8", 255), {"photometric": "RGB", "mask": numbers(1, "uint8", 2)[0] * 255}),
    "alpha": (numbers(4, "uint8", 255), {"photometric": "RGB", "alpha": "yes"}),
    "eight bands, floats": (numbers(8, "float32", 9) / 7, {"nodata": np.nan, "interleave": "band"}),
    "a palette": (numbers(1, "uint8", 255), {"photometric": "palette", "describe": painted}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_copy_is_the_image_with_another_camera(tmp_path, monkeypatch, case):
    monkeypatch.setattr(rpc_copies, "STRIP_PIXELS", 1)  # several windows
    bands, options = CASES[case]
    image = written(tmp_path / "a.tif", bands, **options)
    write_rpc_copy(tmp_path / "copy.tif", image, CORRECTED)
    with rasterio.open(image) as source, rasterio.open(tmp_path / "copy.tif") as copy:
        np.testing.assert_array_equal(copy.read(), source.read())
        np.testing.assert_array_equal(copy.dataset_mask(), source.dataset_mask())
        for name in ("count", "dtypes", "shape", "colorinterp", "mask_flag_enums", "descriptions", "scales",
                     "offsets", "units", "interleaving"):  # fmt: skip
            assert getattr(copy, name) == getattr(source, name), name
        np.testing.assert_equal(copy.nodata, source.nodata)
        for k in range(1, source.count + 1):
            assert source.tags(k).items() <= copy.tags(k).items()
        assert source.tags().items() <= copy.tags().items()
        assert copy.tags(ns="VENDOR") == source.tags(ns="VENDOR")
        if source.colorinterp[0] == ColorInterp.palette:
            assert copy.colormap(1) == source.colormap(1)
        assert copy.profile["compress"] == "deflate"
    assert_same_rpc(tmp_path / "copy.tif")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tif", "copy.tif"]


@pytest.mark.parametrize(("driver", "suffix", "options"), [
    ("JP2OpenJPEG", ".jp2", {"QUALITY": "100", "REVERSIBLE": "YES"}), ("NITF", ".ntf", {}),
])  # fmt: skip
def test_other_formats_become_geotiff(tmp_path, driver, suffix, options):
    with rasterio.Env() as gdal:
        if driver not in gdal.drivers():
            pytest.skip(f"GDAL was built without {driver}")
    first = written(tmp_path / "first.tif", numbers(1, "uint16", 2047))
    image = tmp_path / f"scene{suffix}"
    rasterio.shutil.copy(first, image, driver=driver, **options)
    write_rpc_copy(tmp_path / "copy.tif", image, CORRECTED)
    with rasterio.open(image) as source, rasterio.open(tmp_path / "copy.tif") as copy:
        np.testing.assert_array_equal(copy.read(), source.read())
        assert copy.dtypes == source.dtypes
        assert copy.driver == "GTiff"
        assert copy.mask_flag_enums == ([MaskFlags.all_valid],)
    assert_same_rpc(tmp_path / "copy.tif")


def test_after_a_failure_nothing_is_left(tmp_path):
    with pytest.raises(InputError, match="There is no image"):
        write_rpc_copy(tmp_path / "copy.tif", tmp_path / "none.tif", CORRECTED)
    broken = written(tmp_path / "a.tif", numbers(1, "uint16", 2047), compress="deflate")
    content = bytearray(broken.read_bytes())
    content[3000:9000] = bytes(6000)
    broken.write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        write_rpc_copy(tmp_path / "copy.tif", broken, CORRECTED)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
